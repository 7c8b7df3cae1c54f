"""Triangles in a plane cut along a grid: one convex piece for each triangle and each cell of the grid that it meets."""

from typing import no_type_check

import numba
import numpy as np

# `no_type_check` below: run-time shape checks would wrap the functions that numba compiles.
PIECE_CORNERS = 8
"""Room for the corners of a piece: a triangle cut by two pairs of lines has at most 7."""


@numba.njit(cache=True, nogil=True)
@no_type_check
def _keep(polygon, count, axis, line, sign, out):
    """Write the part of a polygon where sign * coordinate >= sign * line; give its number of corners."""
    kept = 0
    for i in range(count):
        j = i + 1 if i + 1 < count else 0
        here, there = sign * (polygon[i, axis] - line), sign * (polygon[j, axis] - line)
        if here >= 0.0:
            out[kept, 0], out[kept, 1] = polygon[i, 0], polygon[i, 1]
            kept += 1
        if (here > 0.0 and there < 0.0) or (here < 0.0 and there > 0.0):
            # From the inner end, so that both sides of the line get the same point.
            s, e, t = (i, j, here / (here - there)) if here > 0.0 else (j, i, there / (there - here))
            if sign < 0.0:
                s, e, t = e, s, 1.0 - t
            out[kept, axis] = line
            out[kept, 1 - axis] = polygon[s, 1 - axis] + t * (polygon[e, 1 - axis] - polygon[s, 1 - axis])
            kept += 1
    return kept


@numba.njit(cache=True, nogil=True)
@no_type_check
def _double_area(polygon, count):
    total = 0.0
    for i in range(1, count - 1):
        total += (polygon[i, 0] - polygon[0, 0]) * (polygon[i + 1, 1] - polygon[0, 1]) - (
            polygon[i, 1] - polygon[0, 1]
        ) * (polygon[i + 1, 0] - polygon[0, 0])
    return total


@numba.njit(cache=True, nogil=True)
@no_type_check
def _span(polygon, count, axis, step, cells):
    """Give the first cell and the one after the last along an axis that a polygon may meet."""
    low, high = np.inf, -np.inf
    for i in range(count):
        low, high = min(low, polygon[i, axis]), max(high, polygon[i, axis])
    first = min(max(int(np.floor(low / step)) - 1, 0), cells - 1)
    last = min(max(int(np.floor(high / step)) + 1, 0), cells - 1)
    while first < last and (first + 1) * step <= low:
        first += 1
    while last > first and last * step >= high:
        last -= 1
    return first, last + 1


@numba.njit(cache=True, nogil=True)
@no_type_check
def pieces(triangles, region, steps, cells, least, corners, counts, areas, cell, face):
    """Cut triangles along their regions' grids.

    Args:
        triangles: (f, 3, 2) m, from the corner of each one's grid, counter-clockwise.
        region: (f,) of each; those below 0 are left out.
        steps: (regions, 2) size of a cell, m.
        cells: (regions, 2) numbers of cells.
        least: area of the smallest piece that is kept, m².
        corners: (n, PIECE_CORNERS, 2) to be filled; with n = 0 the pieces are counted only.
        counts: (n,) corners of each piece.
        areas: (n,) m².
        cell: (n,) number of the cell within its region's grid.
        face: (n,) the triangle.

    Returns:
        The number of pieces.

    """
    number = 0
    one, column, other, piece = np.empty((8, 2)), np.empty((8, 2)), np.empty((8, 2)), np.empty((8, 2))
    for f in range(len(triangles)):
        r = region[f]
        if r < 0:
            continue
        dx, dy, nx, ny = steps[r, 0], steps[r, 1], cells[r, 0], cells[r, 1]
        first_x, end_x = _span(triangles[f], 3, 0, dx, nx)
        for i in range(first_x, end_x):
            # The outermost cells take all that rounding puts outside.
            some = _keep(triangles[f], 3, 0, i * dx if i > 0 else -np.inf, 1.0, one)
            wide = _keep(one, some, 0, (i + 1) * dx if i + 1 < nx else np.inf, -1.0, column)
            if wide < 3:
                continue
            first_y, end_y = _span(column, wide, 1, dy, ny)
            for j in range(first_y, end_y):
                some = _keep(column, wide, 1, j * dy if j > 0 else -np.inf, 1.0, other)
                count = _keep(other, some, 1, (j + 1) * dy if j + 1 < ny else np.inf, -1.0, piece)
                area = 0.5 * _double_area(piece, count)
                if count < 3 or area <= least:
                    continue
                if len(counts) > 0:
                    corners[number, :count] = piece[:count]
                    counts[number], areas[number] = count, area
                    cell[number], face[number] = i * ny + j, f
                number += 1
    return number
