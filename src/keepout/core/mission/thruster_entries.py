"""The table of thrusters in a scenario."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from keepout.core.mission.entries import Entry, NonNegative, Positive, Vector


class ThrusterEntry(Entry):
    """One thruster of a layout of your own."""

    position: Vector = Field(description="from the chaser's centre of mass, m")
    direction: Vector = Field(description="of the force on the chaser")
    force: Positive | None = Field(default=None, description="while it is on, N; unset: `thrusters.force`")

    @model_validator(mode="after")
    def _has_a_direction(self) -> "ThrusterEntry":
        if not any(self.direction):
            raise ValueError("direction [0, 0, 0]; it must point somewhere")
        return self


class ThrustersEntry(Entry):
    """What gives the chaser its force: any force at once, or thrusters that are on or off."""

    layout: Literal["ideal", "six", "12", "24", "own"] = Field(
        default="ideal",
        description="ideal: any force up to chaser.force_limit an axis, at any instant; six, 12, 24: on/off thrusters, "
        "one, two or four for each direction; own: those of `own`",
    )
    held_in: Literal["target", "inertial"] = Field(
        default="target",
        description="axes in which a force is held over a control period: those of the target, which turn with it, or "
        "inertial ones, as of a chaser that does not turn; only of ideal thrusters",
    )
    own: tuple[ThrusterEntry, ...] = Field(
        default=(), description="thrusters of a layout of your own, each with position, direction and force"
    )
    force: Positive | None = Field(
        default=None,
        description="of each thruster, N; unset: chaser.force_limit divided by the thrusters of a direction",
    )
    least_on_time: NonNegative = Field(
        default=0.02, description="the shortest pulse, s; less than half of it is not fired"
    )
    modulation: Literal["pulse-width", "delta-sigma"] = Field(
        default="pulse-width",
        description="delta-sigma: what a pulse gives too much or too little is made up for later",
    )
    specific_impulse: Positive = Field(default=70.0, description="s; 70 is cold nitrogen's, 220 hydrazine's")
    rise_delay: NonNegative = Field(default=0.0, description="by which each pulse begins and ends late, s")
    misalignment: Annotated[float, Field(ge=0.0, le=0.2)] = Field(
        default=0.0, description="largest angle of a thruster's force to its direction, drawn once a flight, rad"
    )
    scale_error: Annotated[float, Field(ge=0.0, le=0.5)] = Field(
        default=0.0, description="largest relative error of a thruster's force, drawn once a flight"
    )
    detection_time: NonNegative = Field(
        default=5.0, description="from when a thruster sticks until the others are fired accordingly, s"
    )
    survive_failure: bool = Field(
        default=False,
        description="whether the guard covers one thruster that sticks, off or on; chaser.force_limit must then be "
        "what the others can give",
    )

    @model_validator(mode="after")
    def _own_thrusters_are_there(self) -> "ThrustersEntry":
        if (self.layout == "own") != bool(self.own):
            raise ValueError(f'own: {len(self.own)} thrusters, and layout is "{self.layout}"; they belong to "own"')
        if self.held_in != "target" and self.layout != "ideal":
            raise ValueError(
                f'held_in: "{self.held_in}" is for layout = "ideal"; the thrusters of a layout are taken to be '
                "parallel to the target's axes"
            )
        lacking = [str(number) for number, thruster in enumerate(self.own) if thruster.force is None]
        if self.force is None and lacking:
            raise ValueError(f"own: force of thrusters {', '.join(lacking)} not given; give it, or thrusters.force")
        return self
