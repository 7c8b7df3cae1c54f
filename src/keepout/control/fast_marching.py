"""Fast marching on a regular grid with walls between nodes (Sethian 1996), and the widest way between two nodes.

Inside, grids are padded by one closed node on every side and flattened: a neighbour is an index plus or minus a stride.
"""

import heapq
from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float, Int


def travel_time(
    speed: Float[np.ndarray, "nx ny nz"],
    walls: Bool[np.ndarray, "3 nx ny nz"],
    sources: Int[np.ndarray, "n 3"],
    source_times: Float[np.ndarray, " n"],
    spacing: float,
) -> Float[np.ndarray, "nx ny nz"]:
    """Solve ‖∇D‖ speed = 1 with D given at the sources, first order upwind.

    Args:
        speed: m/s; not positive where there is no way.
        walls: walls[a, i, j, k] closes the edge from node (i, j, k) to the next along axis a.
        sources: node indices.
        source_times: s.
        spacing: between nodes, m.

    Returns:
        D in seconds, infinite where nothing leads.

    """
    padded = np.pad(np.asarray(speed, dtype=np.float64), 1)
    closed = np.pad(walls, ((0, 0), (1, 1), (1, 1), (1, 1))).reshape(3, -1)
    index = np.ravel_multi_index(tuple((np.asarray(sources) + 1).T), padded.shape)
    strides = np.array([padded.shape[1] * padded.shape[2], padded.shape[2], 1])
    time = _march(padded.ravel(), closed, strides, index, np.asarray(source_times, dtype=np.float64), float(spacing))
    return time.reshape(padded.shape)[1:-1, 1:-1, 1:-1]


@numba.njit(cache=True)
@no_type_check
def _march(speed, walls, strides, sources, source_times, spacing):
    time = np.full(speed.size, np.inf)
    done = np.zeros(speed.size, dtype=np.bool_)
    heap = [(0.0, 0) for _ in range(0)]
    for n in range(sources.size):
        node = sources[n]
        if speed[node] > 0.0 and source_times[n] < time[node]:
            time[node] = source_times[n]
            heapq.heappush(heap, (source_times[n], node))
    while len(heap) > 0:
        _, settled = heapq.heappop(heap)
        if done[settled]:
            continue
        done[settled] = True
        for axis in range(3):
            for sign in (-1, 1):
                node = settled + sign * strides[axis]
                if done[node] or speed[node] <= 0.0 or walls[axis, min(settled, node)]:
                    continue
                value = _update(time, done, walls, strides, node, spacing / speed[node])
                if value < time[node]:
                    time[node] = value
                    heapq.heappush(heap, (value, node))
    return time


@numba.njit(cache=True)
@no_type_check
def _update(time, done, walls, strides, node, cost):
    """Solve Σ max(D − D_a, 0)² = cost² with the smallest settled neighbour D_a along each axis."""
    first, second, third = np.inf, np.inf, np.inf
    for axis in range(3):
        before, after = node - strides[axis], node + strides[axis]
        best = np.inf
        if done[before] and not walls[axis, before]:
            best = time[before]
        if done[after] and not walls[axis, node] and time[after] < best:
            best = time[after]
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


def widest_way(barrier: Float[np.ndarray, "nx ny nz"], start: Int[np.ndarray, "3"], end: Int[np.ndarray, "3"]) -> float:
    """Return the largest c such that a path of neighbouring nodes with barrier ≥ c joins start and end, m."""
    padded = np.pad(barrier, 1, constant_values=-np.inf)
    strides = np.array([padded.shape[1] * padded.shape[2], padded.shape[2], 1])
    first, last = (int(np.ravel_multi_index(tuple(np.asarray(node) + 1), padded.shape)) for node in (start, end))
    return float(_widest(padded.ravel(), strides, first, last))


@numba.njit(cache=True)
@no_type_check
def _widest(barrier, strides, start, end):
    best = np.full(barrier.size, -np.inf)
    best[start] = barrier[start]
    heap = [(-barrier[start], start)]
    while len(heap) > 0:
        width, settled = heapq.heappop(heap)
        if settled == end:
            break
        if -width < best[settled]:
            continue
        for axis in range(3):
            for sign in (-1, 1):
                node = settled + sign * strides[axis]
                through = min(-width, barrier[node])
                if through > best[node]:
                    best[node] = through
                    heapq.heappush(heap, (-through, node))
    return best[end]
