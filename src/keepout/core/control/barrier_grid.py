"""The grid that geodesic guidance marches over, the barrier at its nodes and walls between them; and the march over it.

The march is Sethian's (1996). In it, grids are padded by one closed node on every side and flattened: a neighbour is an
index plus or minus a stride.
"""

import bisect
import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, Int8

from keepout.core.cores import kernel
from keepout.core.errors import ControlError, KeepOutZoneError
from keepout.core.fields.field import Field
from keepout.core.fields.field import values as values_of
from keepout.core.progress import Progress, silent

UNIT = 127.0
"""What stands for 1 in a direction of 8-bit integers."""


def travel_time(
    speed: Float[np.ndarray, "nx ny nz"],
    walls: Bool[np.ndarray, "3 nx ny nz"],
    sources: Int[np.ndarray, "n 3"],
    source_times: Float[np.ndarray, " n"],
    spacing: float,
    *,
    towards: Int[np.ndarray, "3"] | None = None,
    beyond: float = math.inf,
) -> Float[np.ndarray, "nx ny nz"]:
    """Solve ‖∇D‖ speed = 1 with D given at the sources, first order upwind.

    Args:
        speed: m/s; not positive where there is no way.
        walls: walls[a, i, j, k] closes the edge from node (i, j, k) to the next along axis a.
        sources: node indices.
        source_times: s.
        spacing: between nodes, m.
        towards: a node that the way begins at.
        beyond: seconds more than twice that node's D, from where on D need not be found; it is then infinite.

    Returns:
        D in seconds, infinite where nothing leads.

    """
    padded = np.pad(np.asarray(speed, dtype=np.float64), 1)
    closed = np.pad(walls, ((0, 0), (1, 1), (1, 1), (1, 1))).reshape(3, -1)
    index = np.ravel_multi_index(tuple((np.asarray(sources) + 1).T), padded.shape)
    strides = np.array([padded.shape[1] * padded.shape[2], padded.shape[2], 1])
    last = -1 if towards is None else int(np.ravel_multi_index(tuple(np.asarray(towards) + 1), padded.shape))
    times = np.asarray(source_times, dtype=np.float64)
    time = _march(padded.ravel(), closed, strides, index, times, float(spacing), last, float(beyond))
    return time.reshape(padded.shape)[1:-1, 1:-1, 1:-1]


@kernel()
def _march(speed, walls, strides, sources, source_times, spacing, last, beyond):
    """Settle nodes bucket by bucket of time, and again whenever a neighbour's time falls: no heap, the same solution.

    The upwind equations have one solution, and times only ever fall towards it, so the order of work is free; buckets
    of half the shortest crossing of a cell keep repeats few (Yatziv, Bartesaghi & Sapiro 2006, without its error).
    """
    time = np.full(speed.size, np.inf)
    fastest, slowest = 0.0, np.inf
    for value in speed:
        if value > 0.0:
            fastest, slowest = max(fastest, value), min(slowest, value)
    if fastest == 0.0 or sources.size == 0:
        return time
    width = 0.5 * spacing / fastest
    # No time waiting exceeds the present one by more than a crossing of the slowest cell, or than the sources' spread.
    count = int((spacing / slowest + source_times.max() - source_times.min()) / width) + 3
    first = np.full(count, -1, dtype=np.int32)
    following = np.full(speed.size, -1, dtype=np.int32)
    place = np.full(speed.size, -1, dtype=np.int32)
    before = np.full(speed.size, -1, dtype=np.int32)
    waiting = 0
    for n in range(sources.size):
        node = sources[n]
        if speed[node] > 0.0 and source_times[n] < time[node]:
            time[node] = source_times[n]
            waiting += _enqueue(first, following, before, place, node, int(time[node] / width) % count)
    bucket = int(source_times.min() / width) % count
    limit = np.inf
    while waiting > 0:
        node = first[bucket]
        if node < 0:
            bucket = (bucket + 1) % count
            continue
        _dequeue(first, following, before, place, node)
        waiting -= 1
        here = time[node]
        if node == last:
            limit = 2.0 * here + beyond
        if here > limit:
            time[node] = np.inf
            continue
        for axis in range(3):
            for sign in (-1, 1):
                beside = node + sign * strides[axis]
                # Upwind, a node is reached only from neighbours with an earlier time.
                if time[beside] <= here or speed[beside] <= 0.0 or walls[axis, min(node, beside)]:
                    continue
                value = _update(time, walls, strides, beside, spacing / speed[beside])
                if value < time[beside]:
                    time[beside] = value
                    if place[beside] >= 0:
                        _dequeue(first, following, before, place, beside)
                        waiting -= 1
                    waiting += _enqueue(first, following, before, place, beside, int(value / width) % count)
    return time


@kernel()
def _enqueue(first, following, before, place, node, bucket):
    head = first[bucket]
    following[node], before[node], place[node] = head, -1, bucket
    if head >= 0:
        before[head] = node
    first[bucket] = node
    return 1


@kernel()
def _dequeue(first, following, before, place, node):
    if before[node] >= 0:
        following[before[node]] = following[node]
    else:
        first[place[node]] = following[node]
    if following[node] >= 0:
        before[following[node]] = before[node]
    place[node] = -1


@kernel()
def _update(time, walls, strides, node, cost):
    """Solve Σ max(D − D_a, 0)² = cost² with the smaller neighbour D_a along each axis."""
    first, second, third = np.inf, np.inf, np.inf
    for axis in range(3):
        below, above = node - strides[axis], node + strides[axis]
        best = np.inf
        if not walls[axis, below]:
            best = time[below]
        if not walls[axis, node] and time[above] < best:
            best = time[above]
        if best < first:
            first, second, third = best, first, second
        elif best < second:
            second, third = best, second
        else:
            third = min(third, best)
    value = first + cost
    if value <= second:
        return value
    # The discriminants are not negative: the step before reached beyond the neighbour that is added.
    value = 0.5 * (first + second + np.sqrt(2.0 * cost * cost - (second - first) ** 2))
    if value <= third:
        return value
    total = first + second + third
    square = first * first + second * second + third * third
    return (total + np.sqrt(max(total * total - 3.0 * (square - cost * cost), 0.0))) / 3.0


@kernel()
def downhill(time, walls, directions):
    """Write into `directions`, in 127ths (`UNIT`), the upwind direction down the time (s) of every node reached.

    It leads to the neighbours that the node was reached from, so never through a wall. Nodes whose time is infinite,
    and those without an earlier neighbour, keep what they have. Shapes: time (nx, ny, nz), walls (3, nx, ny, nz) as of
    `travel_time`, directions (nx, ny, nz, 3).
    """
    step = np.zeros(3)
    for node in np.ndindex(time.shape):
        here = time[node]
        if here == np.inf:
            continue
        square = 0.0
        for axis in range(3):
            step[axis] = 0.0
            one = (int(axis == 0), int(axis == 1), int(axis == 2))
            below = (node[0] - one[0], node[1] - one[1], node[2] - one[2])
            above = (node[0] + one[0], node[1] + one[1], node[2] + one[2])
            best = here
            if below[axis] >= 0 and not walls[axis][below] and time[below] < best:
                best = time[below]
                step[axis] = best - here
            if above[axis] < time.shape[axis] and not walls[axis][node] and time[above] < best:
                step[axis] = here - time[above]
            square += step[axis] * step[axis]
        if square > 0.0:
            for axis in range(3):
                directions[node][axis] = round(UNIT * step[axis] / np.sqrt(square))


def widest_way(barrier: Float[np.ndarray, "nx ny nz"], start: Int[np.ndarray, "3"], end: Int[np.ndarray, "3"]) -> float:
    """Return the largest c such that a path of neighbouring nodes with barrier ≥ c joins start and end, m."""
    from scipy import ndimage  # takes a tenth of a second, and only a refusal asks

    first, last, part = tuple(start), tuple(end), np.empty(barrier.shape, np.int32)

    def parted(level: float) -> bool:
        ndimage.label(barrier >= level, output=part)
        return bool(part[first] != part[last])

    levels = np.unique(barrier[barrier <= min(barrier[first], barrier[last])])
    return float(levels[bisect.bisect_left(levels, True, key=parted) - 1])


FULL_SPEED_BARRIER = 0.6
"""Barrier value (m) from which on the travel speed is full; towards the surface it falls in proportion."""
_CHUNK = 65536
FEW = 1024
"""Points computed at a time about a goal, which asks for so few that a full piece would be most of its cost: more than
the 8 samples on the way to each of 125 nodes around it."""
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
        sample = functools.partial(_sampled, field, offset)
        axes = [first + spacing * np.arange(count) for first, count in zip(low, shape, strict=True)]
        coarse = sample(nodes_of([axis[::2] for axis in axes]), lambda f: progress(0.3 * f, "barrier, coarse"))
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
        corners = base + nodes_of([[0, 1]] * 3)
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


def _sampled(field: Field, offset: float, points: np.ndarray, progress: Callable[[float], Any]) -> np.ndarray:
    """Give h at many points (m), with progress."""
    result = np.empty(len(points))
    for first in range(0, len(points), _CHUNK):
        result[first : first + _CHUNK] = values_of(field, points[first : first + _CHUNK])
        progress(min(1.0, (first + _CHUNK) / len(points)))
    return result - offset


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


def nodes_of(axes: Sequence[Any]) -> np.ndarray:
    """Give all points (n, 3) whose coordinates are among those of each axis, the last one changing fastest."""
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def outwards(values: Float[np.ndarray, "nx ny nz"]) -> Int8[np.ndarray, "nx ny nz 3"]:
    """Give the direction in which h (m) rises at each node, in 127ths of a unit times `_OUTWARD_WEIGHT`."""
    directions = np.empty((*values.shape, 3), dtype=np.int8)
    slopes = np.gradient(values.astype(np.float32))
    size = np.sqrt(sum(slope * slope for slope in slopes))
    for axis, slope in enumerate(slopes):
        directions[..., axis] = np.rint(UNIT * _OUTWARD_WEIGHT * slope / np.maximum(size, 1e-6))
    return directions


def _walls(sample: Callable[..., np.ndarray], values: np.ndarray, axes: list[np.ndarray], spacing: float) -> np.ndarray:
    """Edges between free nodes that may cross the obstacle, decided by sampling them (a distance is 1-Lipschitz)."""
    walls = np.zeros((3, *values.shape), dtype=bool)
    inner = np.arange(1, 8) / 8.0
    for axis in range(3):
        ahead = np.roll(values, -1, axis=axis)
        np.moveaxis(ahead, axis, 0)[-1] = -np.inf
        index = np.nonzero((values > 0.0) & (ahead > 0.0) & (values + ahead < spacing))
        base = np.stack([a[i] for a, i in zip(axes, index, strict=True)], axis=-1)
        if len(base) == 0:
            continue
        direction = np.zeros(3)
        direction[axis] = spacing
        points = base[:, None, :] + inner[:, None] * direction
        lowest = sample(points.reshape(-1, 3), lambda _: None).reshape(len(base), -1).min(axis=1)
        walls[axis][index] = lowest <= 0.0
    return walls


def require_free(field: Field, offset: float, position: Float[np.ndarray, "3"], name: str) -> None:
    """Refuse a position where h = field − offset is not positive.

    Raises:
        KeepOutZoneError: it lies inside; the message says by how much.

    """
    barrier = float(values_of(field, np.asarray(position, dtype=float)[None], FEW)[0]) - offset
    if not barrier > 0.0:
        raise KeepOutZoneError(
            f"{name}: {np.asarray(position).tolist()} m lies {-barrier:.3g} m inside the keep-out zone "
            f"(field value {barrier + offset:.3g} m, at least {offset:.3g} m needed)",
            name,
        )
