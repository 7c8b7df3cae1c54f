"""What a scenario's legs and approach rules become: a law of legs; and what of them, zones and corridors is refused.

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

from keepout.core.control.barrier_grid import require_free
from keepout.core.control.controller import Controller
from keepout.core.control.geodesic import Geodesic, GeodesicGuidance, one_behind_the_other
from keepout.core.control.guidance import Guidance, GuidancePlan, Point, Travel
from keepout.core.control.law import Law
from keepout.core.control.legs import LegGuidance, LegLaw, Legs, SpeedByDistance
from keepout.core.errors import ControlError, KeepoutError, KeepOutZoneError, ScenarioError
from keepout.core.fields import zones as shapes
from keepout.core.fields.field import Field
from keepout.core.fields.zones import SweptCone, Zone
from keepout.core.flight.setup import FlightSetup
from keepout.core.kept import digest
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.core.mission.zones import corridor_shape, named, require_clear, standing_zone, with_digests
from keepout.core.motion import rotation
from keepout.core.motion.arrays import as_float64
from keepout.core.progress import part_of

_LEAST_ROOM, _ROOM = 6.0, 0.25
"""About a leg's ends, within which its way is looked for at first: at least so much, m, and this share of the leg."""
_PORT = 1.0
"""A corridor's port is nearer to the mesh than this, m."""
_CLEAR: set[tuple[str, str, float]] = set()
"""Corridors, meshes and distances, m, for which this process has proved the room clear."""


def require_one_leg(scenario: Scenario, led_by: str, *, zones: bool = False) -> None:
    """Refuse legs, zones, corridors and a rule of speeds where they would not be heeded.

    Args:
        scenario: as flown.
        led_by: what leads instead, in words.
        zones: whether these are heeded.

    Raises:
        ScenarioError: naming what is there.

    """
    asked = ("leg", "corridor") if zones else ("leg", "zone", "corridor")
    there = [name for name in asked if getattr(scenario, name)]
    there += ["approach.speed_by_distance"] if scenario.approach.speed_by_distance else []
    if there:
        also = ", zones for inspect too" if "zone" in there else ""
        raise ScenarioError(f"{', '.join(there)}: for fly, campaign and rare{also}; {led_by}. Leave them out")


def has_rules(scenario: Scenario) -> bool:
    """Whether a scenario has any legs, zones, corridors or approach rules."""
    return bool(scenario.leg or scenario.zone or scenario.corridor or scenario.approach.speed_by_distance)


def as_flown(scenario: Scenario) -> Scenario:
    """Give a scenario with its legs in body axes, and the digests of the meshes of its zones (`with_digests`)."""
    scenario = with_digests(scenario)
    if all(leg.axes != "inertial" for leg in scenario.leg):
        return scenario
    # The target stands still in these axes (else it is refused), and at the start body axes are those of VVLH.
    axes = np.asarray(rotation.vvlh_axes(*Surroundings(scenario).motion.orbit.inertial_state(as_float64(0.0))))
    legs = [leg.model_dump() for leg in scenario.leg]
    for leg in legs:
        if leg["axes"] == "inertial":
            leg |= {"axes": "body", "position": (axes @ leg["position"]).tolist()}
    return scenario.replace(leg=legs, goal={"position": legs[-1]["position"]})


def wants_drift_safety(scenario: Scenario) -> bool:
    """Whether any leg is to be flown no faster than a drift from it is safe."""
    return any(leg.drift_safe for leg in scenario.leg)


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

    def guidance(self, field: Field, offset: float, goal: Point, travel: Travel) -> Guidance:
        """Make the guidance of all legs; its `leg` is the last, where `goal` is."""
        legs = self.scenario.leg
        if not legs:
            require_free(field, offset, goal, "goal")
            return LegGuidance.of([self.each.guidance(field, offset, goal, travel)], self.rule)
        places = [np.asarray(leg.position, dtype=float) for leg in legs]
        stages = [field.at_time(as_float64(time)) for time in earliest(self.scenario)]
        for number, (leg, place, now) in enumerate(zip(legs, places, stages, strict=True)):
            try:
                require_free(now, offset, place, named("leg", leg, number))
            except KeepOutZoneError as refusal:  # which would be of the start or the goal
                raise ControlError(str(refusal)) from None
        ways, before = [], travel.start
        for number, (leg, place, now) in enumerate(zip(legs, places, stages, strict=True)):
            part = part_of(travel.progress, number / len(legs), (number + 1) / len(legs))
            fastest = min(travel.speed, leg.speed_limit or math.inf)
            slowing_length = travel.slowing_length * (fastest / travel.speed)
            try:
                ways.append(self._way(now, offset, place, Travel(fastest, slowing_length, before, part)))
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
        # Put into the tree, as arrays of several legs have another shape than those that one is made of.
        again = as_float64(fastest), as_float64(slowing_length * (fastest / speed))
        return eqx.tree_at(lambda legs: (legs.own.speed, legs.own.slowing_length), made, again)

    def identity(self, field: Field) -> tuple[Hashable, ...]:
        """Say what a guidance depends on beside field, offset, goal and start."""
        there = (getattr(field, "zones", ()), getattr(field, "clear", ()))
        walls = [np.asarray(leaf) for leaf in jax.tree.leaves(there)]
        legs = self.scenario.model_dump_json(include={"leg", "zone", "corridor", "approach"})
        return (digest(legs, *walls), getattr(self.each, "spacing", None))

    def _way(self, field: Field, offset: float, place: Point, travel: Travel) -> Guidance:
        """Give the guidance of one leg: in the room about its ends, or in all the room there is."""
        each, before = self.each, travel.start
        if not isinstance(each, Geodesic) or each.grid is not None or each.bounds is not None or before is None:
            return each.guidance(field, offset, place, travel)
        ends = np.stack([place, before])
        room = max(_LEAST_ROOM, _ROOM * float(np.linalg.norm(place - before)))
        about = dataclasses.replace(each, bounds=(ends.min(axis=0) - room, ends.max(axis=0) + room))
        try:
            return about.guidance(field, offset, place, travel)
        except ControlError as near:
            try:
                return each.guidance(field, offset, place, travel)
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
    require_outside_zones(around, places)
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
            needed = scenario.chaser.radius + around.kept_margin
            proved = (entry.model_dump_json(), target.sha256, needed)
            if proved not in _CLEAR:  # once for all flights of a process
                require_clear(wall, entry.clear_from, target.distance, needed, name)
                _CLEAR.add(proved)


def require_outside_zones(around: Surroundings, places: Sequence[tuple[str, Sequence[float], float]]) -> None:
    """Refuse places (m) in a zone, each with its name and the time (s) from which on the chaser may be there.

    Raises:
        ScenarioError: naming both, with the numbers.

    """
    radius = around.scenario.chaser.radius
    for number, entry in enumerate(around.scenario.zone):
        zone = standing_zone(around, entry, 0.0)
        for name, place, time in places:
            away = float(zone.value(as_float64(place), as_float64(time)))
            if away <= radius:
                since = "" if time == 0.0 else f", which still stands at {time:g} s, the earliest that it is flown to,"
                raise ScenarioError(
                    f"{name}: {list(place)} m is {_beyond(away)} {named('zone', entry, number)}{since} "
                    f"and the chaser's radius is {radius:g} m"
                )


def _beyond(away: float) -> str:
    return f"{away:.3g} m from" if away > 0.0 else f"{-away:.3g} m inside"
