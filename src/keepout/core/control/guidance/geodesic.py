"""Build geodesic guidance: the barrier on a grid once a field, the travel time to the goal once a goal."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Int8

from keepout.core.compiled.kept_executables import kept_jit
from keepout.core.control.guidance.fast_marching import UNIT, downhill, travel_time, widest_way
from keepout.core.control.guidance.guidance import GeodesicGuidance, packed
from keepout.core.errors import ControlError, KeepOutZoneError
from keepout.core.fields.field import Field
from keepout.core.fields.field import values as field_values
from keepout.core.motion.arrays import as_float64
from keepout.core.progress import Progress, silent

FULL_SPEED_BARRIER = 0.6
"""Barrier value (m) from which on the travel speed is full; towards the surface it falls in proportion."""
SLOWEST = 0.03
_CHUNK = 65536
_FEW = 1024  # more than the 8 samples on the way to each of 125 nodes around a goal
_MOST_NODES = 4_000_000
_OUTWARD_WEIGHT = 0.25  # weight of a node in the obstacle, whose direction leads out, beside 1 of a free one


@dataclass(frozen=True)
class BarrierGrid:
    """h at the nodes of a regular grid: `values` (nx, ny, nz) m from corner `origin` (3,) m on, `spacing` m apart.

    `walls` (3, nx, ny, nz): edges to the next node along each axis that cross the obstacle between two free nodes.
    Values are exact below `FULL_SPEED_BARRIER` and interpolated beyond. `outwards`: the direction in which h rises, in
    127ths of a unit and shorter than one (see `outwards`), for the nodes that no way to a goal crosses.
    """

    values: Float[np.ndarray, "nx ny nz"]
    walls: Bool[np.ndarray, "3 nx ny nz"]
    outwards: Int8[np.ndarray, "nx ny nz 3"]
    origin: Float[np.ndarray, "3"]
    spacing: float

    @classmethod
    def build(
        cls,
        field: Field,
        offset: float,
        lower: Sequence[float] | Float[np.ndarray, "3"],
        upper: Sequence[float] | Float[np.ndarray, "3"],
        *,
        spacing: float | None = None,
        progress: Progress = silent,
    ) -> "BarrierGrid":
        """Sample h = field − offset in the box from `lower` to `upper` (m).

        The default spacing gives about 400,000 nodes, but never more than 0.9 × offset: a sheet, which the offset
        thickens to twice its length, then always holds two layers of nodes.

        Raises:
            ControlError: the box is empty, the spacing is not positive, or there would be more than 4 million nodes.

        """
        low, high = np.asarray(lower, dtype=float), np.asarray(upper, dtype=float)
        extent = high - low
        if not np.all(extent > 0.0):
            raise ControlError(f"guidance bounds: lower {low.tolist()} must be below upper {high.tolist()} (m)")
        if spacing is None:
            spacing = float(np.cbrt(np.prod(extent) / 4e5))
            if offset > 0.0:
                spacing = min(spacing, max(0.9 * offset, float(np.cbrt(np.prod(extent) / (0.5 * _MOST_NODES)))))
        if not spacing > 0.0:
            raise ControlError(f"guidance spacing: {spacing} m; it must be positive")
        shape = np.maximum(np.ceil(extent / spacing).astype(int) + 1, 5)
        shape += 1 - shape % 2
        if np.prod(shape) > _MOST_NODES:
            raise ControlError(
                f"guidance grid: {np.prod(shape)} nodes at {spacing:.3g} m; at most {_MOST_NODES}: "
                f"use a spacing of {np.cbrt(np.prod(extent) / _MOST_NODES):.3g} m or a smaller box"
            )
        sample = _Sampler(field, offset)
        axes = [first + spacing * np.arange(count) for first, count in zip(low, shape, strict=True)]
        coarse = sample(_nodes([axis[::2] for axis in axes]), lambda f: progress(0.3 * f, "barrier, coarse"))
        coarse = coarse.reshape([len(axis[::2]) for axis in axes])
        values = _refined(coarse)
        # A distance changes by at most one metre a metre, so beyond this band the interpolated value settles every
        # question.
        band = (values < FULL_SPEED_BARRIER + 2.0 * spacing) & (values > -2.0 * spacing)
        band[::2, ::2, ::2] = False
        points = np.stack([axis[i] for axis, i in zip(axes, np.nonzero(band), strict=True)], axis=-1)
        values[band] = sample(points, lambda f: progress(0.3 + 0.5 * f, "barrier"))
        walls = _walls(sample, values, axes, spacing)
        progress(1.0, "barrier")
        return cls(values, walls, outwards(values), low, spacing)

    def node(self, position: Float[np.ndarray, "3"]) -> np.ndarray:
        """Return the indices of the corner of the surrounding cell with the largest barrier."""
        place = (np.asarray(position, dtype=float) - self.origin) / self.spacing
        last = np.array(self.values.shape) - 2
        base = np.clip(np.floor(place).astype(int), 0, last)
        corners = base + np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(-1, 3)
        return corners[np.argmax(self.values[tuple(corners.T)])]

    def require_inside(self, position: Float[np.ndarray, "3"], name: str) -> None:
        """Refuse a position outside the grid."""
        position = np.asarray(position, dtype=float)
        upper = self.origin + self.spacing * (np.array(self.values.shape) - 1)
        if np.any(position < self.origin) or np.any(position > upper):
            raise ControlError(
                f"{name}: {position.tolist()} m lies outside the guidance bounds "
                f"{self.origin.round(3).tolist()} to {upper.round(3).tolist()} m"
            )


class _Sampler:
    """h at many points, with progress."""

    def __init__(self, field: Field, offset: float):
        self._field, self._offset = field, offset

    def __call__(self, points: np.ndarray, progress) -> np.ndarray:
        result = np.empty(len(points))
        for first in range(0, len(points), _CHUNK):
            result[first : first + _CHUNK] = field_values(self._field, points[first : first + _CHUNK])
            progress(min(1.0, (first + _CHUNK) / len(points)))
        return result - self._offset


def _refined(coarse: Float[np.ndarray, "nx ny nz"]) -> Float[np.ndarray, "mx my mz"]:
    """Halve a grid's spacing by trilinear interpolation, m = 2 n - 1: what lies between nodes is their mean.

    The bits are those of `scipy.ndimage.map_coordinates(order=1)`, which takes a tenth of a second to import.
    """
    fine = np.empty([2 * count - 1 for count in coarse.shape])
    for between in np.ndindex(2, 2, 2):
        total = 0.0
        for ahead in np.ndindex(*(1 + odd for odd in between)):
            ends = (count - odd + step for count, odd, step in zip(coarse.shape, between, ahead, strict=True))
            total = total + coarse[tuple(slice(step, end) for step, end in zip(ahead, ends, strict=True))]
        fine[tuple(slice(odd, None, 2) for odd in between)] = total / 2 ** sum(between)
    return fine


def _nodes(axes: list[np.ndarray]) -> np.ndarray:
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def outwards(values: Float[np.ndarray, "nx ny nz"]) -> Int8[np.ndarray, "nx ny nz 3"]:
    """Give the direction in which h (m) rises at each node, in 127ths of a unit times `_OUTWARD_WEIGHT`."""
    directions = np.empty((*values.shape, 3), dtype=np.int8)
    slopes = np.gradient(values.astype(np.float32))
    size = np.sqrt(sum(slope * slope for slope in slopes))
    for axis, slope in enumerate(slopes):
        directions[..., axis] = np.rint(UNIT * _OUTWARD_WEIGHT * slope / np.maximum(size, 1e-6))
    return directions


def _walls(sample: _Sampler, values: np.ndarray, axes: list[np.ndarray], spacing: float) -> np.ndarray:
    """Edges between free nodes that may cross the obstacle, decided by sampling them (a distance is 1-Lipschitz)."""
    walls = np.zeros((3, *values.shape), dtype=bool)
    inner = np.arange(1, 8) / 8.0
    for axis in range(3):
        ahead = np.full(values.shape, -np.inf)
        head: list[slice] = [slice(None)] * 3
        tail: list[slice] = [slice(None)] * 3
        head[axis], tail[axis] = slice(0, -1), slice(1, None)
        ahead[tuple(head)] = values[tuple(tail)]
        doubtful = (values > 0.0) & (ahead > 0.0) & (values + ahead < spacing)
        index = np.nonzero(doubtful)
        base = np.stack([a[i] for a, i in zip(axes, index, strict=True)], axis=-1)
        if len(base) == 0:
            continue
        direction = np.zeros(3)
        direction[axis] = spacing
        points = base[:, None, :] + inner[:, None] * direction
        lowest = sample(points.reshape(-1, 3), lambda _: None).reshape(len(base), -1).min(axis=1)
        walls[axis][index] = lowest <= 0.0
    return walls


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
    towards = None
    if start is not None and beyond < math.inf:
        grid.require_inside(start, "start")
        towards = grid.node(start)
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
    if start is not None:
        start = np.asarray(start, dtype=float)
        require_free(field, offset, start, "start")
        grid.require_inside(start, "start")
        node = grid.node(start)
        if not np.isfinite(time[tuple(node)]):
            missing = max(-widest_way(grid.values, node, sources[0]), 0.0)
            # A way between nodes may be wider than over them, by no more than half the diagonal of a cell's face.
            hint = "; a smaller spacing may find a wider one" if missing < np.sqrt(0.5) * grid.spacing else ""
            raise ControlError(
                f"start: {start.tolist()} m is not connected to the goal {goal.tolist()} m for this chaser; the "
                f"widest way between them misses {missing:.3g} m of clearance (grid {grid.spacing:.3g} m){hint}"
            )
    return guidance


@kept_jit
def _value(field: Field, points: Float[Array, "n 3"]) -> Float[Array, " n"]:
    return field.value(points)


def _few_values(field: Field, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Field values (m) at up to `_FEW` points: a goal asks for so few that a full piece would be most of its cost."""
    padded = np.zeros((_FEW, 3))
    padded[: len(points)] = points
    return np.asarray(_value(field, jax.device_put(padded)))[: len(points)]


def require_free(field: Field, offset: float, position: Float[np.ndarray, "3"], name: str) -> None:
    """Refuse a position where h = field − offset is not positive.

    Raises:
        KeepOutZoneError: it lies inside; the message says by how much.

    """
    barrier = float(_few_values(field, np.asarray(position, dtype=float)[None])[0]) - offset
    if not barrier > 0.0:
        raise KeepOutZoneError(
            f"{name}: {np.asarray(position).tolist()} m lies {-barrier:.3g} m inside the keep-out zone "
            f"(field value {barrier + offset:.3g} m, at least {offset:.3g} m needed)",
            name,
        )


def _around_goal(grid: BarrierGrid, field: Field, offset: float, goal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Free nodes within two cells of the goal that see it, with the straight time to it."""
    centre = np.clip(np.rint((goal - grid.origin) / grid.spacing).astype(int), 0, np.array(grid.values.shape) - 1)
    span = np.arange(-2, 3)
    nodes = centre + np.stack(np.meshgrid(span, span, span, indexing="ij"), axis=-1).reshape(-1, 3)
    nodes = nodes[np.all((nodes >= 0) & (nodes < grid.values.shape), axis=1)]
    nodes = nodes[grid.values[tuple(nodes.T)] > 0.0]
    if len(nodes) == 0:
        return nodes, np.zeros(0)
    points = grid.origin + grid.spacing * nodes
    fractions = np.linspace(0.0, 1.0, 9)[1:]
    between = goal + fractions[:, None, None] * (points - goal)
    barrier = _few_values(field, between.reshape(-1, 3)).reshape(len(fractions), -1) - offset
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
