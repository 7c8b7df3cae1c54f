"""The shadow of a triangle: the directions from which a whole patch cannot be seen because of it, as a polygon.

A place p at height h over a patch's centre is written (w, h): p = c + h (w_x e1 + w_y e2 + n). For a triangle and a
height the blocked directions w are a convex polygon, and it grows with the height; docs/seeable.md has the theorem.
"""

from typing import no_type_check

import numba
import numpy as np

from keepout.apps.inspection.seeing.pyramid_kernel import LIFT

# `no_type_check` below: run-time shape checks would wrap the functions that numba compiles.
MOST_EDGES = 48
"""Of a shadow: a triangle cut by two planes has 5 corners, a patch 8."""
_ROUNDING = 16 * np.finfo(np.float64).eps
"""Part of the largest coordinate by which rounding moves a point in the patch's axes: more than it does."""
_SAME = 1e-9
"""Points of a shadow nearer to each other than this part of their size are taken as one."""


@numba.njit(cache=True, nogil=True)
@no_type_check
def _cut(points, count, level, way, out):
    """Write the part of a polygon (x, y, height) where way * height >= way * level; give its number of corners."""
    kept = 0
    for i in range(count):
        j = i + 1 if i + 1 < count else 0
        here, there = way * (points[i, 2] - level), way * (points[j, 2] - level)
        if here >= 0.0:
            out[kept, 0], out[kept, 1], out[kept, 2] = points[i, 0], points[i, 1], points[i, 2]
            kept += 1
        if (here > 0.0 and there < 0.0) or (here < 0.0 and there > 0.0):
            s = here / (here - there)
            out[kept, 0] = points[i, 0] + s * (points[j, 0] - points[i, 0])
            out[kept, 1] = points[i, 1] + s * (points[j, 1] - points[i, 1])
            out[kept, 2] = level
            kept += 1
    return kept


@numba.njit(cache=True, nogil=True)
@no_type_check
def _hull(points, count, chain):
    """Write indices of the corners of the convex hull, counter-clockwise (Andrew's monotone chain); their number.

    The points come sorted. A corner that rounding leaves out makes the hull smaller, never larger.
    """
    size = 0
    for turn in range(2):
        start = size
        for step in range(count):
            k = step if turn == 0 else count - 1 - step
            while size >= start + 2:
                a, b = chain[size - 2], chain[size - 1]
                cross = (points[b, 0] - points[a, 0]) * (points[k, 1] - points[a, 1]) - (
                    points[b, 1] - points[a, 1]
                ) * (points[k, 0] - points[a, 0])
                if cross > 0.0:
                    break
                size -= 1
            chain[size] = k
            size += 1
        size -= 1
    return size


@numba.njit(cache=True, nogil=True)
@no_type_check
def _sorted_apart(points, count):
    """Sort points by x, then y, in place, and leave out those that hardly differ from the one before; their number."""
    for i in range(1, count):
        x, y, moved = points[i, 0], points[i, 1], points[i, 2]
        j = i - 1
        while j >= 0 and (points[j, 0] > x or (points[j, 0] == x and points[j, 1] > y)):
            points[j + 1, 0], points[j + 1, 1], points[j + 1, 2] = points[j, 0], points[j, 1], points[j, 2]
            j -= 1
        points[j + 1, 0], points[j + 1, 1], points[j + 1, 2] = x, y, moved
    kept = 1
    for i in range(1, count):
        apart = abs(points[i, 0] - points[kept - 1, 0]) + abs(points[i, 1] - points[kept - 1, 1])
        if apart > _SAME * (1.0 + abs(points[i, 0]) + abs(points[i, 1])):
            points[kept, 0], points[kept, 1], points[kept, 2] = points[i, 0], points[i, 1], points[i, 2]
            kept += 1
    return kept


@numba.njit(cache=True, nogil=True)
@no_type_check
def shadow(corners, t, frame, outline, count, height, reach, largest, edges, work, spare, points, chain):
    """Write the shadow of a triangle at a height as half planes (inward unit normal, least value); their number.

    The shadow is that of every greater height, too, and is made a little smaller than rounding could make it larger.

    Args:
        corners: (f, 9) triangles, m.
        t: which.
        frame: (4, 3) the patch's centre, two axes in its plane, and the normal of the unit.
        outline: (k, 2) corners of the patch in these axes, m, about its centre.
        count: how many.
        height: of the camera over the patch's plane, m.
        reach: length of the longest direction w that is asked for.
        largest: coordinate of the mesh and the places, m.
        edges: (MOST_EDGES, 3) to be filled.
        work: (8, 3), and the next three: room to work in.
        spare: (8, 3).
        points: (MOST_EDGES, 3).
        chain: (2 * MOST_EDGES,) whole numbers.

    """
    for k in range(3):
        x, y, z = (
            corners[t, 3 * k] - frame[0, 0],
            corners[t, 3 * k + 1] - frame[0, 1],
            corners[t, 3 * k + 2] - frame[0, 2],
        )
        for axis in range(3):
            work[k, axis] = frame[axis + 1, 0] * x + frame[axis + 1, 1] * y + frame[axis + 1, 2] * z
    number = _cut(work, 3, 2.0 * LIFT, 1.0, spare)
    number = _cut(spare, number, height - 2.0 * LIFT, -1.0, work)
    if number < 2:
        return 0
    sigma, total = 1.0 / height, 0
    for i in range(number):
        inverse = 1.0 / work[i, 2]
        for j in range(count):
            x = (work[i, 0] - outline[j, 0]) * inverse + sigma * outline[j, 0]
            y = (work[i, 1] - outline[j, 1]) * inverse + sigma * outline[j, 1]
            points[total, 0], points[total, 1] = x, y
            points[total, 2] = _ROUNDING * (1.0 + abs(x) + abs(y)) * (1.0 + largest * inverse)
            total += 1
    total = _sorted_apart(points, total)
    if total < 3:
        return 0
    total = _hull(points, total, chain)
    if total < 3:
        return 0
    for i in range(total):
        a, b = chain[i], chain[i + 1 if i + 1 < total else 0]
        ex, ey = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1]
        length = np.sqrt(ex * ex + ey * ey)
        edges[i, 0], edges[i, 1] = -ey / length, ex / length
        value = max(
            edges[i, 0] * points[a, 0] + edges[i, 1] * points[a, 1],
            edges[i, 0] * points[b, 0] + edges[i, 1] * points[b, 1],
        )
        # How far its moved ends move the line between them, beside the directions that are asked for.
        foot, span = -(points[a, 0] * ex + points[a, 1] * ey) / length**2, reach / length
        moved = 0.0
        for part in (foot - span, foot + span):
            moved = max(moved, abs(1.0 - part) * points[a, 2] + abs(part) * points[b, 2])
        edges[i, 2] = value + 2.0 * moved
    return total


@numba.njit(cache=True, nogil=True, inline="always")
@no_type_check
def covers(edges, number, x, y, half):
    """Whether a shadow holds all of a square of directions."""
    for i in range(number):
        if edges[i, 0] * x + edges[i, 1] * y - half * (abs(edges[i, 0]) + abs(edges[i, 1])) < edges[i, 2]:
            return False
    return True
