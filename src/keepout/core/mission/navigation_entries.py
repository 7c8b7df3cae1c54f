"""The table of navigation in a scenario."""

from typing import Annotated, Literal

from pydantic import Field

from keepout.core.mission.entries import Entry, NonNegative


class NavigationEntry(Entry):
    """What is known of the motion: sensors, the law's estimate, and the guard's certain set."""

    suite: Literal["none", "far", "near", "close"] = Field(
        default="none",
        description="sensors (docs/navigation.md); none: the true state, with the errors of `faults` on it",
    )
    estimate: Literal["filter", "observer", "raw"] = Field(
        default="filter",
        description="what the law flies by; filter: a Kalman filter of motion and disturbance; observer: the last "
        "samples and the law's own observer; raw: the last samples alone",
    )
    position_noise: NonNegative | None = Field(
        default=None, description="close: largest error of a position, m; unset: 0.05"
    )
    velocity_noise: NonNegative | None = Field(
        default=None, description="close: largest error of a velocity, m/s; unset: 0.002"
    )
    dropout: Annotated[float, Field(ge=0.0, lt=1.0)] | None = Field(
        default=None, description="probability that a sample is lost; unset: the suite's own"
    )
    most_missed: Annotated[int, Field(ge=0, le=20)] | None = Field(
        default=None, description="samples that can be lost in a row; unset: the suite's own"
    )
    initial_position_error: NonNegative | None = Field(
        default=None, description="largest error of the first estimate, m; unset: as where no sample is lost"
    )
    initial_velocity_error: NonNegative | None = Field(
        default=None, description="the same of its velocity, m/s; unset: likewise"
    )
