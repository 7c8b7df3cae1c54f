"""Law and guard by the field of a map: of the target only a ball is known that holds it, and what was seen free.

The guard's numbers hold for every map (docs/mapping.md), so they are the scenario's and the ball's alone. Law and
guard fly by the same field. The guard asks for room beyond its threshold, and the law keeps that room: otherwise it
would lead to where the guard holds it for ever.

A map knows its distance at every node, so that the guidance's grid over every few of them, with exact values, is there
in a fraction of a second, anew for every later map.
"""

import dataclasses
import math
from collections.abc import Sequence

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, UInt16

from keepout.apps.led.driver import Leading
from keepout.apps.unknown.known_free import KnownFreeMap
from keepout.apps.unknown.map_field import SLOPE, MapField
from keepout.core.control.barrier_grid import BarrierGrid, outwards
from keepout.core.control.law import Law
from keepout.core.control.profiles import least_offset
from keepout.core.cores import kernel
from keepout.core.errors import KeepOutZoneError, ScenarioError
from keepout.core.geometry.distance import Point
from keepout.core.guard.guard import Guard
from keepout.core.guard.start import starts_certified
from keepout.core.mission.law import broken_as
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.core.motion.relative import MotionState
from keepout.flights.navigation.suites import navigation

MOST_NODES = 1_600_000
"""By default a grid takes every few nodes of the map, so that it has no more than these: a second's march at most."""

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


def grid_of_nodes(
    squares: UInt16[np.ndarray, "nx ny nz"],
    origin: Sequence[float] | Float[np.ndarray, "3"],
    spacing: float,
    offset: float,
    *,
    room: float = 3.0,
    every: int | None = None,
) -> BarrierGrid:
    """Give h = f − offset, f the cubic spline of a map's node distances, at every few nodes of the map.

    An edge is a wall where h is not positive at a node of the map on it. The grid's shape depends on no distance, so
    guidances by one map at several times have one shape.

    Args:
        squares: at the map's nodes, the squared distance in cells to what is not known free; at the cap near the faces.
        origin: of node (0, 0, 0), m.
        spacing: between the map's nodes, m.
        offset: of the barrier, m.
        room: by how much the grid reaches beyond the map's box on every side, m; the distance is at the cap there.
        every: how many of the map's nodes lie from one of the grid to the next; by default the fewest that
            `MOST_NODES` allow.

    """
    beyond = math.ceil(max(room, 0.0) / spacing)
    extent = np.array(squares.shape) - 1 + 2 * beyond
    if every is None:
        every = 1
        while np.prod(-(-extent // every) + 1) > MOST_NODES:
            every += 1
    shape = np.maximum(-(-extent // every) + 1, 5)
    # What is too much is shared between both sides.
    first = -beyond - (every * (shape - 1) - extent) // 2
    values = np.empty(tuple(shape))
    walls = np.zeros((3, *shape), dtype=bool)
    _sample(squares, first, every, float(spacing), float(offset), values, walls)
    return BarrierGrid(values, walls, outwards(values), np.asarray(origin) + spacing * first, every * spacing)


@kernel()
def _spline(squares, roots, x, y, z):
    """Evaluate the spline at a node, in cells: means with weights 1/6, 4/6, 1/6 along each axis."""
    nx, ny, nz = squares.shape
    if x < 1 or y < 1 or z < 1 or x >= nx - 1 or y >= ny - 1 or z >= nz - 1:
        return roots[squares[0, 0, 0]]
    total = 0.0
    for i in range(-1, 2):
        for j in range(-1, 2):
            line = roots[squares[x + i, y + j, z - 1]] + roots[squares[x + i, y + j, z + 1]]
            line += 4.0 * roots[squares[x + i, y + j, z]]
            total += line * ((4.0 if i == 0 else 1.0) * (4.0 if j == 0 else 1.0))
    return total / 216.0


@kernel()
def _sample(squares, first, every, spacing, offset, values, walls):
    most = squares[0, 0, 0]
    roots = np.sqrt(np.arange(most + 1))
    nx, ny, nz = values.shape
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                x, y, z = first[0] + every * i, first[1] + every * j, first[2] + every * k
                here = spacing * _spline(squares, roots, x, y, z) - offset
                values[i, j, k] = here
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                here = values[i, j, k]
                if here <= 0.0:
                    continue
                for axis in range(3):
                    a, b, c = i + (axis == 0), j + (axis == 1), k + (axis == 2)
                    # The spline's slope is below 1.2 (`SLOPE`): from there on no node between can be in the obstacle.
                    if a >= nx or b >= ny or c >= nz or values[a, b, c] <= 0.0:
                        continue
                    if here + values[a, b, c] >= 1.2 * every * spacing:
                        continue
                    for step in range(1, every):
                        x = first[0] + every * i + step * (axis == 0)
                        y = first[1] + every * j + step * (axis == 1)
                        z = first[2] + every * k + step * (axis == 2)
                        if spacing * _spline(squares, roots, x, y, z) <= offset:
                            walls[axis, i, j, k] = True
                            break
