"""The tables of a scenario whose target is seen and mapped in flight: depth sensor, map, and what is explored."""

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from keepout.core.mission.entries import Entry, NonNegative, Positive, Vector

_STEEPEST = 2.9
"""Widest angle of view, rad."""


class DepthSensorEntry(Entry):
    """A camera that measures distances (lidar, stereo), and what it promises (docs/depth-sensor.md)."""

    width: Annotated[int, Field(ge=8, le=4096)] = Field(default=160, description="pixels in a row")
    height: Annotated[int, Field(ge=8, le=4096)] = Field(default=120, description="rows of pixels")
    field_of_view: Annotated[float, Field(gt=0.0, le=_STEEPEST)] = Field(
        default=math.pi / 3.0, description="angle between the left and the right edge of the image, rad"
    )
    rays_across: Annotated[int, Field(ge=1, le=9)] = Field(
        default=5, description="rays along a pixel's edge; a pixel tells the first return of all its rays"
    )
    period: Positive = Field(default=10.0, description="between two images, s; whole control periods")
    latency: NonNegative = Field(default=0.0, description="from an image to its use, s; whole control periods")
    mounting: Vector = Field(
        default=(0.0, 0.0, 0.0), description="of the sensor from the chaser's centre, in camera axes, m"
    )
    least_range: Positive = Field(default=0.3, description="m; what is nearer says nothing")
    greatest_range: Positive = Field(default=15.0, description="m; what is farther does not return")
    range_error: NonNegative = Field(default=0.03, description="largest error of a range, m")
    position_error: NonNegative = Field(
        default=0.05, description="largest error of the sensor's place in the map's frame, drift included, m"
    )
    attitude_error: NonNegative = Field(
        default=0.005, description="largest error of the sensor's attitude in the map's frame, drift included, rad"
    )
    surely_returned_width: Positive = Field(
        default=0.03, description="parts at least this wide surely return a ray within the range used, m"
    )
    sure_empty_range: NonNegative = Field(
        default=15.0, description="a ray without return is empty out to here, m; 0: no return says nothing"
    )
    dropout: Annotated[float, Field(ge=0.0, lt=1.0)] = Field(
        default=0.001, description="probability that a return is lost; the sensor says that it was"
    )
    grazing_angle: Annotated[float, Field(gt=0.0, le=math.pi / 2.0)] = Field(
        default=1.48, description="incidence beyond which a return is lost, rad; the sensor says that it was"
    )
    turn_rate: Positive = Field(default=0.05, description="largest rate at which the boresight turns, rad/s")
    turn_acceleration: Positive = Field(default=0.001, description="largest rate of change of that, rad/s²")
    errors: Literal["random", "adversarial"] = Field(
        default="random", description="how errors are drawn: within their bounds, or at them with the worst signs"
    )
    broken: Literal["none", "range", "pose", "mixed", "losses", "late"] = Field(
        default="none",
        description="which promise is broken: range or pose error twice the bound, ranges that mix near and far, lost "
        "returns that look like no return, an image of another time",
    )

    @model_validator(mode="after")
    def _ranges_are_ordered(self) -> "DepthSensorEntry":
        if self.least_range >= self.greatest_range:
            raise ValueError(
                f"least_range {self.least_range} m, greatest_range {self.greatest_range} m; nothing is between them"
            )
        return self


class MapEntry(Entry):
    """The map of room that was seen free; what was not is an obstacle (docs/mapping.md)."""

    centre: Vector = Field(default=(0.0, 0.0, 0.0), description="of the ball that holds the whole target, m")
    radius: Positive | None = Field(
        default=None, description="of that ball, m; `keepout explore` asks for it, since nobody knows the target"
    )
    spacing: Positive = Field(default=0.1, description="edge of the cubes, m")
    cap: Positive | None = Field(
        default=None,
        description="greatest distance that the map tells apart, m, whole spacings; unset: 1.5, rounded up to them",
    )
    file: str | None = Field(default=None, description="a .keepmap file to go on from")


class ExploreEntry(Entry):
    """What `keepout explore` flies for, and when it ends."""

    towards: Literal["goal", "all round"] = Field(
        default="goal", description="goal: open a way to goal.position and fly there; all round: see what can be seen"
    )
    most_views: Annotated[int, Field(ge=1, le=100_000)] = Field(default=400, description="images at most")
    explained: Positive = Field(
        default=0.35, description="an unknown cube this near to a return belongs to the seen surface, m"
    )
    expected: str | None = Field(
        default=None,
        description="a built-in target's name or a mesh file: what the mission believes; where the seen surface "
        "departs from it is reported",
    )
    expected_units: Literal["m", "cm", "mm", "in", "ft"] | None = Field(
        default=None, description="length unit of that file"
    )
