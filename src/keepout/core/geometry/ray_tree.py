"""A binary tree of boxes over triangles, split where rays are expected to cost least."""

from typing import NamedTuple, no_type_check

import numba
import numpy as np
from jaxtyping import Float, Int

# `no_type_check` below: run-time shape checks would wrap the functions that numba compiles.
_BINS = 16
"""Places along an axis at which a set of triangles may be split."""
_LEAF_TRIANGLES = 2
"""Triangles that are not split further."""
_STEP_COST = 1.0
"""Cost of a look at a node's two boxes over that of a look at a triangle."""
DEEPEST = 96
"""Levels of the tree, at most: from `_HALVED` on triangles are halved by number, whatever that costs."""
_HALVED = 60


class RayTree(NamedTuple):
    """Inner nodes in depth-first order; each holds the boxes of its two children.

    A child below 0 is a leaf: its triangles are `first[~child]` to `first[~child + 1]`.
    """

    boxes: Float[np.ndarray, "nodes 2 6"]
    """Lower corner and upper corner of each child's box."""
    children: Int[np.ndarray, "nodes 2"]
    first: Int[np.ndarray, " leaves"]
    """First triangle of each leaf, in the tree's order; one more entry than leaves."""
    corners: Float[np.ndarray, "f 9"]
    """The corners of the triangles in the tree's order."""
    face: Int[np.ndarray, " f"]
    """Original index of each triangle in the tree's order."""


def build(triangles: Float[np.ndarray, "f 3 3"]) -> RayTree:
    """Build the tree of at least one triangle by the surface area heuristic over bins of the triangles' centres.

    A set of triangles is split where (share of area) times (number of triangles), summed over both parts, is least: the
    expected number of triangles that a ray looks at.
    """
    count = len(triangles)
    boxes = np.empty((max(count - 1, 1), 2, 6))
    children = np.empty((max(count - 1, 1), 2), dtype=np.int64)
    first = np.empty(count + 1, dtype=np.int64)
    order = np.arange(count, dtype=np.int64)
    lower, upper = triangles.min(axis=1), triangles.max(axis=1)
    nodes, leaves = _split(lower, upper, 0.5 * (lower + upper), order, boxes, children, first)
    first[leaves] = count
    corners = np.ascontiguousarray(triangles[order].reshape(count, 9))
    return RayTree(boxes[:nodes], children[:nodes], first[: leaves + 1], corners, order)


@numba.njit(cache=True, nogil=True)
@no_type_check
def _box_of(lower, upper, order, start, end, box):
    """Write the box of some triangles."""
    for axis in range(3):
        box[axis], box[3 + axis] = np.inf, -np.inf
        for i in range(start, end):
            box[axis] = min(box[axis], lower[order[i], axis])
            box[3 + axis] = max(box[3 + axis], upper[order[i], axis])


@numba.njit(cache=True, nogil=True)
@no_type_check
def _half_area(box):
    dx, dy, dz = box[3] - box[0], box[4] - box[1], box[5] - box[2]
    return dx * dy + dy * dz + dz * dx


@numba.njit(cache=True, nogil=True)
@no_type_check
def _bin_of(value, low, high):
    return min(int((value - low) * (_BINS / (high - low))), _BINS - 1)


@numba.njit(cache=True, nogil=True)
@no_type_check
def _cheapest(lower, upper, centres, order, start, end):
    """Give axis, last bin of the first part, and cost (areas times numbers) of the best split; axis -1 for none."""
    best_axis, best_bin, best_cost = -1, 0, np.inf
    counts = np.empty(_BINS, dtype=np.int64)
    bins = np.empty((_BINS, 6))
    after = np.empty(_BINS)
    box = np.empty(6)
    for axis in range(3):
        low, high = np.inf, -np.inf
        for i in range(start, end):
            low, high = min(low, centres[order[i], axis]), max(high, centres[order[i], axis])
        if not high - low > 1e-12 * max(abs(low), abs(high)):
            continue
        counts[:] = 0
        bins[:, :3], bins[:, 3:] = np.inf, -np.inf
        for i in range(start, end):
            j = order[i]
            b = _bin_of(centres[j, axis], low, high)
            counts[b] += 1
            for k in range(3):
                bins[b, k], bins[b, 3 + k] = min(bins[b, k], lower[j, k]), max(bins[b, 3 + k], upper[j, k])
        box[:3], box[3:] = np.inf, -np.inf
        number = 0
        for b in range(_BINS - 1, 0, -1):
            number += counts[b]
            for k in range(3):
                box[k], box[3 + k] = min(box[k], bins[b, k]), max(box[3 + k], bins[b, 3 + k])
            after[b] = number * _half_area(box) if number > 0 else np.inf
        box[:3], box[3:] = np.inf, -np.inf
        number = 0
        for b in range(_BINS - 1):
            number += counts[b]
            for k in range(3):
                box[k], box[3 + k] = min(box[k], bins[b, k]), max(box[3 + k], bins[b, 3 + k])
            cost = number * _half_area(box) + after[b + 1] if number > 0 else np.inf
            if cost < best_cost:
                best_axis, best_bin, best_cost = axis, b, cost
    return best_axis, best_bin, best_cost


@numba.njit(cache=True, nogil=True)
@no_type_check
def _part(lower, upper, centres, order, start, end, level, area):
    """Reorder triangles and give the first one of the second part, or `end` where they had better stay together."""
    number = end - start
    if number <= _LEAF_TRIANGLES:
        return end
    axis, last, cost = -1, 0, np.inf
    if level < _HALVED:
        axis, last, cost = _cheapest(lower, upper, centres, order, start, end)
    if axis < 0:
        return start + number // 2  # centres that are one point, or a tree that is deep: halved by number
    if number <= 8 and cost + _STEP_COST * area >= number * area:
        return end
    low, high = np.inf, -np.inf
    for i in range(start, end):
        low, high = min(low, centres[order[i], axis]), max(high, centres[order[i], axis])
    middle = start
    for i in range(start, end):
        if _bin_of(centres[order[i], axis], low, high) <= last:
            order[i], order[middle] = order[middle], order[i]
            middle += 1
    return middle


@numba.njit(cache=True, nogil=True)
@no_type_check
def _split(lower, upper, centres, order, boxes, children, first):
    """Fill the arrays depth first; returns the numbers of nodes and leaves."""
    # Start, end, level, and the node and side whose child this is.
    waiting = np.empty((DEEPEST, 5), dtype=np.int64)
    nodes, leaves, depth = 0, 0, 1
    waiting[0] = (0, len(order), 0, -1, 0)
    box = np.empty(6)
    while depth > 0:
        depth -= 1
        start, end, level, parent, side = waiting[depth]
        _box_of(lower, upper, order, start, end, box)
        middle = _part(lower, upper, centres, order, start, end, level, _half_area(box))
        if middle == end:
            child = ~leaves
            first[leaves] = start
            leaves += 1
        else:
            child = nodes
            nodes += 1
            waiting[depth] = (middle, end, level + 1, child, 1)
            waiting[depth + 1] = (start, middle, level + 1, child, 0)
            depth += 2
        if parent >= 0:
            children[parent, side] = child
            boxes[parent, side] = box
        elif child < 0:
            # One leaf is all there is: a node whose second child is empty.
            nodes = 1
            children[0, 0], children[0, 1] = child, child
            boxes[0, 0] = box
            boxes[0, 1, :3], boxes[0, 1, 3:] = np.inf, -np.inf
    return nodes, leaves
