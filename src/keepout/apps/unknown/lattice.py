"""Shortest ways over a lattice of nodes with a price each: Dijkstra's method with buckets of whole-number lengths."""

from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8, UInt16

_STRAIGHT = np.array([0, 10, 14, 17], dtype=np.int64)
"""Length of a step that changes 1, 2 or 3 indices, in tenths of the lattice spacing."""
TENTHS = 10.0
FAR = np.iinfo(np.int32).max
"""Length of a way to where none leads."""


def shortest(
    price: UInt8[np.ndarray, "nx ny nz"],
    sources: Int[np.ndarray, "n 3"],
    lengths: Int[np.ndarray, " n"],
    *,
    target: Int[np.ndarray, "3"] | None = None,
    squares: UInt16[np.ndarray, "mx my mz"] | None = None,
    stride: int = 1,
    least: int = 0,
) -> Int[np.ndarray, "nx ny nz"]:
    """Length of the shortest way from the sources to every node, in tenths of the spacing times the price.

    A step leads to any of the 26 neighbours and costs its length times the price of the node that it leads to.

    Args:
        price: of each node; 0 closes it.
        sources: nodes to begin at.
        lengths: what each begins with.
        target: a node at which to stop; lengths beyond it stay `FAR`.
        squares: a map's squared node distances. Where they are given a step is open only if every map node on it,
            `stride` of them, has at least `least`.
        stride: map nodes between neighbours of the lattice.
        least: squared distance, in cells, that a step keeps.

    """
    padded = np.pad(price, 1)
    strides = np.array([padded.shape[1] * padded.shape[2], padded.shape[2], 1])
    index = (np.asarray(sources) + 1) @ strides
    stop = -1 if target is None else int((np.asarray(target) + 1) @ strides)
    checked = squares is not None and stride > 1
    fine = squares if checked else np.zeros((1, 1, 1), dtype=np.uint16)
    length = _settle(
        padded.ravel(), strides, index, np.asarray(lengths, dtype=np.int64), stop, fine, stride if checked else 1, least
    )
    return length.reshape(padded.shape)[1:-1, 1:-1, 1:-1]


@numba.njit(cache=True)
@no_type_check
def _settle(price, strides, sources, starts, stop, squares, stride, least):
    dearest = 1
    for value in price:
        dearest = max(dearest, value)
    count = 17 * dearest + 1
    if starts.size > 0:
        count = max(count, starts.max() - starts.min() + 1)
    length = np.full(price.size, FAR, dtype=np.int32)
    # Waiting nodes in linked lists, a list a bucket; an entry made stale by a shorter way is passed over.
    head = np.full(count, -1, dtype=np.int32)
    entry_node = np.empty(1024, dtype=np.int32)
    entry_next = np.empty(1024, dtype=np.int32)
    entry_length = np.empty(1024, dtype=np.int32)
    used, unused, waiting = 0, -1, 0
    offsets = np.empty(26, dtype=np.int64)
    steps = np.empty((26, 3), dtype=np.int64)
    lengths = np.empty(26, dtype=np.int64)
    filled = 0
    for i in range(-1, 2):
        for j in range(-1, 2):
            for k in range(-1, 2):
                changed = abs(i) + abs(j) + abs(k)
                if changed > 0:
                    offsets[filled] = i * strides[0] + j * strides[1] + k * strides[2]
                    steps[filled, 0], steps[filled, 1], steps[filled, 2] = i, j, k
                    lengths[filled] = _STRAIGHT[changed]
                    filled += 1
    now = starts.min() if starts.size > 0 else 0
    for n in range(sources.size):
        if price[sources[n]] > 0 and starts[n] < length[sources[n]]:
            length[sources[n]] = starts[n]
            entry_node[used], entry_length[used] = sources[n], starts[n]
            entry_next[used] = head[starts[n] % count]
            head[starts[n] % count] = used
            used += 1
            waiting += 1
            if used == entry_node.size:
                entry_node, entry_next, entry_length = _grown(entry_node), _grown(entry_next), _grown(entry_length)
    while waiting > 0:
        entry = head[now % count]
        if entry < 0:
            now += 1
            continue
        head[now % count] = entry_next[entry]
        waiting -= 1
        node, here = entry_node[entry], entry_length[entry]
        entry_next[entry] = unused
        unused = entry
        if here > length[node]:
            continue
        if node == stop:
            break
        for way in range(26):
            beside = node + offsets[way]
            cost = price[beside]
            if cost == 0:
                continue
            reached = here + lengths[way] * cost
            if reached >= length[beside]:
                continue
            if stride > 1 and not _open(squares, node, strides, steps[way], stride, least):
                continue
            length[beside] = reached
            if unused >= 0:
                slot = unused
                unused = entry_next[slot]
            else:
                slot = used
                used += 1
                if used == entry_node.size:
                    entry_node, entry_next, entry_length = _grown(entry_node), _grown(entry_next), _grown(entry_length)
            entry_node[slot], entry_length[slot] = beside, reached
            entry_next[slot] = head[reached % count]
            head[reached % count] = slot
            waiting += 1
    return length


@numba.njit(cache=True)
@no_type_check
def _grown(values):
    larger = np.empty(2 * values.size, dtype=values.dtype)
    larger[: values.size] = values
    return larger


@numba.njit(cache=True)
@no_type_check
def _open(squares, node, strides, step, stride, least):
    """Whether every map node between two neighbours of the lattice keeps its distance."""
    i = node // strides[0] - 1
    j = (node % strides[0]) // strides[1] - 1
    k = node % strides[1] - 1
    for part in range(1, stride):
        if squares[i * stride + part * step[0], j * stride + part * step[1], k * stride + part * step[2]] < least:
            return False
    return True


def walk_back(
    length: Int[np.ndarray, "nx ny nz"], price: UInt8[np.ndarray, "nx ny nz"], end: Int[np.ndarray, "3"]
) -> Int[np.ndarray, "m 3"]:
    """Nodes of the shortest way that `shortest` found to `end`, first to last; empty where none leads."""
    node = tuple(int(i) for i in end)
    if length[node] == FAR:
        return np.zeros((0, 3), dtype=np.int64)
    way = [node]
    shape = length.shape
    while True:
        here, best, before = int(length[node]), None, FAR
        for step in np.ndindex(3, 3, 3):
            beside = tuple(a + s - 1 for a, s in zip(node, step, strict=True))
            changed = sum(s != 1 for s in step)
            if changed == 0 or any(a < 0 or a >= n for a, n in zip(beside, shape, strict=True)):
                continue
            candidate = int(length[beside])
            if candidate + int(_STRAIGHT[changed]) * int(price[node]) == here and candidate < before:
                best, before = beside, candidate
        if best is None:
            return np.array(way[::-1], dtype=np.int64)
        node = best
        way.append(node)


def nodes_near(room: Bool[np.ndarray, "nx ny nz"], place: Float[np.ndarray, "3"], reach: float) -> np.ndarray:
    """Give the open nodes (m, 3) at most `reach` from `place`; both in lattice spacings from the lattice's corner."""
    low = np.maximum(np.floor(place - reach).astype(int), 0)
    high = np.minimum(np.ceil(place + reach).astype(int) + 1, room.shape)
    if np.any(high <= low):
        return np.zeros((0, 3), dtype=np.int64)
    found = np.argwhere(room[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]) + low
    return found[np.linalg.norm(found - place, axis=1) <= reach]
