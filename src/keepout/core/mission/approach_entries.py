"""The tables of a scenario for a rendezvous: legs from hold point to hold point, zones, corridors, approach rules.

They are data, as those of `entries.py`. What they mean for law, guard and audit is in docs/guard.md.
"""

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import Annotated, Literal

from pydantic import Field

from keepout.core.mission.entries import Entry, NonNegative, Positive, Vector

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9 _.-]*$")]
Window = tuple[NonNegative, Positive]
HalfAngle = Annotated[float, Field(gt=0.0, lt=math.pi / 2.0)]
Moment = NonNegative | Literal["go"]

SHAPES: dict[str, tuple[str, ...]] = {
    "sphere": ("centre", "radius"),
    "ellipsoid": ("centre", "semi_axes"),
    "box": ("lower", "upper"),
    "cylinder": ("centre", "axis", "radius", "length"),
    "cone": ("centre", "axis", "half_angle", "length"),
}
"""What each shape of a zone is made of; `core/fields/zones.py` and `core/audit/zones.py` have shapes of these names."""


class LegEntry(Entry):
    """A place where the chaser holds; the last is the goal.

    Attributes:
        name: In tables, plots and refusals; unset: the number.
        position: Hold point, m.
        axes: Of `position`: body, or vvlh, if the target stands still in it.
        tolerance: The chaser is there while it is closer than this, m.
        dwell: How long it stays there without a break, s.
        until: "go": it flies on only at this word, on board the caller's, in simulation at `go_at`.
        go_at: When "go" is said in simulation, s; `until` needs it.
        speed_limit: On the way to this place, m/s; unset: chaser.speed_limit.
        within: [earliest, latest], s: not flown to before, and reached by then.

    """

    name: Name | None = None
    position: Vector
    axes: Literal["body", "vvlh"] = "body"
    tolerance: Positive = 0.5
    dwell: NonNegative = 0.0
    until: Literal["go"] | None = None
    go_at: NonNegative | None = None
    speed_limit: Positive | None = None
    within: Window | None = None

    def _contradictions(self) -> Iterator[str]:
        if (self.until is None) != (self.go_at is None):
            yield 'until = "go" and go_at, the time when it is said in simulation, belong together'
        if self.within is not None and self.within[0] >= self.within[1]:
            yield f"within {list(self.within)}: the first must be before the second"


class ZoneEntry(Entry):
    """Room that no part of the chaser may enter while the zone stands.

    Attributes:
        name: In tables, plots and refusals; unset: the number.
        shape: Cylinder and cone go from `centre` along `axis`; a cone ends in a sphere's part.
        centre: Of a sphere, ellipsoid, cylinder's first face, or the apex of a cone, m.
        radius: Of a sphere or cylinder, m.
        semi_axes: Of an ellipsoid, m.
        lower, upper: Corners of a box, m.
        axis: Of a cylinder or cone, any length.
        half_angle: From a cone's axis to its side, rad.
        length: Of a cylinder or cone, m.
        axes: Of these numbers, about the body frame's origin: body, vvlh, or inertial (ECI).
        start: From when the zone stands, s.
        until: Until when it stands, s, or "go", said to the first leg that waits for it; unset: for ever.

    """

    name: Name | None = None
    shape: Literal["sphere", "ellipsoid", "box", "cylinder", "cone"]
    centre: Vector | None = None
    radius: Positive | None = None
    semi_axes: tuple[Positive, Positive, Positive] | None = None
    lower: Vector | None = None
    upper: Vector | None = None
    axis: Vector | None = None
    half_angle: HalfAngle | None = None
    length: Positive | None = None
    axes: Literal["body", "vvlh", "inertial"] = "body"
    start: NonNegative = 0.0
    until: Moment | None = None

    def _contradictions(self) -> Iterator[str]:
        every = dict.fromkeys(part for parts in SHAPES.values() for part in parts)
        given = [part for part in every if getattr(self, part) is not None]
        if set(given) != set(SHAPES[self.shape]):
            parts = ", ".join(SHAPES[self.shape])
            yield f'shape "{self.shape}" is made of {parts}, and has {", ".join(given) or "none"}'
        if self.axis is not None and not any(self.axis):
            yield "axis [0, 0, 0] points nowhere"
        if self.lower is not None and self.upper is not None and any(a >= b for a, b in zip(self.lower, self.upper)):
            yield f"lower {list(self.lower)} must be below upper {list(self.upper)}"
        if not isinstance(self.until, str) and self.until is not None and self.until <= self.start:
            yield f"until {self.until} s: it must be after start, {self.start} s"


class CorridorEntry(Entry):
    """Within `length` of a port the chaser's centre stays in a cone, or a tube, outwards from it.

    Attributes:
        name: In tables, plots and refusals; unset: the number.
        port: Place of the port, body axes, m.
        axis: From the port outwards, body axes, any length.
        length: Distance from the port within which the corridor binds, m.
        half_angle: From the cone's axis to its side, rad; unset: a tube.
        radius: Of the tube, which needs it, or of the cone at the port, m; unset: the cone begins as a point.

    """

    name: Name | None = None
    port: Vector
    axis: Vector
    length: Positive
    half_angle: HalfAngle | None = None
    radius: Positive | None = None

    def _contradictions(self) -> Iterator[str]:
        if self.half_angle is None and self.radius is None:
            yield "give half_angle of a cone, radius of a tube, or both of a cone that is so wide at the port"
        if not any(self.axis):
            yield "axis [0, 0, 0] points nowhere"


class ApproachEntry(Entry):
    """Speeds by distance, and how the chaser gets away.

    Attributes:
        speed_by_distance: Pairs [distance, m, largest speed, m/s], far ones first; linear between.
        distance_to: Point to which distances are, body axes, m; unset: the mesh, by the law's field, which says less.
        abort: At `faults.abort_at`: retreat to the previous hold point, under the guard; or drift, all thrusters off,
            so that no guard can act.
        abort_time: How long a chaser that stops thrusting should touch nothing, s, judged every few seconds.

    """

    abort: Literal["retreat", "drift"] = "retreat"
    abort_time: Positive | None = None
    speed_by_distance: tuple[tuple[NonNegative, Positive], ...] = ()
    distance_to: Vector | None = None

    def _contradictions(self) -> Iterator[str]:
        for (far, fast), (near, slow) in pairwise(self.speed_by_distance):
            if near >= far or slow > fast:
                yield (
                    f"speed_by_distance: [{near}, {slow}] after [{far}, {fast}]: distances must fall, and speeds must "
                    "not rise with them"
                )
