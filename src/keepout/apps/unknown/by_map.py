"""Law and guard by the field of a map: of the target only a ball is known that holds it, and what was seen free.

The guard's numbers hold for every map (docs/mapping-field.md), so they are the scenario's and the ball's alone. Law and
guard fly by the same field. The guard asks for room beyond its threshold, and the law keeps that room: otherwise it
would lead to where the guard holds it for ever.
"""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from keepout.apps.unknown.map_field import SLOPE, MapField
from keepout.core.control.barrier_grid import grid_of_nodes
from keepout.core.control.design import least_offset
from keepout.core.control.geodesic import Geodesic
from keepout.core.control.law import Law
from keepout.core.errors import KeepOutZoneError, ScenarioError
from keepout.core.flight.setup import FlightSetup
from keepout.core.guard.guard import Guard, starts_certified
from keepout.core.mission.law import broken_as, law_on
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.core.motion.arrays import as_float64
from keepout.core.motion.relative import MotionState
from keepout.core.progress import Progress, silent
from keepout.flights.navigation.suites import navigation

_WANDERING = 0.05
"""Room beyond what the guard asks of a chaser at rest, m: for its way to rest, and for the law's own wandering."""

Point = Sequence[float] | Float[np.ndarray, "3"]


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


def room_for_guard(scenario: Scenario, guard: Guard) -> dict[str, float]:
    """Give the default law's `nominal_offset` (m) by which it stays where the guard passes its commands on."""
    a, radius = guard.assumptions, scenario.chaser.radius
    assert isinstance(guard.field, MapField)
    contact = radius + guard.field.error_bound(radius)
    sagitta = 3.0**0.5 * a.authority * a.period**2 / 8.0
    asked = float(guard.least_value + guard.lipschitz * sagitta) - contact + _WANDERING
    own = least_offset(scenario.chaser.speed_limit, scenario.control.period)
    return {"nominal_offset": max(own, asked - scenario.safety.margin)}


def kept_by_law(scenario: Scenario, field: MapField, guard: Guard | None) -> float:
    """Give the field's value, m, below which the law of `law_by_map` does not lead."""
    own = least_offset(scenario.chaser.speed_limit, scenario.control.period)
    room = {"nominal_offset": own} if guard is None else room_for_guard(scenario, guard)
    radius = scenario.chaser.radius
    return field.error_bound(radius) + radius + scenario.safety.margin + room["nominal_offset"]


def law_by_map(
    scenario: Scenario,
    field: MapField,
    goal: Point,
    position: Point,
    *,
    ball: DeclaredBall,
    guard: Guard | None = None,
    room: float = 3.0,
    every: int | None = None,
    progress: Progress = silent,
) -> Law:
    """Build the default law that leads to a goal by what a map knows, as it flies in `fly_segment`.

    It is the scenario's law with the scenario's delay and faults. Its design conditions are checked and not kept, as
    their numbers differ from goal to goal and would be part of the compiled program.

    Args:
        scenario: as of `law_on`; its own start and goal do not matter.
        field: of the map.
        goal: (3,) m, where to go.
        position: (3,) m, where the chaser is.
        ball: which holds the target.
        guard: whose room the law keeps.
        room: how far beyond the map's box the chaser may be led, m; the same for one flight.
        every: see `grid_of_nodes`.
        progress: called as the work goes on.

    Raises:
        ControlError: the goal is not free, or no way leads there from the position; the message says what is missing.
        ScenarioError: the profile is not the default one, or the map's cap is too low for any goal.

    """
    if scenario.control.profile != "default":
        raise ScenarioError(f'control.profile: "{scenario.control.profile}"; by a map only "default" flies')
    here, there = (tuple(float(x) for x in np.asarray(point)) for point in (position, goal))
    moved = scenario.model_copy(
        update={
            "start": scenario.start.model_copy(update={"position": here}),
            "goal": scenario.goal.model_copy(update={"position": there}),
        }
    )
    bound = field.error_bound(scenario.chaser.radius)
    chosen = {} if guard is None else room_for_guard(scenario, guard)
    offset = kept_by_law(scenario, field, guard)
    _require_cap(field, offset, "the law leads")
    grid = grid_of_nodes(
        np.asarray(field.squares), np.asarray(field.origin), float(field.spacing), offset, room=room, every=every
    )
    plan, reach = Geodesic(grid=grid), max(ball.extent, float(np.linalg.norm(scenario.start.position)))
    build = {"guidance": plan, "reach": reach, "progress": progress, **chosen}
    # Beyond the grid the guidance leads back to it, and all is free there.
    upper = grid.origin + grid.spacing * (np.array(grid.values.shape) - 1)
    within = bool(np.all((np.array(here) >= grid.origin) & (np.array(here) <= upper)))
    try:
        law = law_on(moved, field, bound, from_start=within, **build)
    except KeepOutZoneError as refusal:
        # Law and guard know their way out of the law's own margin; whether a way leads on is then not known.
        if refusal.place != "start":
            raise
        law = law_on(moved, field, bound, from_start=False, **build)
    return broken_as(scenario, dataclasses.replace(law, checked=()), field)


def setup_by_map(scenario: Scenario, field: MapField, ball: DeclaredBall, law: Law, guard: Guard | None) -> FlightSetup:
    """Put a law and a guard of `law_by_map` and `guard_by_map` where a scenario flies, the map's field logged."""
    setup = Surroundings(scenario).setup(law, field=field, guard=guard, goal=law.goal)
    if scenario.navigation.suite == "none":
        return setup
    assumed = Surroundings(scenario, extent=ball.extent).guard_assumptions
    return dataclasses.replace(setup, navigation=navigation(scenario, setup.motion, assumed))


def led_on(setup: FlightSetup, field: MapField, law: Law) -> FlightSetup:
    """Give the setup of a flight's next segment: a later map's field for all, and the law made for it and its goal.

    Raises:
        FieldError: the field is of another grid, or says less somewhere: then what was certified is so no more.

    """
    if isinstance(setup.field, MapField):
        field.require_no_less(setup.field)
    guard = setup.guard
    if isinstance(guard, Guard):
        guard = eqx.tree_at(lambda g: g.field, guard, field)
    return dataclasses.replace(setup, field=field, controller=law, guard=guard, goal=as_float64(law.goal))


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
