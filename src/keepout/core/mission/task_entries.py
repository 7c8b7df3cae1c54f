"""The tables of a scenario for more than one flight to one goal: approaches, many flights, exploring, inspecting.

An approach has legs from hold point to hold point, zones, corridors and rules; what they mean for law, guard and audit
is in docs/guard.md. All tables are data, as those of `entries.py`; the rooms that the tasks stand in read them.
"""

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import Annotated, Any, Literal

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
    "mesh": ("file",),
}
"""What each shape of a zone is made of; `core/fields/zones.py` and `core/audit/zones.py` have shapes of these names."""


class LegEntry(Entry):
    """A place where the chaser holds; the last is the goal.

    Attributes:
        name: Unset: the number.
        position: Hold point, m.
        axes: body; vvlh or inertial (ECI) where the target stands still in them.
        tolerance: The chaser is there while it is this near, m.
        dwell: Stay there without a break, s.
        until: "go": it flies on at this word only, of the caller on board, at `go_at` in simulation.
        go_at: When "go" is said, s; `until` needs it.
        speed_limit: On the way there, m/s; unset: chaser.speed_limit.
        within: [earliest, latest], s: not flown to before, and reached by then.
        drift_safe: Fly so slowly that drifts without thrust are proved clear for approach.abort_time.

    """

    name: Name | None = None
    position: Vector
    axes: Literal["body", "vvlh", "inertial"] = "body"
    tolerance: Positive = 0.5
    dwell: NonNegative = 0.0
    until: Literal["go"] | None = None
    go_at: NonNegative | None = None
    speed_limit: Positive | None = None
    within: Window | None = None
    drift_safe: bool = False

    def _contradictions(self) -> Iterator[str]:
        if (self.until is None) != (self.go_at is None):
            yield 'until = "go" and go_at, the time when it is said in simulation, belong together'
        if self.within is not None and self.within[0] >= self.within[1]:
            yield f"within {list(self.within)}: the first must be before the second"


class ZoneEntry(Entry):
    """Room that no part of the chaser may enter.

    Attributes:
        name: Unset: the number.
        shape: sphere, ellipsoid, box; cylinder or cone, along `axis`, the cone's end spherical; mesh, its parts' convex
            hulls.
        centre: Of a sphere or ellipsoid, a cylinder's first face, a cone's apex, m.
        radius: Of a sphere or cylinder, m.
        semi_axes: Of an ellipsoid, m.
        lower, upper: Corners of a box, m.
        axis: Of a cylinder or cone, any length.
        half_angle: Of a cone, from its axis, rad.
        length: Of a cylinder or cone, m.
        file: Of a mesh, from the scenario's folder.
        units: Of that file: m, cm, mm, in or ft; unset: as it says.
        sha256: Of that file; another is refused.
        axes: Of all numbers and the file: body, vvlh, or inertial (ECI), about the body frame's origin.
        start: From when it stands, s.
        until: Until when, s, or "go", said to the first leg that waits for it; unset: for ever.

    """

    name: Name | None = None
    shape: Literal["sphere", "ellipsoid", "box", "cylinder", "cone", "mesh"]
    centre: Vector | None = None
    radius: Positive | None = None
    semi_axes: tuple[Positive, Positive, Positive] | None = None
    lower: Vector | None = None
    upper: Vector | None = None
    axis: Vector | None = None
    half_angle: HalfAngle | None = None
    length: Positive | None = None
    file: str | None = None
    units: Literal["m", "cm", "mm", "in", "ft"] | None = None
    sha256: str | None = None
    axes: Literal["body", "vvlh", "inertial"] = "body"
    start: NonNegative = 0.0
    until: Moment | None = None

    def _contradictions(self) -> Iterator[str]:
        every = dict.fromkeys(part for parts in SHAPES.values() for part in parts)
        given = [part for part in every if getattr(self, part) is not None]
        if set(given) != set(SHAPES[self.shape]):
            parts = ", ".join(SHAPES[self.shape])
            yield f'shape "{self.shape}" is made of {parts}, and has {", ".join(given) or "none"}'
        for name in ("units", "sha256"):
            if getattr(self, name) is not None and self.file is None:
                yield f'{name} "{getattr(self, name)}": of the file of a mesh, and there is none'
        if self.axis is not None and not any(self.axis):
            yield "axis [0, 0, 0] points nowhere"
        if self.lower is not None and self.upper is not None and any(a >= b for a, b in zip(self.lower, self.upper)):
            yield f"lower {list(self.lower)} must be below upper {list(self.upper)}"
        if not isinstance(self.until, str) and self.until is not None and self.until <= self.start:
            yield f"until {self.until} s: it must be after start, {self.start} s"


class CorridorEntry(Entry):
    """Within `length` of a port the chaser's centre stays in a cone or a tube.

    Attributes:
        name: Unset: the number.
        port: Its place, body axes, m.
        axis: From the port outwards, body axes, any length.
        length: From the port, m.
        half_angle: Of the cone, from its axis, rad; unset: a tube.
        radius: Of the tube, which needs it, or of the cone at the port, m; unset: a point.
        clear_from: From this far along the axis, m, the inside is proved clear before the flight, and counts as clear;
            unset: the field counts.

    """

    name: Name | None = None
    port: Vector
    axis: Vector
    length: Positive
    half_angle: HalfAngle | None = None
    radius: Positive | None = None
    clear_from: NonNegative | None = None

    def _contradictions(self) -> Iterator[str]:
        if self.clear_from is not None and self.clear_from >= self.length:
            yield f"clear_from {self.clear_from} m: it must be less than length, {self.length} m"
        if self.half_angle is None and self.radius is None:
            yield "give half_angle of a cone, radius of a tube, or both of a cone that is so wide at the port"
        if not any(self.axis):
            yield "axis [0, 0, 0] points nowhere"


class ApproachEntry(Entry):
    """Speeds by distance, and how the chaser gets away.

    Attributes:
        speed_by_distance: Pairs [distance, m, largest speed, m/s], far ones first; linear between.
        distance_to: Point to which distances are, body axes, m; unset: the mesh, by the law's field, which says less.
        abort: retreat to the previous hold point, under the guard, or drift, all thrusters off, at `faults.abort_at`.
        abort_time: How long drifts without thrust should touch nothing, s.

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


Amount = float | Vector
"""A number, or one for each component of a vector."""
_WIDEST_IMAGE = 2.9
"""Widest angle of view, rad."""
_WIDEST = math.radians(170.0)
"""Of a camera's cone, rad."""
_STEEPEST = math.radians(89.0)
"""Of the angle to a patch's normal at which a camera looks, rad."""
_LOWEST_SUN = math.radians(89.9)
"""Of the angle to a patch's normal at which the sun shines, rad."""


class RareEntry(Entry):
    """Starts that `keepout rare` draws beside the faults.

    Attributes:
        start_position_std, start_velocity_std: Standard deviation of each axis of the start, m, m/s.

    """

    start_position_std: NonNegative = 0.0
    start_velocity_std: NonNegative = 0.0


class DispersionEntry(Entry):
    """How one entry varies: by one of `uniform`, `normal`, `choice` and `sphere`.

    Attributes:
        uniform: [least, largest]; of a vector: two corners of a box.
        normal: [mean, standard deviation]; of a vector: of each component.
        within: Standard deviations at which normal is cut off.
        choice: Values to choose from.
        weights: Relative, of the values of choice; unset: all alike.
        sphere: Length of a vector of any direction, or [least, largest].
        centre: Vector that sphere's is added to.

    """

    uniform: tuple[Amount, Amount] | None = None
    normal: tuple[Amount, Amount] | None = None
    within: Annotated[float, Field(gt=0.0, le=8.0)] = 3.0
    choice: tuple[Any, ...] | None = None
    weights: tuple[NonNegative, ...] | None = None
    sphere: NonNegative | tuple[NonNegative, NonNegative] | None = None
    centre: Vector = (0.0, 0.0, 0.0)

    def _contradictions(self) -> Iterator[str]:
        kinds = ("uniform", "normal", "choice", "sphere")
        given = [kind for kind in kinds if getattr(self, kind) is not None]
        if len(given) != 1:
            yield f"needs one of {', '.join(kinds)}, and has {' and '.join(given) or 'none'}"
        for key, of in (("within", "normal"), ("weights", "choice"), ("centre", "sphere")):
            if getattr(self, key) != type(self).model_fields[key].default and of != given[0]:
                yield f"{key} is for {of}, and this is {given[0]}"
        for kind in ("uniform", "sphere"):
            ends = getattr(self, kind)
            if isinstance(ends, tuple):
                pairs = zip(*(end if isinstance(end, tuple) else (end,) for end in ends))
                if not all(-float("inf") < low <= high < float("inf") for low, high in pairs):
                    yield f"{kind} {list(ends)}: finite, and the first must not exceed the second"
        if self.normal is not None:
            spread = self.normal[1] if isinstance(self.normal[1], tuple) else (self.normal[1],)
            if not all(0.0 <= part < float("inf") for part in spread):
                yield f"normal: a standard deviation of {self.normal[1]}; it must be finite and at least 0"
        if self.choice is not None and not self.choice:
            yield "choice: no values to choose from"
        if self.weights is not None and (len(self.weights) != len(self.choice or ()) or not sum(self.weights) > 0.0):
            yield f"weights: {list(self.weights)}; one for each value of choice, not all 0"


class CampaignEntry(Entry):
    """Many flights: from rest at random in a box, or with `dispersions` drawn for each.

    Attributes:
        runs: Flights.
        lower, upper: Corners of the box of starts at rest, body axes, m, without dispersions.
        sampling: Of dispersed numbers: random, latin-hypercube or sobol.
        dispersions: Entries that vary, by name: `"chaser.mass" = {uniform = [18, 22]}`.

    """

    runs: Annotated[int, Field(ge=1, le=1_000_000_000)] = 100
    lower: Vector = (-15.0, -5.0, -4.0)
    upper: Vector = (15.0, 5.0, -4.0)
    sampling: Literal["random", "latin-hypercube", "sobol"] = "random"
    dispersions: dict[str, DispersionEntry] = Field(default_factory=dict)

    def _contradictions(self) -> Iterator[str]:
        if any(low > high for low, high in zip(self.lower, self.upper)):
            yield f"lower {list(self.lower)} must not exceed upper {list(self.upper)}"


class RequireEntry(Entry):
    """What a flight, or a campaign's, must show; else the exit code is 3.

    Attributes:
        contact: "proved": nothing was touched.
        certified: The guard's theorem must hold from the start.
        clearance_m: Least clearance that the audit proves.
        delta_v_mps: Greatest Δv.
        time_s: By when the goal must be reached.
        reached: The goal must be reached.
        zones: "proved": no zone was entered, no corridor left.
        holds: Every leg must be reached in its window, and held for its dwell.
        share: Of a campaign's runs that meet each, by the lower end of the 95 % interval; unset: all.

    """

    contact: Literal["proved"] | None = None
    certified: bool = False
    clearance_m: Annotated[float, Field(allow_inf_nan=False)] | None = None
    delta_v_mps: NonNegative | None = None
    time_s: Positive | None = None
    reached: bool = False
    zones: Literal["proved"] | None = None
    holds: bool = False
    share: Annotated[float, Field(gt=0.0, lt=1.0)] | None = None


class DepthSensorEntry(Entry):
    """A camera that measures distances (lidar, stereo), and its promises.

    Attributes:
        width, height: Pixels across and down.
        field_of_view: From left to right edge, rad.
        rays_across: Rays along a pixel's edge, whose first return it tells.
        period, latency: Time between images, and from one to its use, s; whole control periods.
        mounting: From the chaser's centre, camera axes, m.
        least_range, greatest_range: In m: nearer returns say nothing, farther surface returns none.
        range_error: Largest error of a range, m.
        position_error, attitude_error: Largest error of the pose in the map's frame, with drift, m, rad.
        surely_returned_width: Parts this wide surely return a ray within the range used, m.
        sure_empty_range: A ray without return is empty out to this range, m; 0: it says nothing.
        dropout: Probability that a return is lost, which the sensor says.
        grazing_angle: Incidence beyond which returns are lost, which the sensor says, rad.
        turn_rate, turn_acceleration: Of the boresight, at most, rad/s, rad/s².
        errors: random, or adversarial: at their bounds with the worst signs.
        broken: Promise that it breaks: "range" or "pose" error twice the bound; "mixed" ranges of near and far;
            "losses" that look like no return; "late" images; "none".

    """

    width: Annotated[int, Field(ge=8, le=4096)] = 160
    height: Annotated[int, Field(ge=8, le=4096)] = 120
    field_of_view: Annotated[float, Field(gt=0.0, le=_WIDEST_IMAGE)] = math.pi / 3.0
    rays_across: Annotated[int, Field(ge=1, le=9)] = 5
    period: Positive = 10.0
    latency: NonNegative = 0.0
    mounting: Vector = (0.0, 0.0, 0.0)
    least_range: Positive = 0.3
    greatest_range: Positive = 15.0
    range_error: NonNegative = 0.03
    position_error: NonNegative = 0.05
    attitude_error: NonNegative = 0.005
    surely_returned_width: Positive = 0.03
    sure_empty_range: NonNegative = 15.0
    dropout: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.001
    grazing_angle: Annotated[float, Field(gt=0.0, le=math.pi / 2.0)] = 1.48
    turn_rate: Positive = 0.05
    turn_acceleration: Positive = 0.001
    errors: Literal["random", "adversarial"] = "random"
    broken: Literal["none", "range", "pose", "mixed", "losses", "late"] = "none"

    def _contradictions(self) -> Iterator[str]:
        if self.least_range >= self.greatest_range:
            yield f"least_range {self.least_range} m, greatest_range {self.greatest_range} m; nothing is between them"


class MapEntry(Entry):
    """The room that was seen free; all other is an obstacle.

    Attributes:
        centre: Of the ball that holds the target, body axes, m.
        radius: Of that ball, m; `keepout explore` needs it.
        spacing: Edge of the map's cubes, m.
        cap: Greatest distance told apart, m, in whole spacings; unset: 1.5, rounded up.
        file: A .keepmap file to go on from.

    """

    centre: Vector = (0.0, 0.0, 0.0)
    radius: Positive | None = None
    spacing: Positive = 0.1
    cap: Positive | None = None
    file: str | None = None


class ExploreEntry(Entry):
    """What `keepout explore` flies for, and when it ends.

    Attributes:
        towards: goal: open a way and fly there; all round: see all that can be seen.
        most_views: Most images.
        explained: Unknown cubes this near to a return count as seen surface, m.
        expected: Built-in target or mesh file; departures from it are reported.
        expected_units: Of that file: m, cm, mm, in or ft.

    """

    towards: Literal["goal", "all round"] = "goal"
    most_views: Annotated[int, Field(ge=1, le=100_000)] = 400
    explained: Positive = 0.35
    expected: str | None = None
    expected_units: Literal["m", "cm", "mm", "in", "ft"] | None = None


class CameraEntry(Entry):
    """The camera at the chaser's centre, which turns on its own.

    Attributes:
        field_of_view: Full angle of the cone, rad.
        pixels: Across the cone.
        least_range: In m; nearer surface is not sharp.
        greatest_range: In m; farther surface does not count.
        greatest_incidence: From a patch's normal to the camera, rad.
        greatest_sample_distance: Of samples along the surface's slant, m a pixel; unset: any.
        period: Time between frames, s; whole control periods.
        turn_rate, turn_acceleration: Of the boresight, at most, rad/s, rad/s².

    """

    field_of_view: Annotated[float, Field(gt=0.0, le=_WIDEST)] = math.radians(60.0)
    pixels: Annotated[int, Field(ge=8, le=65536)] = 1024
    least_range: Positive = 0.3
    greatest_range: Annotated[float, Field(gt=0.0, le=1e6)] = 10.0
    greatest_incidence: Annotated[float, Field(gt=0.0, le=_STEEPEST)] = math.radians(60.0)
    greatest_sample_distance: Positive | None = None
    period: Positive = 5.0
    turn_rate: Positive = math.radians(1.0)
    turn_acceleration: Positive = 0.002

    def _contradictions(self) -> Iterator[str]:
        if self.least_range >= self.greatest_range:
            yield f"least_range {self.least_range} m, greatest_range {self.greatest_range} m; nothing is between them"


class LightEntry(Entry):
    """The light that a patch must be in to count as seen.

    Attributes:
        kind: none: it does not matter; fixed: from `direction`; sun: by epoch, orbit and attitude, not while the Earth
            hides any of it.
        direction: Towards the light, body axes, any length; fixed needs it.
        greatest_incidence: From a patch's normal to the light, rad.

    """

    kind: Literal["none", "fixed", "sun"] = "none"
    direction: Vector | None = None
    greatest_incidence: Annotated[float, Field(gt=0.0, le=_LOWEST_SUN)] = math.radians(80.0)

    def _contradictions(self) -> Iterator[str]:
        if self.kind == "fixed" and self.direction is None:
            yield 'kind = "fixed" needs direction = [x, y, z], towards the light in the body frame'
        if self.direction is not None and not any(self.direction):
            yield "direction [0, 0, 0] points nowhere; give a vector towards the light"


class ProtectedEntry(Entry):
    """A ball or box that no plume may reach.

    Attributes:
        centre: Of the ball, body axes, m.
        radius: Of the ball, m; 0: a point.
        lower, upper: Corners of the box, body axes, m.

    """

    centre: Vector | None = None
    radius: NonNegative | None = None
    lower: Vector | None = None
    upper: Vector | None = None

    def _contradictions(self) -> Iterator[str]:
        given = [name for name in ("centre", "radius", "lower", "upper") if getattr(self, name) is not None]
        if given not in (["centre", "radius"], ["lower", "upper"]):
            yield f"{', '.join(given) or 'nothing'}: give centre and radius of a ball, or lower and upper of a box"
        lower, upper = self.lower or (), self.upper or ()
        if any(low > high for low, high in zip(lower, upper)):
            yield f"lower {list(lower)} must not exceed upper {list(upper)}"


class HoldPointEntry(Entry):
    """A place where the chaser rests first, in this order.

    Attributes:
        position: The place, body axes, m.
        seconds: How long it is held, s.

    """

    position: Vector
    seconds: Positive = 60.0


class InspectEntry(Entry):
    """What `keepout inspect` sees, and the operator's limits.

    Attributes:
        stand_off: Least distance of the chaser's centre from the surface, m.
        patch_size: Edge of the patches, seen wholly or not at all, m; unset: 0.25; 1.0 of a target beyond 80 m; a tenth
            of one below 2.5 m.
        coverage: Share of the area that can be seen and lit in time, at which the flight ends.
        tour: plan: the views that cover most, in the best order; circumnavigation: natural motion.
        objective: What the views' order makes least: time, delta_v, or both, time + delta_v_worth × Δv.
        delta_v_worth: Price of Δv in both, s per m/s.
        candidates: Most places considered for views.
        most_views: Most views in one plan.
        dwell: Stay at each view, s.
        proof_squares: Most squares of directions to prove what can be seen.
        proof_time: Most time for that proof, s; one cut short depends on the machine, and results say so.
        passive_safety: How long drifts without thrust touch nothing, s.
        plume_half_angle: Of a plume, from its axis, rad.
        plume_range: Beyond it a plume harms nothing, m; unset: it always does.
        no_thrust_towards: Parts of the target that no plume may reach.
        hold_points: Places where the chaser is held first.

    """

    stand_off: Positive = 1.5
    patch_size: Positive | None = None
    coverage: Annotated[float, Field(gt=0.0, le=1.0)] = 1.0
    tour: Literal["plan", "circumnavigation"] = "plan"
    objective: Literal["time", "delta_v", "both"] = "time"
    delta_v_worth: Positive = 1000.0
    candidates: Annotated[int, Field(ge=1, le=1_000_000)] = 4000
    most_views: Annotated[int, Field(ge=1, le=100_000)] = 1000
    dwell: NonNegative = 0.0
    proof_squares: Annotated[int, Field(ge=1, le=10_000_000_000)] = 4_000_000
    proof_time: NonNegative | None = None
    passive_safety: NonNegative = 0.0
    plume_half_angle: Annotated[float, Field(gt=0.0, le=math.pi / 2.0)] = math.radians(20.0)
    plume_range: Positive | None = None
    no_thrust_towards: tuple[ProtectedEntry, ...] = ()
    hold_points: tuple[HoldPointEntry, ...] = ()

    def _contradictions(self) -> Iterator[str]:
        worth = type(self).model_fields["delta_v_worth"].default
        if self.delta_v_worth != worth and self.objective != "both":
            yield (
                f'delta_v_worth {self.delta_v_worth} s per m/s is for objective = "both", and objective is '
                f'"{self.objective}"'
            )
