"""Fast marching on a regular grid with walls between nodes (Sethian 1996), and the widest way between two nodes.

Inside, grids are padded by one closed node on every side and flattened: a neighbour is an index plus or minus a stride.
"""

import bisect
import math

import numpy as np
from jaxtyping import Bool, Float, Int

from keepout.core.kernel import kernel

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
