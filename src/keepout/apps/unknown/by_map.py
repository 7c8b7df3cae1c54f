"""Law and guard by the field of a map: of the target only a ball is known that holds it, and what was seen free.

The guard's numbers hold for every map (docs/mapping.md), so they are the scenario's and the ball's alone. Law and
guard fly by the same field. The guard asks for room beyond its threshold, and the law keeps that room: otherwise it
would lead to where the guard holds it for ever.

A map knows its distance at every node, so that the guidance's grid over every few of them, with exact values, is there
in a fraction of a second, anew for every later map.

The field is a C² cubic B-spline over the distances of a grid's nodes to all that is not known free. Its bounds hold for
any map, whatever was seen and in whatever order (docs/mapping.md):

- f ≤ √(d² + h²), with d the distance to the cubes that are not known free and h their edge;
- where free room grows, f falls nowhere, in floating point neither;
- ‖∇f‖ ≤ `SLOPE` everywhere.

There is one level of one spacing: a block that changed its spacing would lower the field.
"""

import dataclasses
import functools
import math
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int32, Shaped, UInt16

from keepout.apps.led.driver import Leading, Point
from keepout.apps.unknown.known_free import KnownFreeMap
from keepout.core.compiled.in_batches import joined_rows, rows_last
from keepout.core.control.barrier_grid import BarrierGrid, outwards
from keepout.core.control.law import Law
from keepout.core.control.profiles import least_offset
from keepout.core.cores import kernel
from keepout.core.errors import FieldError, KeepOutZoneError, ScenarioError
from keepout.core.fields.field import Field, of_places
from keepout.core.guard.guard import Guard
from keepout.core.guard.start import starts_certified
from keepout.core.mission.law import broken_as
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.core.motion.relative import MotionState
from keepout.flights.navigation.suites import navigation

SLOPE = 1.14
"""L: no map's field has a gradient of a larger norm; proved by `benchmarks/map_slope.py`."""
EDGE = 3
"""Layers of nodes on each side of the box that must be at the cap, so that the field is one constant from there on."""


class MapField(Field):
    """Σ_i c_i B₃((p − x_i)/h), c_i = h √squares_i, over the nodes x_i of one grid; the constant `cap` beyond its box.

    Make it with `MapField.of`. A program compiled for one map takes every later one of the same shape.

    Attributes:
        squares: at each node, the squared distance in cells to the nearest cube that is not known free, cut off at one
            number that all nodes near the box's faces have.
        origin: (3,) the first node, metres.
        spacing: h, metres.

    """

    squares: UInt16[Array, "nx ny nz"]
    origin: Float[Array, "3"]
    spacing: Float[Array, ""]

    @classmethod
    def of(
        cls, squares: Shaped[np.ndarray, "nx ny nz"], origin: Sequence[float] | Float[np.ndarray, "3"], spacing: float
    ) -> "MapField":
        """Take a copy of a map's squared node distances, so that the map may grow on.

        Args:
            squares: uint16, squared distances in cells, cut off at the number that the nodes near the box's faces have.
            origin: of node (0, 0, 0), m.
            spacing: between nodes, m.

        Raises:
            FieldError: another type or shape, an origin or spacing that is no length, or a node in the outermost three
                layers that is not at the cap.

        """
        squares, first = np.asarray(squares), np.asarray(origin, np.float64)
        if squares.dtype != np.uint16 or squares.ndim != 3 or min(squares.shape) < 2 * EDGE:
            raise FieldError(
                f"map field: squares of type {squares.dtype} and shape {squares.shape}; uint16 in three axes of "
                f"{2 * EDGE} nodes or more are needed"
            )
        if not (math.isfinite(spacing) and spacing > 0.0):
            raise FieldError(f"map field: spacing is {spacing} m; it must be finite and greater than 0")
        if first.shape != (3,) or not np.all(np.isfinite(first)):
            raise FieldError(f"map field: origin is {origin}; three finite numbers in metres are needed")
        cap, most = int(squares[0, 0, 0]), int(squares.max())
        for axis in range(3):
            for layers in (slice(0, EDGE), slice(-EDGE, None)):
                outer = np.moveaxis(squares, axis, 0)[layers]
                if int(outer.min()) != cap or most > cap:
                    raise FieldError(
                        f"map field: squares from {int(outer.min())} to {int(outer.max())} in the outermost {EDGE} "
                        f"layers along axis {axis}, and up to {most} elsewhere; all of these layers must be at the "
                        f"cap, {cap}"
                    )
        # A copy: JAX may otherwise go on reading the very memory in which the map grows.
        return cls(jnp.array(squares, copy=True), jax.device_put(first), jax.device_put(np.float64(spacing)))

    @property
    def cap(self) -> float:
        """The largest value, that of all points beyond the box, m."""
        return float(self.spacing) * math.sqrt(int(self.squares[0, 0, 0]))

    def error_bound(self, radius: float) -> float:
        """Give e_h, m: where what is not known free is `radius` m away, the field says at most e_h more."""
        return math.hypot(radius, float(self.spacing)) - radius + self.evaluation_error

    def require_no_less(self, before: "MapField") -> None:
        """Refuse to come after another map's field if it is of another grid, or lower anywhere.

        Raises:
            FieldError: the message says which.

        """
        for name in ("origin", "spacing"):
            now, then = np.asarray(getattr(self, name)), np.asarray(getattr(before, name))
            if not np.array_equal(now, then):
                raise FieldError(f"map field: {name} {now.tolist()} m comes after {then.tolist()} m; it must stay")
        now, then = np.asarray(self.squares), np.asarray(before.squares)
        if now.shape != then.shape:
            raise FieldError(f"map field: {now.shape} nodes come after {then.shape}; they must be the same")
        # Layer by layer: a whole map's comparison would take half the map's memory again.
        fallen = sum(int(np.count_nonzero(one < other)) for one, other in zip(now, then, strict=True))
        if fallen:
            raise FieldError(
                f"map field: {fallen} nodes are nearer to what is not known free than in the map before; free room "
                "may only grow"
            )

    @property
    def evaluation_error(self) -> float:
        """Bound, m, of what float64 and any order of sums make of the exact spline (docs/mapping.md)."""
        return 2.0**-53 * (256.0 * self.cap + 16.0 * float(self.spacing) * max(self.squares.shape))

    def _places(self, points: Float[Array, "n 3"]) -> tuple[Int32[Array, "n 3"], Float[Array, "n 3"]]:
        """Give the first node of each point's 4 × 4 × 4 coefficients, and its place in the middle cell."""
        last = jnp.asarray(self.squares.shape) - 2.0
        # Beyond these nodes all coefficients are at the cap, so the nearest point within says the same.
        held = jnp.clip((points - self.origin) / self.spacing, 1.0, last)
        cell = jnp.minimum(jax.lax.stop_gradient(jnp.floor(held)), last - 1.0)
        return cell.astype(jnp.int32) - 1, held - cell

    def value(self, points: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Distance to all that is not known free, in metres, at most the cap."""
        found = joined_rows(_value, self.squares, self._places(points.reshape(-1, 3)))
        return of_places(points, (self.spacing * found).reshape(points.shape[:-1]))

    def value_and_gradient(
        self, points: Float[Array, "*batch 3"]
    ) -> tuple[Float[Array, "*batch"], Float[Array, "*batch 3"]]:
        """Distance in metres and its gradient."""
        value, gradient = joined_rows(_first, self.squares, self._places(points.reshape(-1, 3)))
        return of_places(points, (self.spacing * value).reshape(points.shape[:-1])), gradient.reshape(points.shape)

    def value_gradient_hessian(
        self, points: Float[Array, "*batch 3"]
    ) -> tuple[Float[Array, "*batch"], Float[Array, "*batch 3"], Float[Array, "*batch 3 3"]]:
        """Distance in metres, gradient, and Hessian in 1/m."""
        batch = points.shape[:-1]
        value, gradient, hessian = joined_rows(_second, self.squares, self._places(points.reshape(-1, 3)))
        return (
            of_places(points, (self.spacing * value).reshape(batch)),
            gradient.reshape(points.shape),
            (hessian / self.spacing).reshape(*batch, 3, 3),
        )


_Weights = tuple[Float[Array, "n"], ...]
"""Of the four coefficients along one axis."""
_At = tuple[Int32[Array, "n 3"], Float[Array, "n 3"]]


def _taken(squares: UInt16[Array, "nx ny nz"], at: _At) -> tuple[Float[Array, "4 4 4 n"], list]:
    """Look up the coefficients of each place, in cells, places last; and the weights along each axis, by derivative."""
    start, place = at
    blocks = jax.vmap(lambda node: jax.lax.dynamic_slice(squares, node, (4, 4, 4)))(start)
    return jnp.sqrt(rows_last(blocks).astype(jnp.float64)), [_cubic_weights(place[:, axis]) for axis in range(3)]


def _value(squares: UInt16[Array, "nx ny nz"], at: _At) -> Float[Array, "n"]:
    found, ((x, *_), (y, *_), (z, *_)) = _taken(squares, at)
    return _contracted(_contracted(_contracted(found, x), y), z)


def _first(squares: UInt16[Array, "nx ny nz"], at: _At) -> tuple[Float[Array, "n"], Float[Array, "n 3"]]:
    found, ((x, dx, _), (y, dy, _), (z, dz, _)) = _taken(squares, at)
    along, across = _contracted(found, x), _contracted(found, dx)
    both = _contracted(along, y)
    gradient = _contracted(_contracted(across, y), z), _contracted(_contracted(along, dy), z), _contracted(both, dz)
    return _contracted(both, z), jnp.stack(gradient, axis=-1)


def _second(
    squares: UInt16[Array, "nx ny nz"], at: _At
) -> tuple[Float[Array, "n"], Float[Array, "n 3"], Float[Array, "n 3 3"]]:
    found, (x, y, z) = _taken(squares, at)
    planes = [_contracted(found, weights) for weights in x]

    def derivative(i: int, j: int, k: int) -> Float[Array, "n"]:
        return _contracted(_contracted(planes[i], y[j]), z[k])

    gradient = [derivative(1, 0, 0), derivative(0, 1, 0), derivative(0, 0, 1)]
    xy, xz, yz = derivative(1, 1, 0), derivative(1, 0, 1), derivative(0, 1, 1)
    rows = [[derivative(2, 0, 0), xy, xz], [xy, derivative(0, 2, 0), yz], [xz, yz, derivative(0, 0, 2)]]
    hessian = jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
    return derivative(0, 0, 0), jnp.stack(gradient, axis=-1), hessian


def _cubic_weights(t: Float[Array, "n"]) -> tuple[_Weights, _Weights, _Weights]:
    """Give the four weights at places t in [0, 1] of the middle cell, and their first and second derivatives.

    No weight is below 0, in floating point neither: 4 − 6t² + 3t³ is at least 1.
    """
    s = 1.0 - t
    value = (
        s**3 / 6.0,
        (4.0 - 6.0 * t**2 + 3.0 * t**3) / 6.0,
        (4.0 - 6.0 * s**2 + 3.0 * s**3) / 6.0,
        t**3 / 6.0,
    )
    slope = (-0.5 * s**2, 1.5 * t**2 - 2.0 * t, 2.0 * s - 1.5 * s**2, 0.5 * t**2)
    return value, slope, (s, 3.0 * t - 2.0, 3.0 * s - 2.0, t)


def _contracted(blocks: Float[Array, "4 *rest n"], weights: Sequence[Float[Array, "n"]]) -> Float[Array, "*rest n"]:
    """Sum over the first axis with one weight a cell, cells last.

    The barrier keeps XLA from writing the sums of several axes into one expression of 64 terms, which takes minutes to
    compile.
    """
    terms = [weight * block for weight, block in zip(weights, blocks, strict=True)]
    return jax.lax.optimization_barrier(functools.reduce(jnp.add, terms))


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
