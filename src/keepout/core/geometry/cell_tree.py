"""Compiled walks on an octree's cells: which cell holds a point, what touches what, how far the nearest cell is.

The terminal cells stay in flat arrays in Morton order; the tree over them is one table of eight children a node. These
walks are short and branch at every step, which is the wrong shape for array code: in NumPy the neighbours alone took
most of the time and memory of an offset solid.
"""

from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float, Int

# `no_type_check` below: run-time shape checks would wrap the functions that numba compiles.
_STACK = 8 * 21 + 8
_HIDDEN, _OPEN = 1, 2

Child = Int[np.ndarray, "nodes 8"]


def build(level: Int[np.ndarray, "n"]) -> Child:
    """Children of every node, from the levels of the terminal cells in Morton order.

    An entry is a node, or ~i for the terminal cell i. Nodes come before their children; node 0 is the whole cube.
    """
    child = np.empty(((len(level) - 1) // 7 + (len(level) == 1), 8), dtype=np.int32)
    if len(level) == 1:
        child[:] = ~0
    else:
        _fill(level, child)
    return child


@numba.njit(cache=True, nogil=True)
@no_type_check
def _fill(level, child):
    node, slot = np.zeros(24, dtype=np.int64), np.zeros(24, dtype=np.int64)
    depth, used, cell = 0, 1, 0
    while depth >= 0:
        if slot[depth] == 8:
            depth -= 1
            continue
        here = slot[depth]
        slot[depth] += 1
        if level[cell] == depth + 1:
            child[node[depth], here] = ~cell
            cell += 1
        else:
            child[node[depth], here] = used
            depth += 1
            node[depth], slot[depth] = used, 0
            used += 1


@numba.njit(cache=True, nogil=True, inline="always")
@no_type_check
def _descend(child, depth, x, y, z, stop):
    """Entry that holds a position on the grid of the deepest level: a cell ~i, or the node at level `stop`."""
    entry = 0
    for bit in range(depth - 1, depth - 1 - stop, -1):
        entry = child[entry, ((x >> bit) & 1) | (((y >> bit) & 1) << 1) | (((z >> bit) & 1) << 2)]
        if entry < 0:
            break
    return entry


@numba.njit(cache=True, nogil=True)
@no_type_check
def locate(child: Child, depth: int, scaled: Float[np.ndarray, "m 3"]) -> Int[np.ndarray, "m"]:
    """Cell of each point, given in units of the deepest level's cells from the cube's corner; -1 outside the cube."""
    found = np.full(len(scaled), -1, dtype=np.int64)
    size = 1 << depth
    for i in range(len(scaled)):
        x, y, z = np.floor(scaled[i, 0]), np.floor(scaled[i, 1]), np.floor(scaled[i, 2])
        if x >= 0 and y >= 0 and z >= 0 and x < size and y < size and z < size:
            found[i] = ~_descend(child, depth, int(x), int(y), int(z), depth)
    return found


@numba.njit(cache=True, nogil=True, inline="always")
@no_type_check
def _root(parent, i):
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@numba.njit(cache=True, nogil=True)
@no_type_check
def connected(
    child: Child,
    depth: int,
    index: Int[np.ndarray, "n 3"],
    level: Int[np.ndarray, "n"],
    chosen: Bool[np.ndarray, "n"],
    seeds: Bool[np.ndarray, "n"],
) -> Bool[np.ndarray, "n"]:
    """Chosen cells that are connected to a chosen seed through faces of chosen cells: union-find with path halving."""
    parent = np.arange(len(level)).astype(np.int32)
    for a in range(len(level)):
        if not chosen[a]:
            continue
        size = 1 << (depth - level[a])
        for axis in range(3):
            for step in (-1, size):
                x, y, z = index[a, 0] * size, index[a, 1] * size, index[a, 2] * size
                if axis == 0:
                    x += step
                elif axis == 1:
                    y += step
                else:
                    z += step
                if min(x, y, z) < 0 or max(x, y, z) >= 1 << depth:
                    continue
                # Smaller neighbours find this cell from their side.
                entry = _descend(child, depth, x, y, z, level[a])
                if entry < 0 and chosen[~entry]:
                    one, other = _root(parent, a), _root(parent, ~entry)
                    if one < other:
                        parent[other] = one
                    else:
                        parent[one] = other
    wet = np.zeros(len(level), dtype=np.bool_)
    for a in range(len(level)):
        if chosen[a] and seeds[a]:
            wet[_root(parent, a)] = True
    for a in range(len(level)):
        wet[a] = chosen[a] and wet[_root(parent, a)]
    return wet


@numba.njit(cache=True, nogil=True)
@no_type_check
def ends_of_walks(
    child: Child,
    depth: int,
    index: Int[np.ndarray, "n 3"],
    level: Int[np.ndarray, "n"],
    undecided: Bool[np.ndarray, "n"],
    d: Float[np.ndarray, "n"],
    gradient: Float[np.ndarray, "n 3"],
    unit: float,
    jumps: Float[np.ndarray, "k"],
) -> Int[np.ndarray, "n"]:
    """Cell in which the walk from each cell's centre up the distance ends; decided cells end in themselves.

    A step is one of `jumps` times the larger of d and the cell's side, and leads from a cell to another one up the
    distance that its centre sees past no surface. `unit` is the side of the deepest level's cells in metres.
    """
    end = np.arange(len(level)).astype(np.int32)
    limit = 1 << depth
    for a in range(len(level)):
        if not undecided[a] or d[a] <= 0.0:
            continue
        size = float(1 << (depth - level[a]))
        x, y, z = (index[a, 0] + 0.5) * size, (index[a, 1] + 0.5) * size, (index[a, 2] + 0.5) * size
        for jump in jumps:
            step = jump * max(d[a] / unit, size)
            px = np.floor(x + step * gradient[a, 0])
            py = np.floor(y + step * gradient[a, 1])
            pz = np.floor(z + step * gradient[a, 2])
            if min(px, py, pz) < 0 or max(px, py, pz) >= limit:
                continue
            b = ~_descend(child, depth, int(px), int(py), int(pz), depth)
            there = float(1 << (depth - level[b]))
            apart = np.sqrt(
                ((index[b, 0] + 0.5) * there - x) ** 2
                + ((index[b, 1] + 0.5) * there - y) ** 2
                + ((index[b, 2] + 0.5) * there - z) ** 2
            )
            # Both centres lie in the ball of free space round one of them, so no surface is between them.
            if d[b] > d[a] and apart * unit < d[b]:
                end[a] = b
                break
    for a in range(len(level)):
        last = a
        while end[last] != last:
            last = end[last]
        here = a
        while end[here] != last:
            end[here], here = last, end[here]
    return end


@numba.njit(cache=True, nogil=True)
@no_type_check
def contents(child: Child, hidden: Bool[np.ndarray, "n"]) -> Int[np.ndarray, "nodes"]:
    """Whether hidden (bit 0) and open (bit 1) cells are under each node."""
    holds = np.zeros(len(child), dtype=np.int8)
    for node in range(len(child) - 1, -1, -1):
        for k in range(8):
            entry = child[node, k]
            if entry >= 0:
                holds[node] |= holds[entry]
            else:
                holds[node] |= _HIDDEN if hidden[~entry] else _OPEN
    return holds


@numba.njit(cache=True, nogil=True)
@no_type_check
def nearest(
    child: Child,
    depth: int,
    holds: Int[np.ndarray, "nodes"],
    hidden: Bool[np.ndarray, "n"],
    wanted: bool,
    scaled: Float[np.ndarray, "m 3"],
    bound: Float[np.ndarray, "m"],
) -> Float[np.ndarray, "m"]:
    """Distance from each point to the cells that are hidden (or, if `wanted` is False, open), or the bound if less.

    Branch and bound, near children first; points and distances are in units of the deepest level's cells, in which the
    corners of cells are exact.
    """
    answer = bound.copy()
    kind = _HIDDEN if wanted else _OPEN
    entries = np.empty(_STACK, dtype=np.int64)
    sizes = np.empty(_STACK)
    corners = np.empty((_STACK, 3))
    bounds = np.empty(_STACK)
    for i in range(len(scaled)):
        px, py, pz = scaled[i, 0], scaled[i, 1], scaled[i, 2]
        best = bound[i] * bound[i]
        improved = False
        entries[0], sizes[0], bounds[0] = 0, float(1 << depth), 0.0
        corners[0] = 0.0
        waiting = 1
        while waiting > 0:
            waiting -= 1
            if bounds[waiting] >= best:
                continue
            node, half = entries[waiting], 0.5 * sizes[waiting]
            x, y, z = corners[waiting, 0], corners[waiting, 1], corners[waiting, 2]
            near = (px >= x + half) | ((py >= y + half) << 1) | ((pz >= z + half) << 2)
            # Pushed from far to near, so that the nearest child comes off first.
            for turn in (7, 6, 5, 3, 4, 2, 1, 0):
                k = near ^ turn
                entry = child[node, k]
                if entry < 0:
                    if hidden[~entry] != wanted:
                        continue
                elif holds[entry] & kind == 0:
                    continue
                cx, cy, cz = x + (k & 1) * half, y + ((k >> 1) & 1) * half, z + ((k >> 2) & 1) * half
                dx = max(max(cx - px, px - cx - half), 0.0)
                dy = max(max(cy - py, py - cy - half), 0.0)
                dz = max(max(cz - pz, pz - cz - half), 0.0)
                squared = dx * dx + dy * dy + dz * dz
                if squared >= best:
                    continue
                if entry < 0 or holds[entry] == kind:
                    best = squared
                    improved = True
                else:
                    entries[waiting], sizes[waiting], bounds[waiting] = entry, half, squared
                    corners[waiting, 0], corners[waiting, 1], corners[waiting, 2] = cx, cy, cz
                    waiting += 1
        if improved:
            answer[i] = np.sqrt(best)
    return answer
