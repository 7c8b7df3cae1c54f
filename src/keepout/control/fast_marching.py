"""Fast marching on a regular grid with walls between nodes (Sethian 1996), and the widest way between two nodes."""

import heapq

import numba
import numpy as np


@numba.njit(cache=True)
def travel_time(speed, walls, sources, source_times, spacing):
    """Solve ‖∇D‖ speed = 1 with D given at the sources, first order upwind.

    Args:
        speed: (nx, ny, nz), m/s; not positive where there is no way.
        walls: (3, nx, ny, nz) bool; walls[a, i, j, k] closes the edge from node (i, j, k) to the next along axis a.
        sources: (n, 3) node indices.
        source_times: (n,) seconds.
        spacing: between nodes, m.

    Returns:
        (nx, ny, nz) seconds, infinite where nothing leads.

    """
    shape = speed.shape
    size = np.array(shape)
    time = np.full(shape, np.inf)
    done = np.zeros(shape, dtype=np.bool_)
    heap = [(0.0, 0, 0, 0)]
    heap.pop()
    for n in range(sources.shape[0]):
        i, j, k = sources[n, 0], sources[n, 1], sources[n, 2]
        if speed[i, j, k] > 0.0 and source_times[n] < time[i, j, k]:
            time[i, j, k] = source_times[n]
            heapq.heappush(heap, (source_times[n], i, j, k))
    step = np.zeros(3, dtype=np.int64)
    upwind = np.zeros(3)
    while len(heap) > 0:
        reached, i0, j0, k0 = heapq.heappop(heap)
        if done[i0, j0, k0]:
            continue
        done[i0, j0, k0] = True
        for axis in range(3):
            for sign in (-1, 1):
                step[:] = 0
                step[axis] = sign
                i, j, k = i0 + step[0], j0 + step[1], k0 + step[2]
                if i < 0 or j < 0 or k < 0 or i >= size[0] or j >= size[1] or k >= size[2]:
                    continue
                if done[i, j, k] or speed[i, j, k] <= 0.0:
                    continue
                closed = walls[axis, i0, j0, k0] if sign > 0 else walls[axis, i, j, k]
                if closed:
                    continue
                value = _update(time, done, walls, size, upwind, i, j, k, spacing / speed[i, j, k])
                if value < time[i, j, k]:
                    time[i, j, k] = value
                    heapq.heappush(heap, (value, i, j, k))
    return time


@numba.njit(cache=True)
def _update(time, done, walls, size, upwind, i, j, k, cost):
    """Solve Σ max(D − D_a, 0)² = cost² with the smallest settled neighbour D_a along each axis."""
    for axis in range(3):
        best = np.inf
        a, b, c = i, j, k
        if axis == 0:
            a = i - 1
        elif axis == 1:
            b = j - 1
        else:
            c = k - 1
        if a >= 0 and b >= 0 and c >= 0 and done[a, b, c] and not walls[axis, a, b, c]:
            best = time[a, b, c]
        a, b, c = i, j, k
        if axis == 0:
            a = i + 1
        elif axis == 1:
            b = j + 1
        else:
            c = k + 1
        inside = a < size[0] and b < size[1] and c < size[2]
        if inside and done[a, b, c] and not walls[axis, i, j, k] and time[a, b, c] < best:
            best = time[a, b, c]
        upwind[axis] = best
    upwind.sort()
    value = upwind[0] + cost
    total, square = upwind[0], upwind[0] * upwind[0]
    for used in range(2, 4):
        nearest = upwind[used - 1]
        if value <= nearest:
            break
        total += nearest
        square += nearest * nearest
        discriminant = total * total - used * (square - cost * cost)
        if discriminant < 0.0:
            break
        value = (total + np.sqrt(discriminant)) / used
    return value


@numba.njit(cache=True)
def widest_way(barrier, start, end):
    """Return the largest value c such that a path of neighbouring nodes with barrier ≥ c joins start and end, in metres.

    Args:
        barrier: (nx, ny, nz), m.
        start: (3,) node indices.
        end: (3,) node indices.

    """
    shape = barrier.shape
    size = np.array(shape)
    done = np.zeros(shape, dtype=np.bool_)
    best = np.full(shape, -np.inf)
    heap = [(0.0, 0, 0, 0)]
    heap.pop()
    heapq.heappush(heap, (-barrier[start[0], start[1], start[2]], start[0], start[1], start[2]))
    step = np.zeros(3, dtype=np.int64)
    while len(heap) > 0:
        width, i0, j0, k0 = heapq.heappop(heap)
        if done[i0, j0, k0]:
            continue
        done[i0, j0, k0] = True
        if i0 == end[0] and j0 == end[1] and k0 == end[2]:
            return -width
        for axis in range(3):
            for sign in (-1, 1):
                step[:] = 0
                step[axis] = sign
                i, j, k = i0 + step[0], j0 + step[1], k0 + step[2]
                if i < 0 or j < 0 or k < 0 or i >= size[0] or j >= size[1] or k >= size[2] or done[i, j, k]:
                    continue
                through = min(-width, barrier[i, j, k])
                if through > best[i, j, k]:
                    best[i, j, k] = through
                    heapq.heappush(heap, (-through, i, j, k))
    return -np.inf
