"""Law and guard by the field of a map: of the target only a ball is known that holds it, and what was seen free.

The guard's numbers hold for every map (docs/mapping.md), so they are the scenario's and the ball's alone. Law and
guard fly by the same field. The guard asks for room beyond its threshold, and the law keeps that room: otherwise it
would lead to where the guard holds it for ever.
"""

import dataclasses

import equinox as eqx
import jax
import numpy as np

from keepout.apps.led.driver import Leading, Point
from keepout.apps.unknown.known_free import KnownFreeMap
from keepout.apps.unknown.map_field import SLOPE, MapField
from keepout.core.control.barrier_grid import BarrierGrid, grid_of_nodes
from keepout.core.control.design import least_offset
from keepout.core.control.law import Law
from keepout.core.errors import KeepOutZoneError, ScenarioError
from keepout.core.guard.guard import Guard, starts_certified
from keepout.core.mission.law import broken_as
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.core.motion.relative import MotionState
from keepout.flights.navigation.suites import navigation

_WANDERING = 0.05
"""Room beyond what the guard asks of a chaser at rest, m: for its way to rest, and for the law's own wandering."""


@dataclasses.dataclass(frozen=True)
class DeclaredBall:
    """A ball that the operator promises to hold the whole target: `centre` (3,) m, body frame, and `radius` m."""

    centre: tuple[float, float, float]
    radius: float

    @property
    def extent(self) -> float:
        """How far it reaches from the body frame's origin, m."""
        return float(np.linalg.norm(self.centre)) + self.radius


def guard_by_map(scenario: Scenario, field: MapField, ball: DeclaredBall) -> Guard:
    """Build the guard on a map's field; with the field of any later map in its place it is the guard of that map.

    Raises:
        KeepoutError: the thrusters cannot meet the assumptions, or the map's cap is too low for any plan to be
            certified; the message names the entry.

    """
    kept = scenario.chaser.radius + Surroundings(scenario).kept_margin
    guard = Guard(
        field=field,
        threshold=kept + field.error_bound(kept),
        lipschitz=SLOPE,
        evaluation_error=field.evaluation_error,
        assumptions=Surroundings(scenario, extent=ball.extent).guard_assumptions,
    )
    _require_cap(field, float(guard.least_value), "the guard certifies plans")
    return guard


def _require_cap(field: MapField, needed: float, what: str) -> None:
    """Refuse a map whose field is nowhere above what is needed, m."""
    if not field.cap > needed:
        raise ScenarioError(
            f"map cap: {field.cap:.3g} m, and {what} only where the field is above {needed:.3f} m; "
            "give the map a greater cap, or the chaser smaller errors"
        )


def kept_by_law(scenario: Scenario, field: MapField, guard: Guard | None) -> float:
    """Give the default law's `nominal_offset`, m, by which it stays where the guard passes its commands on."""
    own = least_offset(scenario.chaser.speed_limit, scenario.control.period)
    if guard is None:
        return own
    a, radius = guard.assumptions, scenario.chaser.radius
    contact = radius + field.error_bound(radius)
    sagitta = 3.0**0.5 * a.authority * a.period**2 / 8.0
    asked = float(guard.least_value + guard.lipschitz * sagitta) - contact + _WANDERING
    return max(own, asked - scenario.safety.margin)


def field_of(known: KnownFreeMap) -> MapField:
    """Give the field of a map as it is now."""
    return MapField.of(known.squares, known.origin, known.spacing)


@dataclasses.dataclass(frozen=True, eq=False)
class ByMap(Leading):
    """The default law led by what a map knows, with the scenario's delay and faults; make one with `ByMap.of`.

    Attributes:
        ball: which holds the target.

    """

    field: MapField
    ball: DeclaredBall

    @classmethod
    def of(cls, scenario: Scenario, ball: DeclaredBall, field: MapField) -> "ByMap":
        """Build guard and grid by the first map; refuse a start that is not certainly free.

        Raises:
            KeepoutError: as of `guard_by_map` and `require_start`.

        """
        guard = guard_by_map(scenario, field, ball) if scenario.guard.enabled else None
        around = Surroundings(scenario, extent=ball.extent)
        motion = around.motion
        initial = motion.initial_state(np.asarray(scenario.start.position), np.asarray(scenario.start.velocity))
        require_start(scenario, ball, initial, guard)
        sensed = None
        if scenario.navigation.suite != "none":
            sensed = navigation(scenario, motion, around.guard_assumptions)
        bound, nominal = field.error_bound(scenario.chaser.radius), kept_by_law(scenario, field, guard)
        reach = max(ball.extent, float(np.linalg.norm(scenario.start.position)))
        grid = _grid(field, bound + scenario.chaser.radius + scenario.safety.margin + nominal)
        certified = None if guard is None else True
        return cls(scenario, field, bound, grid, reach, nominal, guard, sensed, initial, certified, ball)

    def by(self, field: MapField) -> "ByMap":
        """Lead by a later map's field: law, guard and log take it.

        Raises:
            FieldError: the field is of another grid, or says less somewhere: then what was certified is so no more.

        """
        field.require_no_less(self.field)
        guard = None if self.guard is None else eqx.tree_at(lambda g: g.field, self.guard, field)
        return dataclasses.replace(self, field=field, guard=guard, grid=_grid(field, self.offset))

    def law(self, goal: Point, position: Point) -> Law:
        """Make the law that leads to a goal from where the chaser is, (3,) m each.

        Raises:
            ControlError: the goal is not free, or no way leads there; the message says what is missing.
            ScenarioError: the map's cap is too low for any goal.

        """
        _require_cap(self.field, self.offset, "the law leads")
        # Beyond the grid the guidance leads back to it, and all is free there.
        within = self.within_grid(np.asarray(position))
        try:
            law = self.made(goal, position, from_start=within)
        except KeepOutZoneError as refusal:
            # Law and guard know their way out of the law's own margin; whether a way leads on is then not known.
            if refusal.place != "start":
                raise
            law = self.made(goal, position, from_start=False)
        return broken_as(self.scenario, law, self.field)


def _grid(field: MapField, offset: float) -> BarrierGrid:
    return grid_of_nodes(np.asarray(field.squares), np.asarray(field.origin), float(field.spacing), offset)


def require_start(scenario: Scenario, ball: DeclaredBall, start: MotionState, guard: Guard | None) -> None:
    """Refuse a start that is not wholly outside the declared ball, or from which the guard's theorem does not hold.

    A camera sees its own place at no time, so that nothing but the ball says that the chaser's own room is free.

    Raises:
        ScenarioError: the message names the entry, its distances, and what would be valid.

    """
    position, needed = np.asarray(start.position), ball.radius + scenario.chaser.radius
    away = float(np.linalg.norm(position - np.asarray(ball.centre)))
    if not away > needed:
        raise ScenarioError(
            f"start.position: {position.tolist()} m is {away:.3f} m from the centre of the declared ball "
            f"{list(ball.centre)}; it must be more than {needed:.3f} m, the ball's radius and the chaser's"
        )
    if guard is None:
        return
    if not starts_certified(guard, jax.tree.map(lambda array: array[None], start))[0]:
        speed = float(np.linalg.norm(np.asarray(start.velocity)))
        raise ScenarioError(
            f"start: from {position.tolist()} m at {speed:.3f} m/s the guard is not certain to stop in known-free room "
            f"within {guard.assumptions.range_limit:.1f} m; start slower, or further from the declared ball"
        )
