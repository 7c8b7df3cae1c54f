"""What one inspection is about: the target in patches, what can be seen of it, what is still wanted; what is refused.

What no flight could make good is refused before anything flies: first by the entries alone, then by the mesh
(`require_inspectable`), by its patches (`require_light`), by the field that the law flies by (`require_stand_off`), and
at last by what can be seen of it at all (`require_something_to_see`).
"""

import functools
import math
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from keepout.apps.inspection.light import Camera, Light
from keepout.apps.inspection.limits import Protected
from keepout.apps.inspection.seeing.patches import MOST_PATCHES, Marks, Patches, Units, cut
from keepout.apps.inspection.seeing.room import Measure, Room
from keepout.apps.inspection.seeing.seeable import Hidden, Seeable, seeable
from keepout.apps.inspection.seeing.sightlines import Sightlines
from keepout.apps.inspection.seeing.visible import SeeingRules
from keepout.apps.inspection.ways import MOST_NODES, Ways
from keepout.apps.inspection.zones import mesh_and_zones
from keepout.apps.led.camera import Boresight
from keepout.core.control.profiles import least_offset
from keepout.core.errors import InspectionError
from keepout.core.geometry.distance import Point
from keepout.core.geometry.target import Target
from keepout.core.mission.approach import require_one_leg, require_outside_zones
from keepout.core.mission.law import room_for_guard
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.core.progress import Progress, part_of, silent

_PATCH, _LARGE_PATCH = 0.25, 1.0
"""Edge of the patches, m, where the scenario leaves it open."""
_LONG = 80.0
"""Metres along the longest edge of its box beyond which a target is cut into large patches."""
_ACROSS = 10
"""Patches along that edge of a small target."""
_FINE_NODES = 4_000_000
_ATTEMPTS = 2
"""Tours that may promise a unit and not show it before it is given up."""
_ROUNDING = 1e-12


def rules_of(scenario: Scenario) -> SeeingRules:
    """Give the limits of a scenario's camera and light."""
    camera, finest = scenario.camera, scenario.camera.greatest_sample_distance
    return SeeingRules(
        field_of_view=camera.field_of_view,
        pixels=camera.pixels,
        least_range=camera.least_range,
        greatest_range=camera.greatest_range,
        greatest_incidence=camera.greatest_incidence,
        greatest_sample_distance=math.inf if finest is None else finest,
        greatest_sun_incidence=scenario.light.greatest_incidence,
    )


def boresight_of(scenario: Scenario, target: Target) -> Boresight:
    """Give the camera's boresight at the start: at rest, towards the middle of the target's box."""
    middle = 0.5 * (target.vertices.min(axis=0) + target.vertices.max(axis=0))
    towards = middle - np.asarray(scenario.start.position)
    return Boresight.at_rest(
        towards if towards.any() else np.array([1.0, 0.0, 0.0]),
        greatest_rate=scenario.camera.turn_rate,
        greatest_acceleration=scenario.camera.turn_acceleration,
    )


def patch_size(scenario: Scenario, target: Target) -> float:
    """Give the edge of the surface's patches, m: the scenario's, or by the longest edge of the target's box."""
    if scenario.inspect.patch_size is not None:
        return scenario.inspect.patch_size
    longest = float(np.max(target.vertices.max(axis=0) - target.vertices.min(axis=0)))
    return _LARGE_PATCH if longest > _LONG else min(_PATCH, longest / _ACROSS)


def frame_times(scenario: Scenario) -> Float[np.ndarray, " frames"]:
    """Give the times (s) at which frames are taken over the whole duration."""
    end = scenario.steps * scenario.control.period
    return scenario.camera.period * np.arange(math.floor(end / scenario.camera.period + 1e-9) + 1)


def require_inspectable(scenario: Scenario, target: Target, *, room: Room | None = None) -> Room:
    """Refuse a camera that can never see, limits that contradict each other, and a start that is not allowed.

    Args:
        scenario: as flown.
        target: its mesh.
        room: where the chaser's centre may be, where that is known already.

    Returns:
        room: that, worked out here where it was not known.

    Raises:
        InspectionError: the message names the entry, its value, and what would be valid.

    """
    require_one_leg(scenario, "an inspection is led by its plan of views", zones=True)
    _require_times(scenario)
    if scenario.light.direction is not None and scenario.light.kind != "fixed":
        raise InspectionError(
            f'light.direction: {list(scenario.light.direction)}, and light.kind is "{scenario.light.kind}"; '
            'a direction belongs to "fixed"'
        )
    if target.ball_radius > 0.0:
        raise InspectionError(f"target: {target.name} is a point cloud, which has no surface to see; give a mesh")
    _require_range(scenario)
    _require_whole_patches(scenario, target)
    places = {"start.position": scenario.start.position}
    for number, hold in enumerate(scenario.inspect.hold_points):
        places[f"inspect.hold_points.{number}.position"] = hold.position
    around = Surroundings(scenario, target)
    require_outside_zones(around, [(entry, position, 0.0) for entry, position in places.items()])
    free = mesh_and_zones(target.distance, around) if room is None else room.free
    for entry, position in places.items():
        _require_place(scenario, free, entry, position)
    _require_in_time(scenario, target)
    room = Room(target.distance, scenario.inspect.stand_off, free=free) if room is None else room
    for (entry, position), allowed in zip(places.items(), room.allowed(np.array(list(places.values())))):
        if not allowed:
            raise InspectionError(
                f"{entry}: {list(position)} m; no way that keeps inspect.stand_off, {room.stand_off:g} m, was found "
                "from there out of the target; a place outside it, with more room, would be valid"
            )
    return room


def require_stand_off(scenario: Scenario, target: Target, error_bound: float) -> float:
    """Give the room, m, that law and guard keep between the chaser's centre and the mesh, as the field says it.

    Args:
        scenario: as flown, by the law "default".
        target: its mesh.
        error_bound: e_h of the field that the law flies by, m.

    Raises:
        InspectionError: it is more than the stand-off, at which the law then does not fly.
        ControlError: the thrusters cannot meet the guard's assumptions.

    """
    radius, margin, asked = scenario.chaser.radius, scenario.safety.margin, scenario.inspect.stand_off
    own = least_offset(scenario.chaser.speed_limit, scenario.control.period)
    kept = error_bound + radius + margin + room_for_guard(Surroundings(scenario, target)).get("nominal_offset", own)
    if asked < kept:
        raise InspectionError(
            f"inspect.stand_off: {asked:g} m, and law and guard keep {kept:.3f} m (chaser.radius {radius:g}, "
            f"safety.margin {margin:g}, the field's error {error_bound:.3f}, room to steer "
            f"{kept - radius - margin - error_bound:.3f}); it must be at least that"
        )
    return kept


def require_light(scenario: Scenario, light: Light, patches: Patches) -> None:
    """Refuse a light that falls on nothing in any frame, by the Earth's shadow or by the angle to every patch.

    Raises:
        InspectionError: it does; the shadows that the target throws on itself are not looked at here.

    """
    if not light.matters:
        return
    times = frame_times(scenario)
    suns = light.suns(times) if scenario.light.kind == "sun" else light.suns(times[:1])
    suns = suns[~np.isnan(suns[:, 0])]
    if not len(suns):
        raise InspectionError(
            f'light.kind: "sun", and from {scenario.epoch} the Earth hides the sun for all of duration '
            f"{scenario.duration:g} s; another epoch, orbit.true_anomaly or a longer duration would bring light"
        )
    normals, greatest = patches.unit_normals()[patches.counted], scenario.light.greatest_incidence
    steepest = -1.0
    for sun in suns:
        steepest = max(steepest, float(np.max(normals @ sun, initial=-1.0)))
        if steepest >= math.cos(greatest):
            return
    least = math.acos(min(max(steepest, -1.0), 1.0))
    raise InspectionError(
        f"light.greatest_incidence: {greatest:.4g} rad, and the light falls on no patch at less than {least:.4g} rad "
        f"in any of {len(suns)} frames in light; another direction or epoch, or a greater angle, would light some"
    )


def require_something_to_see(scenario: Scenario, seeable: Seeable, lit: Marks) -> None:
    """Refuse a target of which nothing can be seen, or nothing of that is ever lit.

    Args:
        scenario: as flown.
        seeable: what can be seen at all.
        lit: (2 n,) units that are not proved hidden and that the sun lights in some frame.

    Raises:
        InspectionError: the message tells the shares of the area.

    """
    patches = seeable.patches
    area = float(patches.unit_areas().sum())
    if not area > 0.0:
        raise InspectionError("target: it has no area that counts as its outside; nothing is to be seen")
    if scenario.zone and seeable.lower == 0.0 and seeable.upper > 0.0:
        raise InspectionError(
            f"zone: {len(scenario.zone)}, and inspect.stand_off, {scenario.inspect.stand_off:g} m, or more from "
            f"all of them and from the target no place was found that sees anything of {area:.4g} m2; smaller zones, "
            "or a greater camera.greatest_range, would leave some"
        )
    if seeable.lower == 0.0 and seeable.upper > 0.0:
        clock = f"inspect.proof_time, {scenario.inspect.proof_time:g} s, ended it: " if seeable.by_clock else ""
        raise InspectionError(
            f"inspect.proof_squares: {seeable.squares} of {scenario.inspect.proof_squares} were looked at, {clock}no "
            f"place was found that sees anything of {area:.4g} m2, and {1.0 - seeable.upper:.1%} are proved hidden; "
            "more, or a longer time where that ended it, may find one"
        )
    if seeable.lower == 0.0:
        enclosed, narrow = (patches.coverage(seeable.why == why) for why in (Hidden.ENCLOSED, Hidden.NARROW))
        raise InspectionError(
            f"inspect: nothing can be seen from {scenario.inspect.stand_off:g} m and beyond: of {area:.4g} m2, "
            f"{enclosed:.1%} lie enclosed, {narrow:.1%} show only where the camera's limits or inspect.stand_off "
            f"forbid it (told apart by rays); a greater camera.greatest_range or "
            "camera.greatest_incidence, or a smaller inspect.patch_size, would show more"
        )
    if not np.any(lit & patches.counted):
        raise InspectionError(
            f"light: none of the {seeable.upper:.1%} of {area:.4g} m2 that are not proved hidden is lit in any frame; "
            "another direction or epoch, or a longer duration, would light some"
        )


def _require_times(scenario: Scenario) -> None:
    control, camera, inspect = scenario.control.period, scenario.camera.period, scenario.inspect
    if abs(camera / control - round(camera / control)) > 1e-9 or round(camera / control) < 1:
        raise InspectionError(f"camera.period: {camera:g} s; it must be whole control periods of {control:g} s")
    if scenario.duration < camera:
        raise InspectionError(
            f"duration: {scenario.duration:g} s; it must be at least camera.period, {camera:g} s, for a second frame"
        )
    held = sum(hold.seconds for hold in inspect.hold_points) + inspect.dwell
    stops = np.array([scenario.start.position, *(hold.position for hold in inspect.hold_points)])
    way = np.linalg.norm(np.diff(stops, axis=0), axis=1) - 2.0 * scenario.goal.tolerance
    flown = float(np.maximum(way, 0.0).sum()) / _fastest(scenario)
    if held + flown >= scenario.duration:
        raise InspectionError(
            f"duration: {scenario.duration:g} s, and inspect.hold_points and one inspect.dwell alone take {held:g} s, "
            f"straight ways to the points {flown:.4g} s; it must be longer"
        )


def _fastest(scenario: Scenario) -> float:
    """Give the speed, m/s, that the chaser does not exceed."""
    return max(scenario.chaser.speed_limit, float(np.linalg.norm(scenario.start.velocity)))


def _require_range(scenario: Scenario) -> None:
    """Refuse a camera that sees no point of the surface from where the chaser may be, however it lies."""
    rules, stand_off = rules_of(scenario), scenario.inspect.stand_off
    if rules.greatest_range <= stand_off:
        raise InspectionError(
            f"camera.greatest_range: {rules.greatest_range:g} m, and nothing is nearer than inspect.stand_off, "
            f"{stand_off:g} m; it must be more than that, or nothing can ever be seen"
        )
    nearest = max(stand_off, rules.least_range)
    finest = rules.pixel_angle * nearest
    if finest > rules.greatest_sample_distance:
        raise InspectionError(
            f"camera.greatest_sample_distance: {rules.greatest_sample_distance:g} m, and from {nearest:g} m, the "
            f"nearest that inspect.stand_off and camera.least_range allow, {rules.pixels} pixels tell {finest:.3g} m "
            f"apart; at least that, or {math.ceil(rules.pixels * finest / rules.greatest_sample_distance)} pixels"
        )


def _require_whole_patches(scenario: Scenario, target: Target) -> None:
    """Refuse patches of which a full one, a square, is seen wholly from nowhere.

    With half its diagonal d and its middle at a distance D, whatever is seen of it wholly has: D at least the
    stand-off; some corner at sqrt(D² + d²) or farther, and d or more beside the foot of the camera's perpendicular, so
    that D ≥ d/tan i for the incidence i, and p (D² + d²)/D ≤ g for a pixel's angle p and the sample distance g; some
    corner at sqrt(D² + d²) or nearer; and one diagonal, of two across each other, at an angle φ to the line of sight
    with sin φ ≥ q = sqrt(1 - sin² i / 2), which fills the angle γ with tan γ = 2 D d sin φ / (D² - d²). Below a right
    angle γ is least for sin φ = q, above it for sin φ = 1.
    """
    rules, size = rules_of(scenario), patch_size(scenario, target)
    area = target.distance.area
    if area > MOST_PATCHES * size * size:
        raise InspectionError(
            f"inspect.patch_size: {size:g} m; {area:.4g} m2 would be cut into {area / size / size:.2g} patches or "
            f"more, and {MOST_PATCHES} are the most; {math.sqrt(area / MOST_PATCHES):.3g} m at least"
        )
    d, view = size / math.sqrt(2.0), rules.field_of_view
    narrowest = math.sqrt(1.0 - 0.5 * math.sin(rules.greatest_incidence) ** 2) if view < 0.5 * math.pi else 1.0
    across = narrowest / math.tan(view)
    low = max(
        scenario.inspect.stand_off,
        d / math.tan(rules.greatest_incidence),
        d * (across + math.hypot(across, 1.0)),
        math.sqrt(max(rules.least_range**2 - d * d, 0.0)),
    )
    high = math.sqrt(max(rules.greatest_range**2 - d * d, 0.0))
    if math.isfinite(rules.greatest_sample_distance):
        reach = rules.greatest_sample_distance / rules.pixel_angle  # D² - reach D + d² ≤ 0
        inner = reach * reach - 4.0 * d * d
        if inner < 0.0:
            raise InspectionError(
                f"inspect.patch_size: {size:g} m; over a whole square of it the sample distance is "
                f"{2.0 * rules.pixel_angle * d:.3g} m at best, and camera.greatest_sample_distance is "
                f"{rules.greatest_sample_distance:g} m; smaller patches, or more pixels, can be seen so finely"
            )
        low = max(low, 0.5 * (reach - math.sqrt(inner)))
        high = min(high, 0.5 * (reach + math.sqrt(inner)))
    if low > high:
        raise InspectionError(
            f"inspect.patch_size: {size:g} m; a whole square of it would have to be looked at from {low:.3g} m or "
            f"more and from {high:.3g} m or less (camera's angles, ranges and sample distance, inspect.stand_off); "
            "smaller patches can be seen whole"
        )


def _require_in_time(scenario: Scenario, target: Target) -> None:
    """Refuse a duration in which a chaser within its limit of speed comes nowhere from where anything is in range.

    A drift about the target begins elsewhere.
    """
    if scenario.inspect.tour == "circumnavigation":
        return
    away = float(target.distance.distance(np.array([scenario.start.position]))[0])
    fastest = _fastest(scenario)
    missing = away - scenario.camera.greatest_range
    if missing > fastest * scenario.duration:
        raise InspectionError(
            f"duration: {scenario.duration:g} s; start.position is {away:.4g} m from the target, and at {fastest:g} "
            f"m/s camera.greatest_range, {scenario.camera.greatest_range:g} m, is reached after "
            f"{missing / fastest:.4g} s; it must be longer than that"
        )


def _require_place(scenario: Scenario, free: Measure, entry: str, position: tuple[float, float, float]) -> None:
    """Refuse a place nearer to mesh or zones than the stand-off, or where all plumes reach a part that none may."""
    away, stand_off = float(free.distance(np.array([position]))[0]), scenario.inspect.stand_off
    if away < stand_off:
        raise InspectionError(
            f"{entry}: {list(position)} m is {away:.3f} m from the target{' or a zone' if scenario.zone else ''}; it "
            f"must be at least inspect.stand_off, {stand_off:g} m, away"
        )
    protected = Protected.of(scenario)
    if protected is not None and bool(np.all(protected.reached(jnp.asarray(position)))):
        raise InspectionError(
            f"inspect.no_thrust_towards: {len(scenario.inspect.no_thrust_towards)} parts, and at {entry}, "
            f"{list(position)} m, the plume of every thruster would reach one of them; smaller parts, a smaller "
            "inspect.plume_half_angle or inspect.plume_range, or another place would leave some free"
        )


@dataclass(frozen=True, eq=False)
class Problem:
    """The equipment of one inspection; make one with `Problem.of`.

    Attributes:
        scenario: of the mission.
        target: its mesh.
        patches: of that mesh.
        rules: when a patch counts as seen.
        sight: lines of sight to the patches.
        room: where the chaser's centre may be.
        seeable: what can be seen at all.
        light: where it comes from, and when.

    """

    scenario: Scenario
    target: Target
    patches: Patches
    rules: SeeingRules
    sight: Sightlines
    room: Room
    seeable: Seeable
    light: Light

    @classmethod
    def of(
        cls, scenario: Scenario, target: Target, *, room: Room | None = None, progress: Progress = silent
    ) -> "Problem":
        """Cut the target into patches, and find out what of it can be seen.

        Args:
            scenario: its entries `camera`, `light` and `inspect`.
            target: the mesh.
            room: that `require_inspectable` gave for both; else both are looked at here.
            progress: told of the cut and the share that is decided.

        Raises:
            InspectionError: something that no plan could make good; the message names the entry.

        """
        room = require_inspectable(scenario, target) if room is None else room
        rules = rules_of(scenario)
        patches = cut(target, patch_size(scenario, target), progress=part_of(progress, 0.0, 0.1))
        sight = Sightlines(target.vertices, target.faces, patches)
        inspect, told = scenario.inspect, part_of(progress, 0.1, 1.0)
        judged = seeable(sight, rules, room, squares=inspect.proof_squares, seconds=inspect.proof_time, progress=told)
        return cls(scenario, target, patches, rules, sight, room, judged, Light(scenario))

    @functools.cached_property
    def camera(self) -> Camera:
        """What sees the patches, frame by frame."""
        return Camera(self.sight, self.rules, self.light)

    @functools.cached_property
    def ways(self) -> Ways:
        """Ways that keep the stand-off, inside `box`."""
        return Ways.build(self.room.free, self.scenario.inspect.stand_off, *self.box)

    @functools.cached_property
    def fine_ways(self) -> Ways:
        """The same with nodes at half the stand-off, as far as memory allows: they lead through narrower room."""
        stand_off, (lower, upper) = self.scenario.inspect.stand_off, self.box
        nodes = float(np.prod(upper - lower)) / (0.5 * stand_off) ** 3
        if nodes <= MOST_NODES:
            return self.ways
        return Ways.build(self.room.free, stand_off, lower, upper, most_nodes=int(min(nodes, _FINE_NODES)))

    def ways_from(self, position: Point) -> Ways:
        """Give the ways, or such as reach farther where the chaser is outside their box."""
        lower, upper = self.box
        if ((position >= lower) & (position <= upper)).all():
            return self.ways
        lower, upper = np.minimum(lower, position - 1.0), np.maximum(upper, position + 1.0)
        return Ways.build(self.room.free, self.scenario.inspect.stand_off, lower, upper)

    @property
    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners, m, of a box that holds all places from which anything is seen, and the start."""
        start = np.asarray(self.scenario.start.position)
        reach = max(self.rules.greatest_range, self.scenario.inspect.stand_off) + 1.0
        lower = np.minimum(self.target.vertices.min(axis=0) - reach, start - 1.0)
        return lower, np.maximum(self.target.vertices.max(axis=0) + reach, start + 1.0)


@dataclass(eq=False)
class Wanted:
    """The units wanted, taken and given up.

    Attributes:
        patches: the units.
        possible: (2 n,) what is not proved hidden, and is lit in the mission's time.
        share: of the area of these that is wanted, 0 to 1.
        taken: (2 n,) seen in some frame, by the estimates on board.
        failures: (2 n,) tours that promised a unit and ended without it.

    """

    patches: Patches
    possible: Marks
    share: float

    def __post_init__(self) -> None:
        self.taken = np.zeros(self.patches.units, bool)
        self.failures = np.zeros(self.patches.units, np.int64)

    @property
    def left(self) -> Marks:
        """The units still wanted and not given up."""
        return self.possible & ~self.taken & (self.failures < _ATTEMPTS)

    @property
    def reached(self) -> float:
        """Share of the possible area that was taken, 0 to 1."""
        areas = self.patches.unit_areas()
        whole = float(areas[self.possible].sum())
        return float(areas[self.possible & self.taken].sum()) / whole if whole > 0.0 else 1.0

    @property
    def enough(self) -> bool:
        """Whether the share wanted was taken."""
        return self.reached >= self.share - _ROUNDING

    @property
    def ending(self) -> tuple[str, str]:
        """Say how an inspection ends by which the share wanted was taken, and why."""
        left = bool((self.possible & ~self.taken).any())
        outcome = f"{100.0 * self.share:g} % asked, seen" if left else "all seen"
        return outcome, f"{self.reached:.2%} of what is not proved hidden was taken, {self.share:.2%} were asked for"

    @property
    def share_of_left(self) -> float:
        """Share of the area left that is to be seen so that the share wanted is reached, 0 to 1."""
        areas = self.patches.unit_areas()
        whole, left = float(areas[self.possible].sum()), float(areas[self.left].sum())
        missing = (self.share - self.reached) * whole
        return float(np.clip(missing / left, 0.0, 1.0)) if left > 0.0 else 1.0

    def take(self, units: Units) -> int:
        """Note what a frame showed; give how many units of it were wanted and new."""
        fresh = int((self.possible[units] & ~self.taken[units]).sum())
        self.taken[units] = True
        return fresh

    def failed(self, promised: Units) -> None:
        """Note that a tour promised units; those not taken are tried so many times at most."""
        missing = promised[~self.taken[promised]]
        self.failures[missing] += 1
