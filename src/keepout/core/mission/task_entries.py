"""The tables of a scenario for tasks of more than one flight to one goal: many flights, exploring, inspecting.

They are data, as those of `entries.py`; the rooms that the tasks stand in read them.
"""

import math
from collections.abc import Iterator
from typing import Annotated, Any, Literal

from pydantic import Field

from keepout.core.mission.entries import Entry, NonNegative, Positive, Vector

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
    """What `keepout rare` draws beside the scenario's faults.

    Attributes:
        start_position_std: standard deviation of each axis of the start about start.position, m.
        start_velocity_std: the same about start.velocity, m/s.

    """

    start_position_std: NonNegative = 0.0
    start_velocity_std: NonNegative = 0.0


class DispersionEntry(Entry):
    """How one entry varies from run to run of a campaign: one of `uniform`, `normal`, `choice` and `sphere`.

    Attributes:
        uniform: [least, largest]; of a vector: two corners of a box.
        normal: [mean, standard deviation], cut off at `within`; of a vector: each component.
        within: of normal: cut off at so many standard deviations.
        choice: values to choose from.
        weights: of choice: how often each, relative to the others; unset: all alike.
        sphere: of a vector: any direction, with this length or one between [least, largest].
        centre: of sphere: what the vector is added to.

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
    """Many flights: from random starts at rest in a box, or with whatever `dispersions` names drawn anew for each.

    Attributes:
        runs: how many flights.
        lower: lower corner of the box of starts, m; without dispersions.
        upper: upper corner of the box of starts, m; without dispersions.
        sampling: how the dispersed numbers are drawn, over all of them together.
        dispersions: what varies, by dotted name: `"chaser.mass" = {uniform = [18, 22]}`; see docs/campaigns.md.

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
    """What must come of a flight, or of a campaign's flights; a command that finds otherwise ends with exit code 3.

    Attributes:
        contact: "proved": the audit proves that nothing was touched; unset: not asked.
        certified: whether the guard's theorem must hold from the start.
        clearance_m: least clearance that the audit must prove, m.
        delta_v_mps: greatest Δv, m/s.
        time_s: by which the goal must be reached, s.
        reached: whether the goal must be reached.
        zones: "proved": the audit proves that no zone was entered and no corridor left; unset: not asked.
        holds: whether every leg's place must be held for its dwell, and reached in its window.
        share: of a campaign's runs that must meet each of these, judged by the lower end of its 95 % interval; unset:
            every run.

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
    """A camera that measures distances (lidar, stereo), and what it promises (docs/depth-sensor.md).

    Attributes:
        width: pixels in a row.
        height: rows of pixels.
        field_of_view: angle between the left and the right edge of the image, rad.
        rays_across: rays along a pixel's edge; a pixel tells the first return of all its rays.
        period: between two images, s; whole control periods.
        latency: from an image to its use, s; whole control periods.
        mounting: of the sensor from the chaser's centre, in camera axes, m.
        least_range: m; what is nearer says nothing.
        greatest_range: m; what is farther does not return.
        range_error: largest error of a range, m.
        position_error: largest error of the sensor's place in the map's frame, drift included, m.
        attitude_error: largest error of the sensor's attitude in the map's frame, drift included, rad.
        surely_returned_width: parts at least this wide surely return a ray within the range used, m.
        sure_empty_range: a ray without return is empty out to here, m; 0: no return says nothing.
        dropout: probability that a return is lost; the sensor says that it was.
        grazing_angle: incidence beyond which a return is lost, rad; the sensor says that it was.
        turn_rate: largest rate at which the boresight turns, rad/s.
        turn_acceleration: largest rate of change of that, rad/s².
        errors: how errors are drawn: within their bounds, or at them with the worst signs.
        broken: which promise is broken: range or pose error twice the bound, ranges that mix near and far, lost returns
            that look like no return, an image of another time.

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
    """The map of room that was seen free; what was not is an obstacle (docs/mapping.md).

    Attributes:
        centre: of the ball that holds the whole target, m.
        radius: of that ball, m; `keepout explore` asks for it, since nobody knows the target.
        spacing: edge of the cubes, m.
        cap: greatest distance that the map tells apart, m, whole spacings; unset: 1.5, rounded up to them.
        file: a .keepmap file to go on from.

    """

    centre: Vector = (0.0, 0.0, 0.0)
    radius: Positive | None = None
    spacing: Positive = 0.1
    cap: Positive | None = None
    file: str | None = None


class ExploreEntry(Entry):
    """What `keepout explore` flies for, and when it ends.

    Attributes:
        towards: goal: open a way to goal.position and fly there; all round: see what can be seen.
        most_views: images at most.
        explained: an unknown cube this near to a return belongs to the seen surface, m.
        expected: a built-in target's name or a mesh file: what the mission believes; where the seen surface departs
            from it is reported.
        expected_units: length unit of that file.

    """

    towards: Literal["goal", "all round"] = "goal"
    most_views: Annotated[int, Field(ge=1, le=100_000)] = 400
    explained: Positive = 0.35
    expected: str | None = None
    expected_units: Literal["m", "cm", "mm", "in", "ft"] | None = None


class CameraEntry(Entry):
    """A camera at the chaser's centre that turns on its own, and what a frame must show of a patch (docs/seeing.md).

    Attributes:
        field_of_view: full angle of the cone about the boresight that counts, rad.
        pixels: across that cone.
        least_range: m; what is nearer is not sharp.
        greatest_range: m; what is farther does not count.
        greatest_incidence: from a patch's normal to the camera, rad.
        greatest_sample_distance: on the surface, along its slant, m a pixel; unset: however coarse.
        period: between two frames, s; whole control periods.
        turn_rate: largest rate at which the boresight turns, rad/s.
        turn_acceleration: largest rate of change of that, rad/s2.

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
        kind: none: light does not matter; fixed: from `direction` all the time; sun: as it stands over the target from
            epoch, orbit and attitude (table sun), and not while the Earth hides any of it.
        direction: fixed: towards the light, in the target's body frame, any length.
        greatest_incidence: from a patch's normal to the light, rad.

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
    """A part of the target that no thruster's plume may reach: a ball, or a box along the body axes.

    Attributes:
        centre: of the ball, body frame, m.
        radius: of the ball, m; 0: a point.
        lower: lower corner of the box, body frame, m.
        upper: upper corner of the box, body frame, m.

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
    """A place where the chaser comes to rest, in the order given, before any view is flown to.

    Attributes:
        position: body frame, m.
        seconds: for which it is held, s.

    """

    position: Vector
    seconds: Positive = 60.0


class InspectEntry(Entry):
    """What `keepout inspect` is to see, by which tour, and the operator's limits (docs/inspection.md).

    Attributes:
        stand_off: least distance of the chaser's centre from the target's surface, m.
        patch_size: edge of the surface's patches, each seen wholly or not at all, m; unset: 0.25, for a target longer
            than 80 m 1.0, and for one shorter than 2.5 m a tenth of that length.
        coverage: share wanted of the area that can be seen, and be lit in time; then the flight ends.
        tour: plan: the views that cover most, in the best order; nearest: always the nearest view that shows something
            new; circumnavigation: natural motion round the target.
        objective: what the order of the views makes least; both: time + delta_v_worth × Δv.
        delta_v_worth: objective both: what Δv costs, s per m/s.
        candidates: places from which views are considered, at most.
        most_views: in one plan, at most.
        dwell: for which the chaser stays at each view, s; 0: it flies on.
        proof_squares: squares of directions looked at, at most, for the proof of what can and cannot be seen: counted
            work, the same on every machine.
        proof_time: by the clock, at most, for that proof, s; where it ends the proof, results say so, and differ from
            machine to machine; unset: no clock.
        passive_safety: for which a chaser that stops thrusting anywhere on its way touches nothing, s.
        plume_half_angle: of the cone of a thruster's plume, rad.
        plume_range: beyond which a plume harms nothing, m; unset: however far.
        no_thrust_towards: parts of the target that no plume may reach, each a ball or a box.
        hold_points: where the chaser is held first, each with position and seconds.

    """

    stand_off: Positive = 1.5
    patch_size: Positive | None = None
    coverage: Annotated[float, Field(gt=0.0, le=1.0)] = 1.0
    tour: Literal["plan", "nearest", "circumnavigation"] = "plan"
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
