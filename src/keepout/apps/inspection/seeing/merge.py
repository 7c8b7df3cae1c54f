"""Convex pieces of one cell of a grid put together to fewer convex ones."""

from typing import no_type_check

import numba
import numpy as np

# `no_type_check` below: run-time shape checks would wrap the functions that numba compiles.
MOST_CORNERS = 8
"""Corners of a patch, at most."""
_STRAIGHT = 1e-9
"""A corner that lies nearer than this to the line between its neighbours, or to one of them, is left out, m."""
_GAP = 2e-7
"""Pieces are put together where the hull has at most this times its circumference more area than they have, m."""


@numba.njit(cache=True, nogil=True)
@no_type_check
def _hull(points, count, order, out):
    """Write the convex hull of points, counter-clockwise; give its number of corners."""
    order[:count] = np.arange(count)
    for i in range(1, count):
        k, j = order[i], i
        while j > 0 and (
            points[order[j - 1], 0] > points[k, 0]
            or (points[order[j - 1], 0] == points[k, 0] and points[order[j - 1], 1] > points[k, 1])
        ):
            order[j] = order[j - 1]
            j -= 1
        order[j] = k
    size = 0
    for way in range(2):
        base = size
        for step in range(count):
            k = order[step] if way == 0 else order[count - 1 - step]
            while size >= base + 2:
                ax, ay = out[size - 1, 0] - out[size - 2, 0], out[size - 1, 1] - out[size - 2, 1]
                bx, by = points[k, 0] - out[size - 1, 0], points[k, 1] - out[size - 1, 1]
                if ax * by - ay * bx > 0.0:
                    break
                size -= 1
            out[size, 0], out[size, 1] = points[k, 0], points[k, 1]
            size += 1
        size -= 1
    return size


@numba.njit(cache=True, nogil=True)
@no_type_check
def _simplified(polygon, count):
    """Leave out corners where the border runs straight on; in place; give the number left."""
    i = 0
    while i < count and count > 3:
        before, after = (i - 1) % count, (i + 1) % count
        ax, ay = polygon[i, 0] - polygon[before, 0], polygon[i, 1] - polygon[before, 1]
        bx, by = polygon[after, 0] - polygon[before, 0], polygon[after, 1] - polygon[before, 1]
        if abs(ax * by - ay * bx) <= _STRAIGHT * np.hypot(bx, by) or np.hypot(ax, ay) <= _STRAIGHT:
            for k in range(i, count - 1):
                polygon[k, 0], polygon[k, 1] = polygon[k + 1, 0], polygon[k + 1, 1]
            count -= 1
            i = max(i - 1, 0)
        else:
            i += 1
    return count


@numba.njit(cache=True, nogil=True)
@no_type_check
def _measure(polygon, count):
    area, around = 0.0, 0.0
    for i in range(count):
        j = i + 1 if i + 1 < count else 0
        area += (polygon[i, 0] - polygon[0, 0]) * (polygon[j, 1] - polygon[0, 1])
        area -= (polygon[i, 1] - polygon[0, 1]) * (polygon[j, 0] - polygon[0, 0])
        around += np.hypot(polygon[j, 0] - polygon[i, 0], polygon[j, 1] - polygon[i, 1])
    return 0.5 * area, around


@numba.njit(cache=True, nogil=True)
@no_type_check
def merged(corners, counts, areas, true_areas, face, begin):
    """Put the pieces of each cell together as far as they stay convex and have few corners.

    The pieces of a cell do not overlap: where the hull of two has no more area than both, they fill it.

    Args:
        corners: (n, PIECE_CORNERS, 2) of pieces, cell by cell; overwritten.
        counts: (n,) corners of each; overwritten.
        areas: (n,) m² in the plane; overwritten.
        true_areas: (n,) m² of the mesh; overwritten.
        face: (n,) the face of each; the one of the largest piece stays; overwritten.
        begin: (cells + 1,) the first piece of each cell.

    Returns:
        (n,) whether a place of the arrays holds a polygon of the answer.

    """
    n = len(counts)
    kept = np.zeros(n, dtype=np.bool_)
    largest = 0
    for c in range(len(begin) - 1):
        largest = max(largest, begin[c + 1] - begin[c])
    room = max(largest * corners.shape[1], 2 * MOST_CORNERS)
    points, order, hull = np.empty((room, 2)), np.empty(room, dtype=np.int64), np.empty((2 * room + 2, 2))
    biggest = areas.copy()
    for c in range(len(begin) - 1):
        start, end = begin[c], begin[c + 1]
        for i in range(start, end):
            counts[i] = _simplified(corners[i], counts[i])
            kept[i] = True
        if end - start > 1:
            number, total = 0, 0.0
            for i in range(start, end):
                total += areas[i]
                for k in range(counts[i]):
                    points[number, 0], points[number, 1] = corners[i, k, 0], corners[i, k, 1]
                    number += 1
            size = _simplified(hull, _hull(points, number, order, hull))
            area, around = _measure(hull, size)
            if size <= MOST_CORNERS and area - total <= _GAP * around:
                best = start
                for i in range(start + 1, end):
                    best = i if areas[i] > areas[best] else best
                    true_areas[start] += true_areas[i]
                    kept[i] = False
                face[start], areas[start], counts[start] = face[best], total, size
                corners[start, :size] = hull[:size]
                continue
        again = end - start > 1
        while again:
            again = False
            for i in range(start, end):
                if not kept[i]:
                    continue
                j = start
                while j < end:
                    if j == i or not kept[j]:
                        j += 1
                        continue
                    number = counts[i] + counts[j]
                    points[: counts[i]] = corners[i, : counts[i]]
                    points[counts[i] : number] = corners[j, : counts[j]]
                    size = _simplified(hull, _hull(points, number, order, hull))
                    area, around = _measure(hull, size)
                    if size <= MOST_CORNERS and area - areas[i] - areas[j] <= _GAP * around:
                        if biggest[j] > biggest[i]:
                            face[i], biggest[i] = face[j], biggest[j]
                        areas[i] += areas[j]
                        true_areas[i] += true_areas[j]
                        corners[i, :size] = hull[:size]
                        counts[i] = size
                        kept[j] = False
                        again = True
                        j = start
                    else:
                        j += 1
    return kept
