"""Geodesic guidance: along the shortest free way to the goal. The travel time to it is marched once a goal."""

import dataclasses
import functools
import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int, Int8, Int32

from keepout.core.compiled.in_batches import joined_rows, rows_last
from keepout.core.control.barrier_grid import (
    FEW,
    FULL_SPEED_BARRIER,
    UNIT,
    BarrierGrid,
    downhill,
    nodes_of,
    require_free,
    travel_time,
    widest_way,
)
from keepout.core.control.guidance import Guidance, GuidancePlan, Point, SlowingGuidance, Travel, towards
from keepout.core.errors import ControlError
from keepout.core.fields.field import Field, values
from keepout.core.motion.arrays import Scalar, Vector, as_float64

SLOWEST = 0.03
Corners = tuple[Sequence[float] | Point, Sequence[float] | Point]
_EDGE = 32
"""Nodes; the edges of a grid's array are multiples of it."""


_ALONG = np.array([1, 0, 0], dtype=np.int32)


def _whole(number: ArrayLike) -> Array:
    if isinstance(number, jax.Array):
        return number
    return jax.device_put(np.asarray(number, dtype=np.int32))


class GeodesicGuidance(SlowingGuidance):
    """Along the shortest free way to the goal, blended into the straight line near it (docs/control.md).

    `directions` holds at each node of a regular grid with corner `origin` (m) and `spacing` (m) the direction in which
    the travel time falls, in 127ths, its three components packed into one number (`packed`). The grid has `nodes` of
    them along each axis, and the array may have more: those mean nothing, and let grids of several sizes share a
    compiled program. The directions are blended by cubic B-splines, so that v_c is twice continuously differentiable.
    Directions and not times are blended, because times on two sides of a wall, or in it, may differ by any amount: in
    a gap of one node their spline has a minimum before the gap, and a chaser would wait there.
    Where the array holds several grids one behind the other along its first axis, this one begins at node `first`.
    Between `inner` and `outer` metres from the goal the direction turns from straight to geodesic. Outside the grid the
    way leads back to it. The speed is v_max tanh(‖r_e‖ / k_p). Build it with
    `keepout.core.control.geodesic.geodesic_guidance`.
    """

    directions: Int32[Array, "nx ny nz"]
    nodes: Vector
    origin: Vector
    spacing: Scalar
    inner: Scalar
    outer: Scalar
    first: Int32[Array, ""] = eqx.field(converter=_whole, default=0)

    def desired_velocity(self, position: Vector) -> Vector:
        """Return the desired velocity, m/s."""
        straight, distance = towards(self.goal, position, self.slowing_length)
        geodesic = self.direction(position) * jnp.tanh(distance / self.slowing_length)
        s = jnp.clip((distance - self.inner) / (self.outer - self.inner), 0.0, 1.0)
        weight = s * s * (3.0 - 2.0 * s)
        return self.speed * (weight * geodesic + (1.0 - weight) * straight)

    def direction(self, position: Vector) -> Vector:
        """Return the unit vector along the way to the goal, or zero where nothing leads there."""
        last = self.nodes - 2.0
        place = (position - self.origin) / self.spacing
        held = jnp.clip(place, 1.0, last - 1e-9)
        outside = place - held
        cell = jax.lax.stop_gradient(jnp.floor(held))
        start = cell.astype(jnp.int32) - 1 + self.first * _ALONG
        blended = joined_rows(_blended, self.directions, (start[None], (held - cell)[None]))[0]
        # Where the position is beyond the grid along some axis, that axis leads back and the others keep their say.
        # Within the grid nothing is beyond. A unit vector of nothing is zero, but its derivative is immense, and taken
        # backwards it would swallow the digits of all that is added to it.
        beyond = jnp.any(outside != 0.0)
        back = jnp.where(beyond, _unit(jnp.where(beyond, outside, 1.0)), 0.0)
        along = jnp.where(outside == 0.0, _unit(blended), 0.0) - back
        return _unit(along)


def one_behind_the_other(ways: Sequence[GeodesicGuidance]) -> tuple[GeodesicGuidance, ...]:
    """Give guidances of one shape whose directions are one array, that of all of them."""
    grids = [np.asarray(way.directions) for way in ways]
    most = np.max([grid.shape for grid in grids], axis=0)
    padded = [np.pad(grid, [(0, 0), *((0, int(m - n)) for m, n in zip(most[1:], grid.shape[1:]))]) for grid in grids]
    whole = jax.device_put(np.concatenate(padded))
    firsts = np.cumsum([0, *(len(grid) for grid in grids)])
    return tuple(
        dataclasses.replace(way, directions=whole, first=first)
        for way, first in zip(ways, firsts[:-1].astype(np.int32))
    )


def packed(directions: Int8[np.ndarray, "nx ny nz 3"]) -> Int32[np.ndarray, "mx my mz"]:
    """Put three numbers of a byte into one, x lowest: a third as many look-ups, and a whole number a node.

    Each axis is filled up with zeros to a multiple of `_EDGE` nodes.
    """
    bytes_ = directions.view(np.uint8).astype(np.int32)
    numbers = bytes_[..., 0] | bytes_[..., 1] << 8 | bytes_[..., 2] << 16
    return np.pad(numbers, [(0, -count % _EDGE) for count in numbers.shape])


def _blended(
    directions: Int32[Array, "nx ny nz"], at: tuple[Int32[Array, "n 3"], Float[Array, "n 3"]]
) -> Float[Array, "n 3"]:
    """Blend the 4 × 4 × 4 directions from each node `at[0]` on, at the places `at[1]` in [0, 1) of the middle cell."""
    start, place = at
    blocks = jax.vmap(lambda node: jax.lax.dynamic_slice(directions, node, (4, 4, 4)))(start)
    blocks, weights = rows_last(blocks), [_cubic_weights(place[:, axis]) for axis in range(3)]
    components = []
    for shift in (24, 16, 8):
        # The byte moved to the top and back down brings its sign along.
        components.append(_contracted(((blocks << shift) >> 24).astype(jnp.float64), weights))
    return jnp.stack(components, axis=-1)


def _contracted(blocks: Float[Array, "4 4 4 n"], weights: Sequence[Sequence[Float[Array, "n"]]]) -> Float[Array, "n"]:
    """Sum a block of numbers a row, rows last, with one set of weights an axis.

    The barriers keep XLA from writing all 64 terms into one expression, which takes minutes to compile.
    """
    for weight in weights:
        terms = [w * block for w, block in zip(weight, blocks, strict=True)]
        blocks = jax.lax.optimization_barrier(functools.reduce(jnp.add, terms))
    return blocks


def _unit(vector: Vector) -> Vector:
    """Return the vector at length 1, or zero; its derivative is finite everywhere."""
    return vector / jnp.sqrt(jnp.sum(vector * vector) + 1e-300)


def _cubic_weights(t: Float[Array, "n"]) -> tuple[Float[Array, "n"], ...]:
    """Return the four cubic B-spline weights at t in [0, 1)."""
    u = 1.0 - t
    return u**3 / 6.0, (4.0 - 6.0 * t**2 + 3.0 * t**3) / 6.0, (4.0 - 6.0 * u**2 + 3.0 * u**3) / 6.0, t**3 / 6.0


def geodesic_guidance(
    grid: BarrierGrid,
    field: Field,
    offset: float,
    goal: Float[np.ndarray, "3"],
    *,
    speed: float,
    slowing_length: float,
    start: Float[np.ndarray, "3"] | None = None,
    beyond: float = math.inf,
) -> GeodesicGuidance:
    """March the travel time from the goal through the free nodes of the grid, and keep the directions down it.

    The travel speed is clip(h/0.6 m, 0.03, 1) m/s. Directions in the obstacle lead out of it, and weigh little: in a
    gap between two walls they must not stop the way that leads through.

    Args:
        grid: of the barrier.
        field: likewise.
        offset: of the barrier, m.
        goal: (3,) m.
        speed: of the guidance, m/s.
        slowing_length: within which it slows down, m.
        start: (3,) m, which must be joined to the goal.
        beyond: travel seconds more than twice those from `start`, from where on no way is looked for.

    Raises:
        ControlError: goal or start lies outside the grid or in the obstacle, or no way as wide as the chaser joins
        them; the
            message says by how much.

    """
    goal = np.asarray(goal, dtype=float)
    require_free(field, offset, goal, "goal")
    grid.require_inside(goal, "goal")
    speeds = np.where(grid.values > 0.0, np.clip(grid.values / FULL_SPEED_BARRIER, SLOWEST, 1.0), 0.0)
    sources, times = _around_goal(grid, field, offset, goal)
    if len(sources) == 0:
        raise ControlError(
            f"goal: {goal.tolist()} m has no free grid node beside it at a spacing of {grid.spacing:.3g} m; "
            "move it out of the gap or give a smaller spacing"
        )
    node = None
    if start is not None:
        start = np.asarray(start, dtype=float)
        require_free(field, offset, start, "start")
        grid.require_inside(start, "start")
        node = grid.node(start)
    towards = node if beyond < math.inf else None
    time = travel_time(speeds, grid.walls, sources, times, grid.spacing, towards=towards, beyond=beyond)
    guidance = GeodesicGuidance(
        goal=as_float64(goal),
        speed=as_float64(speed),
        slowing_length=as_float64(slowing_length),
        directions=jax.device_put(packed(_directions(grid, time, sources, goal))),
        nodes=as_float64(time.shape),
        origin=as_float64(grid.origin),
        spacing=as_float64(grid.spacing),
        inner=as_float64(max(0.6, grid.spacing)),
        outer=as_float64(max(1.2, 2.0 * grid.spacing)),
    )
    if start is not None and node is not None and not np.isfinite(time[tuple(node)]):
        missing = max(-widest_way(grid.values, node, sources[0]), 0.0)
        # A way between nodes may be wider than over them, by no more than half the diagonal of a cell's face.
        hint = "; a smaller spacing may find a wider one" if missing < np.sqrt(0.5) * grid.spacing else ""
        raise ControlError(
            f"start: {start.tolist()} m is not connected to the goal {goal.tolist()} m for this chaser; the "
            f"widest way between them misses {missing:.3g} m of clearance (grid {grid.spacing:.3g} m){hint}"
        )
    return guidance


def _around_goal(grid: BarrierGrid, field: Field, offset: float, goal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Free nodes within two cells of the goal that see it, with the straight time to it."""
    centre = np.clip(np.rint((goal - grid.origin) / grid.spacing).astype(int), 0, np.array(grid.values.shape) - 1)
    nodes = centre + nodes_of([np.arange(-2, 3)] * 3)
    nodes = nodes[np.all((nodes >= 0) & (nodes < grid.values.shape), axis=1)]
    nodes = nodes[grid.values[tuple(nodes.T)] > 0.0]
    if len(nodes) == 0:
        return nodes, np.zeros(0)
    points = grid.origin + grid.spacing * nodes
    fractions = np.linspace(0.0, 1.0, 9)[1:]
    between = goal + fractions[:, None, None] * (points - goal)
    barrier = values(field, between.reshape(-1, 3), FEW).reshape(len(fractions), -1) - offset
    seen = np.all(barrier > 0.0, axis=0)
    speed = np.clip(barrier / FULL_SPEED_BARRIER, SLOWEST, 1.0)
    times = np.linalg.norm(points - goal, axis=1) * np.mean(1.0 / speed, axis=0)
    return nodes[seen], times[seen]


def _directions(
    grid: BarrierGrid,
    time: Float[np.ndarray, "nx ny nz"],
    sources: Int[np.ndarray, "n 3"],
    goal: Float[np.ndarray, "3"],
) -> Int8[np.ndarray, "nx ny nz 3"]:
    """Return unit vectors in 127ths: down the time, straight at the sources, and `grid.outwards` where no way leads."""
    directions = grid.outwards.copy()
    downhill(time, grid.walls, directions)
    straight = goal - (grid.origin + grid.spacing * sources)
    length = np.linalg.norm(straight, axis=1, keepdims=True)
    directions[tuple(sources.T)] = np.rint(UNIT * straight / np.maximum(length, 1e-12))
    return directions


@dataclass(frozen=True)
class Geodesic(GuidancePlan):
    """Along the shortest free way round the keep-out zone (`GeodesicGuidance`).

    Attributes:
        spacing: of the grid of travel times, m; by default from the room and the zone's width.
        bounds: (lower, upper) corners of that grid, m; by default a box around target, goal and start.
        grid: a `BarrierGrid` to share between goals, instead of both; made for the same offset.
        beyond: travel seconds (at 1 m/s in free room) more than twice those from the start, from where on the guidance
            leads away from the obstacle only: a flight that stays about its way needs no more of the grid.

    """

    spacing: float | None = None
    bounds: Corners | None = None
    grid: BarrierGrid | None = None
    beyond: float = math.inf

    def guidance(self, field: Field, offset: float, goal: Point, travel: Travel) -> Guidance:
        """Make the guidance: seconds for the grid, where it is not given."""
        grid = self.grid
        if grid is None:
            lower, upper = room_around(field, offset, goal, travel.start) if self.bounds is None else self.bounds
            grid = BarrierGrid.build(field, offset, lower, upper, spacing=self.spacing, progress=travel.progress)
        motion = {"speed": travel.speed, "slowing_length": travel.slowing_length, "start": travel.start}
        return geodesic_guidance(grid, field, offset, goal, **motion, beyond=self.beyond)

    def again(self, made: Guidance, speed: float, slowing_length: float) -> Guidance:
        """Give a guidance that this plan made with another speed and slowing length: no other part has them."""
        return dataclasses.replace(
            made, speed=as_float64(float(speed)), slowing_length=as_float64(float(slowing_length))
        )

    def identity(self, field: Field) -> tuple[Hashable, ...]:
        """Say what a guidance depends on beside field, offset, goal and start."""
        return (self.spacing,)


def room_around(field: Field, offset: float, goal: Point, start: Point | None) -> tuple[Point, Point]:
    """Find a box around goal, start and all where the barrier is below 1.5 m, by growing until its faces are clear.

    A distance is 1-Lipschitz, so a face is clear where its samples exceed 1.5 m by half their spacing.

    Raises:
        ControlError: the keep-out zone has no end near the target.

    """
    points = np.stack([goal, np.zeros(3)] + ([] if start is None else [start]))
    lower, upper = points.min(axis=0) - 2.0, points.max(axis=0) + 2.0
    fractions = np.linspace(0.0, 1.0, 33)
    for _ in range(60):
        grown = False
        for axis in range(3):
            extent = upper - lower
            spread = 0.5 * float(np.hypot(*np.delete(extent, axis))) / 32.0
            for side, edge in ((-1.0, lower), (1.0, upper)):
                lines = list(lower[:, None] + fractions * extent[:, None])
                lines[axis] = edge[axis : axis + 1]
                gap = float(np.min(values(field, nodes_of(lines)))) - offset
                if gap < 1.5 + spread:
                    edge[axis] += side * max(1.0, 1.5 + spread - gap)
                    grown = True
        if not grown:
            return lower, upper
    raise ControlError(
        "guidance bounds: the keep-out zone has no end near the target; give bounds=(lower, upper) in metres"
    )
