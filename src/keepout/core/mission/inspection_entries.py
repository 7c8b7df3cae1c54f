"""The tables of a scenario that inspects a target: the camera, the light it needs, and what is to be seen and how."""

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from keepout.core.mission.entries import Entry, NonNegative, Positive, Vector

_WIDEST = math.radians(170.0)
"""Of a camera's cone, rad."""
_STEEPEST = math.radians(89.0)
"""Of the angle to a patch's normal at which a camera looks, rad."""
_LOWEST_SUN = math.radians(89.9)
"""Of the angle to a patch's normal at which the sun shines, rad."""


class CameraEntry(Entry):
    """A camera at the chaser's centre that turns on its own, and what a frame must show of a patch (docs/seeing.md)."""

    field_of_view: Annotated[float, Field(gt=0.0, le=_WIDEST)] = Field(
        default=math.radians(60.0), description="full angle of the cone about the boresight that counts, rad"
    )
    pixels: Annotated[int, Field(ge=8, le=65536)] = Field(default=1024, description="across that cone")
    least_range: Positive = Field(default=0.3, description="m; what is nearer is not sharp")
    greatest_range: Annotated[float, Field(gt=0.0, le=1e6)] = Field(
        default=10.0, description="m; what is farther does not count"
    )
    greatest_incidence: Annotated[float, Field(gt=0.0, le=_STEEPEST)] = Field(
        default=math.radians(60.0), description="from a patch's normal to the camera, rad"
    )
    greatest_sample_distance: Positive | None = Field(
        default=None, description="on the surface, along its slant, m a pixel; unset: however coarse"
    )
    period: Positive = Field(default=5.0, description="between two frames, s; whole control periods")
    turn_rate: Positive = Field(
        default=math.radians(1.0), description="largest rate at which the boresight turns, rad/s"
    )
    turn_acceleration: Positive = Field(default=0.002, description="largest rate of change of that, rad/s2")

    @model_validator(mode="after")
    def _ranges_are_ordered(self) -> "CameraEntry":
        if self.least_range >= self.greatest_range:
            raise ValueError(
                f"least_range {self.least_range} m, greatest_range {self.greatest_range} m; nothing is between them"
            )
        return self


class LightEntry(Entry):
    """The light that a patch must be in to count as seen."""

    kind: Literal["none", "fixed", "sun"] = Field(
        default="none",
        description="none: light does not matter; fixed: from `direction` all the time; sun: as it stands over the "
        "target from epoch, orbit and attitude (table sun), and not while the Earth hides any of it",
    )
    direction: Vector | None = Field(
        default=None, description="fixed: towards the light, in the target's body frame, any length"
    )
    greatest_incidence: Annotated[float, Field(gt=0.0, le=_LOWEST_SUN)] = Field(
        default=math.radians(80.0), description="from a patch's normal to the light, rad"
    )

    @model_validator(mode="after")
    def _comes_from_somewhere(self) -> "LightEntry":
        if self.kind == "fixed" and self.direction is None:
            raise ValueError('kind = "fixed" needs direction = [x, y, z], towards the light in the body frame')
        if self.direction is not None and not any(self.direction):
            raise ValueError("direction [0, 0, 0] points nowhere; give a vector towards the light")
        return self


class ProtectedEntry(Entry):
    """A part of the target that no thruster's plume may reach: a ball, or a box along the body axes."""

    centre: Vector | None = Field(default=None, description="of the ball, body frame, m")
    radius: NonNegative | None = Field(default=None, description="of the ball, m; 0: a point")
    lower: Vector | None = Field(default=None, description="lower corner of the box, body frame, m")
    upper: Vector | None = Field(default=None, description="upper corner of the box, body frame, m")

    @model_validator(mode="after")
    def _ball_or_box(self) -> "ProtectedEntry":
        given = [name for name in ("centre", "radius", "lower", "upper") if getattr(self, name) is not None]
        if given not in (["centre", "radius"], ["lower", "upper"]):
            raise ValueError(
                f"{', '.join(given) or 'nothing'}: give centre and radius of a ball, or lower and upper of a box"
            )
        lower, upper = self.lower or (), self.upper or ()
        if any(low > high for low, high in zip(lower, upper)):
            raise ValueError(f"lower {list(lower)} must not exceed upper {list(upper)}")
        return self


class HoldPointEntry(Entry):
    """A place where the chaser comes to rest, in the order given, before any view is flown to."""

    position: Vector = Field(description="body frame, m")
    seconds: Positive = Field(default=60.0, description="for which it is held, s")


class InspectEntry(Entry):
    """What `keepout inspect` is to see, by which tour, and the operator's limits (docs/inspection.md)."""

    stand_off: Positive = Field(
        default=1.5, description="least distance of the chaser's centre from the target's surface, m"
    )
    patch_size: Positive | None = Field(
        default=None,
        description="edge of the surface's patches, each seen wholly or not at all, m; unset: 0.25, for a target "
        "longer than 80 m 1.0, and for one shorter than 2.5 m a tenth of that length",
    )
    coverage: Annotated[float, Field(gt=0.0, le=1.0)] = Field(
        default=1.0, description="share wanted of the area that can be seen, and be lit in time; then the flight ends"
    )
    tour: Literal["plan", "nearest", "circumnavigation"] = Field(
        default="plan",
        description="plan: the views that cover most, in the best order; nearest: always the nearest view that shows "
        "something new; circumnavigation: natural motion round the target",
    )
    objective: Literal["time", "delta_v", "both"] = Field(
        default="time", description="what the order of the views makes least; both: time + delta_v_worth × Δv"
    )
    delta_v_worth: Positive = Field(default=1000.0, description="objective both: what Δv costs, s per m/s")
    candidates: Annotated[int, Field(ge=1, le=1_000_000)] = Field(
        default=4000, description="places from which views are considered, at most"
    )
    most_views: Annotated[int, Field(ge=1, le=100_000)] = Field(default=1000, description="in one plan, at most")
    dwell: NonNegative = Field(default=0.0, description="for which the chaser stays at each view, s; 0: it flies on")
    proof_squares: Annotated[int, Field(ge=1, le=10_000_000_000)] = Field(
        default=4_000_000,
        description="squares of directions looked at, at most, for the proof of what can and cannot be seen: counted "
        "work, the same on every machine",
    )
    proof_time: NonNegative | None = Field(
        default=None,
        description="by the clock, at most, for that proof, s; where it ends the proof, results say so, and differ "
        "from machine to machine; unset: no clock",
    )
    passive_safety: NonNegative = Field(
        default=0.0, description="for which a chaser that stops thrusting anywhere on its way touches nothing, s"
    )
    plume_half_angle: Annotated[float, Field(gt=0.0, le=math.pi / 2.0)] = Field(
        default=math.radians(20.0), description="of the cone of a thruster's plume, rad"
    )
    plume_range: Positive | None = Field(
        default=None, description="beyond which a plume harms nothing, m; unset: however far"
    )
    no_thrust_towards: tuple[ProtectedEntry, ...] = Field(
        default=(), description="parts of the target that no plume may reach, each a ball or a box"
    )
    hold_points: tuple[HoldPointEntry, ...] = Field(
        default=(), description="where the chaser is held first, each with position and seconds"
    )

    @model_validator(mode="after")
    def _worth_of_both(self) -> "InspectEntry":
        worth = type(self).model_fields["delta_v_worth"].default
        if self.delta_v_worth != worth and self.objective != "both":
            raise ValueError(
                f'delta_v_worth {self.delta_v_worth} s per m/s is for objective = "both", and objective is '
                f'"{self.objective}"'
            )
        return self
