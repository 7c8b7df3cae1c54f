"""Polygons in a plane, as arrays of corners and how many of them count: area, convex hull, and straight corners."""

import numpy as np

from keepout.core.cores import kernel

_STRAIGHT = 1e-9
"""A corner that lies nearer than this to the line between its neighbours, or to one of them, is left out, m."""


@kernel()
def double_area(polygon, count):
    """Give twice the area, positive where the corners run counter-clockwise."""
    total = 0.0
    for i in range(1, count - 1):
        total += (polygon[i, 0] - polygon[0, 0]) * (polygon[i + 1, 1] - polygon[0, 1]) - (
            polygon[i, 1] - polygon[0, 1]
        ) * (polygon[i + 1, 0] - polygon[0, 0])
    return total


@kernel()
def copy_corners(polygon, count, to, first):
    """Write corners into places of another array; a slice of it, copied, takes Numba a second to compile."""
    for i in range(count):
        to[first + i, 0], to[first + i, 1] = polygon[i, 0], polygon[i, 1]


@kernel()
def hull_of(points, order, count, chain):
    """Write indices of the corners of the convex hull, counter-clockwise (Andrew's monotone chain); their number.

    Args:
        points: (n, 2 or more) x, y.
        order: of them by x, then y.
        count: how many of these.
        chain: room for twice as many indices, and two.

    """
    size = 0
    for way in range(2):
        base = size
        for step in range(count):
            k = order[step] if way == 0 else order[count - 1 - step]
            while size >= base + 2:
                a, b = chain[size - 2], chain[size - 1]
                ax, ay = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1]
                bx, by = points[k, 0] - points[b, 0], points[k, 1] - points[b, 1]
                if ax * by - ay * bx > 0.0:
                    break
                size -= 1
            chain[size] = k
            size += 1
        size -= 1
    return size


@kernel()
def simplified(polygon, count):
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


@kernel()
def _measure(polygon, count):
    around = 0.0
    for i in range(count):
        j = i + 1 if i + 1 < count else 0
        around += np.hypot(polygon[j, 0] - polygon[i, 0], polygon[j, 1] - polygon[i, 1])
    return 0.5 * double_area(polygon, count), around


@kernel()
def sort_points(points, count, order):
    """Write the order of points by x, then y."""
    order[0] = 0
    for i in range(1, count):
        k, j = i, i
        while j > 0 and (
            points[order[j - 1], 0] > points[k, 0]
            or (points[order[j - 1], 0] == points[k, 0] and points[order[j - 1], 1] > points[k, 1])
        ):
            order[j] = order[j - 1]
            j -= 1
        order[j] = k


@kernel()
def outline(points, count, work):
    """Write the convex hull of points without straight corners; their number, its area and its circumference."""
    order, chain, out = work
    sort_points(points, count, order)
    size = hull_of(points, order, count, chain)
    for i in range(size):
        out[i, 0], out[i, 1] = points[chain[i], 0], points[chain[i], 1]
    size = simplified(out, size)
    area, around = _measure(out, size)
    return size, area, around
