"""What a scenario's legs, zones, corridors and approach rules become: a field with zones in it, and a law of legs.

The first leg with `until = "go"` says when zones fall that stand until "go". Earliest times follow from what is said of
each leg; a zone that has ended by the earliest time at which a leg can begin is no wall for it.
"""

import dataclasses
import itertools
import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from keepout.core.audit import zones as judged
from keepout.core.audit.zones import Region
from keepout.core.control.barrier_grid import require_free
from keepout.core.control.controller import Controller
from keepout.core.control.geodesic import Geodesic, GeodesicGuidance, one_behind_the_other
from keepout.core.control.guidance import Guidance, GuidancePlan, Point
from keepout.core.control.law import Law
from keepout.core.control.legs import LegGuidance, LegLaw, Legs, SpeedByDistance
from keepout.core.errors import ControlError, KeepoutError, KeepOutZoneError, ScenarioError
from keepout.core.fields import zones as shapes
from keepout.core.fields.field import Field, in_pieces
from keepout.core.fields.zones import ClearRoom, SweptCone, Zone, ZonedField
from keepout.core.flight.setup import FlightSetup
from keepout.core.geometry.distance import Distance
from keepout.core.geometry.hulls import hulls_of
from keepout.core.kept import digest
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.core.mission.task_entries import SHAPES, CorridorEntry, LegEntry, ZoneEntry
from keepout.core.motion import rotation
from keepout.core.motion.arrays import Scalar, as_float64
from keepout.core.motion.disturbance import NoDisturbance
from keepout.core.motion.relative import MotionState, RelativeMotion
from keepout.core.progress import Progress, part_of, silent

_TURN = math.radians(5.0)
"""Between two rotations that stand for a turning zone, at most, unless that would pass `_MOST_MOMENTS`."""
_MOST_MOMENTS = 256
_LEAST_ROOM, _ROOM = 6.0, 0.25
"""About a leg's ends, within which its way is looked for at first: at least so much, m, and this share of the leg."""
_PORT = 1.0
"""A corridor's port is nearer to the mesh than this, m."""
_FINEST = 2e-3
"""Metres: half the side of the smallest cubes by which room is proved clear."""


def require_one_leg(scenario: Scenario, led_by: str) -> None:
    """Refuse legs, zones, corridors and a rule of speeds where they would not be heeded.

    Args:
        scenario: as flown.
        led_by: what leads instead, in words.

    Raises:
        ScenarioError: naming what is there.

    """
    there = [name for name in ("leg", "zone", "corridor") if getattr(scenario, name)]
    there += ["approach.speed_by_distance"] if scenario.approach.speed_by_distance else []
    if there:
        raise ScenarioError(f"{', '.join(there)}: for fly, campaign and rare; {led_by}. Leave them out")


def has_rules(scenario: Scenario) -> bool:
    """Whether a scenario has any legs, zones, corridors or approach rules."""
    return bool(scenario.leg or scenario.zone or scenario.corridor or scenario.approach.speed_by_distance)


def named(kind: str, entry: LegEntry | ZoneEntry | CorridorEntry, number: int) -> str:
    """Give what an entry of a list is called in refusals and tables, by its own name or its number from 0."""
    return f"{kind} {number}" if entry.name is None else f'{kind} "{entry.name}"'


def go_time(scenario: Scenario) -> float:
    """Give the time, s, until which what stands until "go" stands: of the first such leg."""
    return next((leg.go_at for leg in scenario.leg if leg.go_at is not None), math.inf)


def released(scenario: Scenario) -> list[float]:
    """Give for each leg the time, s, before which it is not over: by "go", and by when the next may be begun."""
    begun = [0.0 if leg.within is None else leg.within[0] for leg in scenario.leg]
    nexts = [*begun[1:], 0.0][: len(begun)]
    return [max(leg.go_at or 0.0, after) for leg, after in zip(scenario.leg, nexts, strict=True)]


def earliest(scenario: Scenario) -> list[float]:
    """Give for each leg the earliest time, s, at which it can be under way."""
    times, time = [], 0.0
    for leg, release in zip(scenario.leg, released(scenario), strict=True):
        times.append(time)
        time = max(time + leg.dwell, release)
    return times


def ends(scenario: Scenario, zone: ZoneEntry) -> float:
    """Give the time, s, at which a zone ends; infinite where it does not."""
    if zone.until == "go":
        return go_time(scenario)
    return math.inf if zone.until is None else zone.until


@dataclass(frozen=True)
class Turning:
    """How a zone's axes turn against the body frame while it stands.

    Attributes:
        rotations: zone's axes ← body axes, of some moments.
        ends: until when each stands for the zone, s.
        turned: the largest angle between the two, rad; 0 for axes at rest.

    """

    rotations: Float[np.ndarray, "moments 3 3"]
    ends: Float[np.ndarray, "moments"]
    turned: float


def turning(around: Surroundings, zone: ZoneEntry) -> Turning:
    """Follow a zone's axes from when it stands until it ends, or the flight does.

    Raises:
        ScenarioError: it turns so often while it stands that it is everywhere.

    """
    scenario, end = around.scenario, ends(around.scenario, zone)
    if zone.axes == "body":
        return Turning(np.eye(3)[None], np.array([end]), 0.0)
    period, rate = scenario.control.period, around.turning_rate(zone.axes)
    first = min(math.floor(zone.start / period), scenario.steps)
    last = min(math.ceil(min(end, 2.0 * scenario.duration) / period), scenario.steps + 1)
    if not rate:
        first, last = 0, 1
    angle = rate * (max(last - first, 1) + 1) * period
    count = min(max(math.ceil(angle / _TURN), 1), _MOST_MOMENTS)
    each = max(math.ceil((last - first) / count), 1)
    turned = 0.5 * rate * (each + 1) * period
    if turned > 0.2:
        raise ScenarioError(
            f"zone: axes {zone.axes!r} turn by {math.degrees(angle):.0f} degrees against the body while it stands; "
            f"at most {math.degrees(0.4 * _MOST_MOMENTS):.0f} are followed. Give it start and until"
        )
    rotations = np.asarray(_followed(around.motion, zone.axes, as_float64(period), scenario.steps + 1))
    stands = [*range(first, max(last, first + 1), each)]
    middles = [min(step + each // 2, scenario.steps) for step in stands]
    until = [(step + each) * period for step in stands[:-1]] + [end]
    return Turning(rotations[middles], np.array(until), turned)


@eqx.filter_jit
def _followed(motion: RelativeMotion, axes: str, period: Scalar, steps: int) -> Float[Array, "steps 3 3"]:
    """Give the axes ← body rotations at every control step, by the flight's own model of the target's turning."""

    def here(state: MotionState) -> Float[Array, "3 3"]:
        vvlh_from_body = rotation.matrix(state.attitude).T
        if axes == "vvlh":
            return vvlh_from_body
        orbit = state.target_orbit
        moved = motion.orbit.inertial_state(state.time) if orbit is None else (orbit[:3], orbit[3:])
        return rotation.vvlh_axes(*moved).T @ vvlh_from_body

    def step(state: MotionState, _: None) -> tuple[MotionState, Float[Array, "3 3"]]:
        # Only what turns is followed; the chaser stays where it is.
        after = motion.step(state, jnp.zeros(3), NoDisturbance(), period, 1.0)
        held = eqx.tree_at(lambda s: (s.position, s.velocity), after, (state.position, state.velocity))
        return held, here(state)

    return jax.lax.scan(step, motion.initial_state(jnp.zeros(3), jnp.zeros(3)), length=steps)[1]


def zone_shape(zone: ZoneEntry) -> shapes.Shape:
    """Give the shape of a zone, in its own axes."""
    if zone.file is not None:
        parts = hulls_of(zone.file, zone.units)
        most = max(len(hull.offsets) for hull in parts)
        rows = [np.arange(most) % len(hull.offsets) for hull in parts]  # as many planes for each, some twice
        numbers = [(hull.normals[row], hull.offsets[row]) for hull, row in zip(parts, rows, strict=True)]
        return shapes.Mesh(*(np.stack(column) for column in zip(*numbers, strict=True)))
    return getattr(shapes, zone.shape.capitalize())(**_parts(zone))


def corridor_shape(corridor: CorridorEntry) -> shapes.Beside:
    """Give the room beside a corridor, within its length of the port."""
    shared: dict[str, Any] = {"port": corridor.port, "axis": unit(corridor.axis), "length": corridor.length}
    if corridor.half_angle is not None:
        behind = (corridor.radius or 0.0) / math.tan(corridor.half_angle)
        apex = np.asarray(corridor.port) - behind * shared["axis"]
        return shapes.BesideCone(**shared, apex=apex, half_angle=corridor.half_angle)
    return shapes.BesideTube(**shared, radius=corridor.radius or 0.0)


def regions(around: Surroundings) -> list[Region]:
    """Give a scenario's zones and corridors as the audit judges them, with shapes of its own."""
    scenario, found = around.scenario, []
    for number, entry in enumerate(scenario.zone):
        rotations = np.eye(3)[None]
        if entry.axes != "body":
            rotations = np.asarray(
                _followed(around.motion, entry.axes, as_float64(scenario.control.period), scenario.steps + 1)
            )
        if entry.file is None:
            distance = getattr(judged, entry.shape)(**_parts(entry))
        else:
            distance = judged.mesh([(hull.corners, hull.faces) for hull in hulls_of(entry.file, entry.units)])
        found.append(
            Region(
                name=named("zone", entry, number),
                distance=distance,
                radius=scenario.chaser.radius,
                rotations=rotations,
                rate=around.turning_rate(entry.axes),
                start=entry.start,
                until=ends(scenario, entry),
            )
        )
    for number, entry in enumerate(scenario.corridor):
        walls = {"half_angle": entry.half_angle, "radius": entry.radius}
        beside = judged.beside(np.asarray(entry.port), unit(entry.axis), entry.length, **walls)
        found.append(Region(named("corridor", entry, number), beside, 0.0, np.eye(3)[None]))
    return found


def _parts(zone: ZoneEntry) -> dict[str, Any]:
    """Give the numbers that a zone's shape is made of, as arrays where they are vectors, an axis at length 1."""
    parts = {name: getattr(zone, name) for name in SHAPES[zone.shape]}
    if "axis" in parts:
        parts["axis"] = unit(parts["axis"])
    return {name: np.asarray(part) if isinstance(part, tuple) else part for name, part in parts.items()}


def unit(axis: Sequence[float]) -> Float[np.ndarray, "3"]:
    """Give a vector at length 1."""
    return np.asarray(axis) / np.linalg.norm(axis)


def standing_zone(around: Surroundings, zone: ZoneEntry, shift: float) -> Zone | SweptCone:
    """Give a zone as law and guard ask it, with a `shift` (m) added to its distance."""
    swept = _swept(around, zone, shift)
    if swept is not None:
        return swept
    way = turning(around, zone)
    return Zone(zone_shape(zone), way.rotations, way.ends, way.turned, shift, by_word=zone.until == "go")


def _swept(around: Surroundings, zone: ZoneEntry, shift: float) -> SweptCone | None:
    """Give a cone that turns at the origin about the orbit's normal; None for any other zone.

    The frame's turning about one axis is not assumed but found: the axis of the cone, followed from step to step, must
    be where a turn about the normal puts it.
    """
    scenario = around.scenario
    if zone.shape != "cone" or any(zone.centre or ()) or not around.turning_rate(zone.axes):
        return None
    period, last = scenario.control.period, ends(scenario, zone)
    rotations = np.asarray(_followed(around.motion, zone.axes, as_float64(period), scenario.steps + 1))
    axes = np.einsum("kij,i->kj", rotations, unit(zone.axis or ()))
    about = np.array([0.0, 1.0 if zone.axes == "inertial" else -1.0, 0.0])
    level = axes @ about
    angles = np.unwrap(np.arctan2(axes @ np.cross(about, axes[0]), (axes - level[:, None] * about) @ axes[0]))
    turned = level[:1, None] * about + np.outer(np.cos(angles), axes[0] - level[0] * about)
    turned += np.outer(np.sin(angles), np.cross(about, axes[0]))
    if np.abs(turned - axes).max() > 1e-9 or np.any(np.diff(angles) < 0.0):
        return None
    stood = angles[: min(scenario.steps, math.ceil(min(last, 2.0 * scenario.duration) / period)) + 1]
    stood[: math.floor(zone.start / period)] = stood[min(math.floor(zone.start / period), len(stood) - 1)]
    cone = shapes.Cone(np.zeros(3), axes[0], zone.half_angle, zone.length)  # pyright: ignore[reportArgumentType]
    return SweptCone(cone, about, stood, period, last, shift, by_word=zone.until == "go")


def zoned(around: Surroundings, field: Field, threshold: float) -> Field:
    """Put a scenario's zones and corridors into a field, so that each is entered where the field is its threshold.

    Of a zone that is when the chaser's ball touches it, of a corridor's wall when the chaser's centre does. In
    room that a corridor declares clear the field counts as above its threshold: `require_clear` has proved it.

    Args:
        around: the scenario's surroundings.
        field: a law's or a guard's.
        threshold: the value of that field, m, at and below which the chaser may touch the mesh.

    """
    scenario = around.scenario
    shift = threshold - scenario.chaser.radius
    zones: list[Zone | SweptCone] = [standing_zone(around, entry, shift) for entry in scenario.zone]
    zones += [Zone(corridor_shape(entry), np.eye(3)[None], [math.inf], 0.0, threshold) for entry in scenario.corridor]
    clear = tuple(
        ClearRoom(corridor_shape(entry), entry.clear_from, threshold)
        for entry in scenario.corridor
        if entry.clear_from is not None
    )
    return ZonedField(field, tuple(zones), clear) if zones else field


@dataclass(frozen=True)
class LegPlan(GuidancePlan):
    """The guidance of each leg, by another plan, from the place before it, round the zones that stand by then.

    Attributes:
        scenario: with its legs and its rule of speeds.
        each: the plan of one leg.
        rule: largest speed by distance, where there is one.

    """

    refuses = True
    scenario: Scenario
    each: GuidancePlan
    rule: SpeedByDistance | None

    def guidance(
        self,
        field: Field,
        offset: float,
        goal: Point,
        *,
        speed: float,
        slowing_length: float,
        start: Point | None = None,
        progress: Progress = silent,
    ) -> Guidance:
        """Make the guidance of all legs; its `leg` is the last, where `goal` is."""
        legs = self.scenario.leg
        if not legs:
            require_free(field, offset, goal, "goal")
            way = self.each.guidance(
                field, offset, goal, speed=speed, slowing_length=slowing_length, start=start, progress=progress
            )
            return LegGuidance.of([way], self.rule)
        places = [np.asarray(leg.position, dtype=float) for leg in legs]
        stages = [field.at_time(as_float64(time)) for time in earliest(self.scenario)]
        for number, (leg, place, now) in enumerate(zip(legs, places, stages, strict=True)):
            try:
                require_free(now, offset, place, named("leg", leg, number))
            except KeepOutZoneError as refusal:  # which would be of the start or the goal
                raise ControlError(str(refusal)) from None
        ways, before = [], start
        for number, (leg, place, now) in enumerate(zip(legs, places, stages, strict=True)):
            part = part_of(progress, number / len(legs), (number + 1) / len(legs))
            fastest = min(speed, leg.speed_limit or math.inf)
            led = {"speed": fastest, "slowing_length": slowing_length * (fastest / speed), "progress": part}
            try:
                ways.append(self._way(now, offset, place, before, led))
            except KeepoutError as refusal:
                raise ControlError(f"{named('leg', leg, number)}: {refusal}") from None
            before = place
        if all(isinstance(way, GeodesicGuidance) for way in ways):
            ways = one_behind_the_other(ways)
        return LegGuidance.of(ways, self.rule)

    def again(self, made: Guidance, speed: float, slowing_length: float) -> Guidance:
        """Give a guidance that this plan made with another speed and slowing length: no other part has them."""
        assert isinstance(made, LegGuidance)
        limits = [leg.speed_limit or math.inf for leg in self.scenario.leg] or [math.inf]
        fastest = np.minimum(limits, speed)
        own = dataclasses.replace(
            made.own, speed=as_float64(fastest), slowing_length=as_float64(slowing_length * (fastest / speed))
        )
        return dataclasses.replace(made, own=own)

    def identity(self, field: Field) -> tuple[Hashable, ...]:
        """Say what a guidance depends on beside field, offset, goal and start."""
        there = (getattr(field, "zones", ()), getattr(field, "clear", ()))
        walls = [np.asarray(leaf) for leaf in jax.tree.leaves(there)]
        legs = self.scenario.model_dump_json(include={"leg", "zone", "corridor", "approach"})
        return (digest(legs, *walls), getattr(self.each, "spacing", None))

    def _way(self, field: Field, offset: float, place: Point, before: Point | None, led: dict[str, Any]) -> Guidance:
        """Give the guidance of one leg: in the room about its ends, or in all the room there is."""
        each = self.each
        if not isinstance(each, Geodesic) or each.grid is not None or each.bounds is not None or before is None:
            return each.guidance(field, offset, place, start=before, **led)
        ends = np.stack([place, before])
        room = max(_LEAST_ROOM, _ROOM * float(np.linalg.norm(place - before)))
        about = dataclasses.replace(each, bounds=(ends.min(axis=0) - room, ends.max(axis=0) + room))
        try:
            return about.guidance(field, offset, place, start=before, **led)
        except ControlError as near:
            try:
                return each.guidance(field, offset, place, start=before, **led)
            except ControlError:
                raise near from None


def speed_rule(scenario: Scenario, field: Field, error_bound: float) -> SpeedByDistance | None:
    """Give a scenario's rule of speeds by distance, measured by a law's field where it is to the mesh."""
    approach = scenario.approach
    if not approach.speed_by_distance:
        return None
    distances, speeds = np.array(approach.speed_by_distance)[::-1].T
    point = None if approach.distance_to is None else as_float64(approach.distance_to)
    return SpeedByDistance(distances, speeds, point, None if point is not None else field, error_bound)


def require_braking(scenario: Scenario, law: Controller) -> None:
    """Refuse a rule of speeds that asks the thrusters for more than the law brakes with.

    Raises:
        ControlError: between two of its pairs the speed falls faster.

    """
    braking = law.velocity.class_k.braking
    if braking is None:
        return
    for (far, fast), (near, slow) in itertools.pairwise(scenario.approach.speed_by_distance):
        asked = fast * (fast - slow) / (far - near)
        if asked > float(braking):
            raise ControlError(
                f"approach.speed_by_distance: from [{far:g}, {fast:g}] to [{near:g}, {slow:g}] asks for up to "
                f"{asked:.3g} m/s2, and the law brakes with {float(braking):.3g} m/s2; let the speed fall over "
                f"{fast * (fast - slow) / float(braking):.3g} m"
            )


def law_of_legs(scenario: Scenario, law: Law) -> Law:
    """Give the law that flies a scenario's legs one after another, where its guidance has them."""
    if not (scenario.leg and isinstance(law, Controller) and isinstance(law.velocity.guidance, LegGuidance)):
        return law
    legs = Legs(
        [leg.tolerance for leg in scenario.leg],
        [leg.dwell for leg in scenario.leg],
        released(scenario),
        jax.device_put(np.array([leg.until == "go" for leg in scenario.leg])),
    )
    aborted = scenario.faults.abort_at if scenario.approach.abort == "retreat" else None
    return LegLaw(law, legs, scenario.control.period, math.inf if aborted is None else aborted)


def by_word(setup: FlightSetup, *, go: bool = False, abort: bool = False) -> FlightSetup:
    """Give a setup that waits for words and no times: for the flight computer, before and after each is said.

    What is to be said by "go" is one word for all legs and zones that wait for it. The setups differ in numbers only,
    so that one takes over from another with its memory (`OnBoard.ready`).

    Args:
        setup: of a mission with legs.
        go: whether "go" was said.
        abort: whether the mission is abandoned.

    """
    waited = -math.inf if go else math.inf

    def told(node: Any) -> Any:
        if isinstance(node, Zone | SweptCone):
            return shapes.at_word(node, go)
        if isinstance(node, LegLaw):
            legs = dataclasses.replace(node.legs, release=jnp.where(node.legs.by_word, waited, node.legs.release))
            law = jax.tree.map(told, node.law, is_leaf=_is_told)
            return dataclasses.replace(node, law=law, legs=legs, abort_at=-math.inf if abort else math.inf)
        return node

    return jax.tree.map(told, setup, is_leaf=_is_told)


def _is_told(node: Any) -> bool:
    return isinstance(node, Zone | SweptCone | LegLaw)


def require_approach(around: Surroundings) -> None:
    """Refuse a start, a goal or legs in a zone or beside a corridor, and corridors that begin at no mesh.

    Raises:
        ScenarioError: naming both, with the numbers.

    """
    scenario, target = around.scenario, around.target
    if scenario.faults.abort_at is not None and scenario.approach.abort == "retreat" and not scenario.leg:
        raise ScenarioError(
            f'faults.abort_at: {scenario.faults.abort_at:g} s, and approach.abort is "retreat", to the hold point '
            'before; there are no legs. Give some, or abort = "drift"'
        )
    places = [("start.position", scenario.start.position, 0.0)]
    if scenario.leg:
        times = earliest(scenario)
        legs = enumerate(zip(scenario.leg, times, strict=True))
        places += [(named("leg", leg, k), leg.position, time) for k, (leg, time) in legs]
    else:
        places += [("goal.position", scenario.goal.position, 0.0)]
    radius = scenario.chaser.radius
    for number, entry in enumerate(scenario.zone):
        zone = standing_zone(around, entry, 0.0)
        for name, place, time in places:
            away = float(zone.value(as_float64(place), as_float64(time)))
            if away <= radius:
                since = "" if time == 0.0 else f", which still stands at {time:g} s, the earliest that it is flown to,"
                raise ScenarioError(
                    f"{name}: {list(place)} m is {_beyond(away)} {named('zone', entry, number)}{since} "
                    f"and the chaser's radius is {radius:g} m"
                )
    for number, entry in enumerate(scenario.corridor):
        wall = corridor_shape(entry)
        name = named("corridor", entry, number)
        if target is not None:
            away = float(target.distance.distance(np.asarray(entry.port)[None])[0])
            if away > _PORT:
                raise ScenarioError(
                    f"{name}: its port {list(entry.port)} m is {away:.3g} m from the mesh; it must be within "
                    f"{_PORT:g} m"
                )
        for place_name, place, _ in places:
            away = float(wall.distance(as_float64(place)))
            if away <= 0.0:
                raise ScenarioError(
                    f"{place_name}: {list(place)} m is {-away:.3g} m beyond the wall of {name}, and within its length"
                )
        if target is not None and entry.clear_from is not None:
            require_clear(wall, entry.clear_from, target.distance, radius + around.kept_margin, name)


def require_clear(beside: shapes.Beside, clear_from: float, distance: Distance, needed: float, name: str) -> None:
    """Prove that the room which a corridor declares clear is nowhere nearer to the mesh than it must be.

    Cubes over the room are halved until each is outside of it, or has a centre so far from the mesh that all of it is
    far enough: depth in the room and distance are 1-Lipschitz.

    Args:
        beside: of the corridor.
        clear_from: where the room begins, m along the axis from the port.
        distance: exact, to the mesh.
        needed: how far from the mesh it must be, m.
        name: of the corridor, in refusals.

    Raises:
        ScenarioError: it is not so, or by too little to be proved; with both distances and where.

    """
    depth = jax.jit(jax.vmap(lambda point: beside.depth(point, as_float64(clear_from))))
    half, centres = float(beside.length), np.asarray(beside.port)[None]
    corners = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    while len(centres):
        reach, room = math.sqrt(3.0) * half, in_pieces(depth, centres)
        centres, room = centres[room > -reach], room[room > -reach]
        away = distance.distance(centres)
        near = away - reach < needed
        refuted = near & (away < needed) & (room > 0.0)
        if refuted.any() or (half < _FINEST and near.any()):
            worst = np.flatnonzero(refuted if refuted.any() else near)
            worst = worst[np.argmin(away[worst])]
            raise ScenarioError(
                f"{name}: clear_from {clear_from:g} m, but the mesh is {away[worst]:.4g} m from "
                f"{np.round(centres[worst], 3).tolist()} m, and it must be {needed:g} m and a few millimetres from all "
                "that is declared clear; begin farther from the port, or make the corridor narrower"
            )
        centres = (centres[near][:, None] + 0.5 * half * corners).reshape(-1, 3)
        half *= 0.5


def _beyond(away: float) -> str:
    return f"{away:.3g} m from" if away > 0.0 else f"{-away:.3g} m inside"
