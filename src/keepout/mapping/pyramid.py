"""Which cubes a view frees: blocks of 8 x 8 x 8 cubes first, by the least and greatest range in squares of pixels.

A block is freed or passed over at once only where that follows for each of its cubes; every other cube is decided by
the rule itself. The least range in a window is exact, so the cubes freed are the rule's, bit for bit.
"""

import math
from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Float

from keepout.mapping.windows import in_camera, window

BLOCK = 8
"""Cubes across a block."""
_SURE = 1e-5
"""Metres, and pixels' worth of metres: a block is decided at once only by more than this, far above all rounding."""


def pyramid(image: Float[np.ndarray, "rows columns"], *, greatest: bool = False) -> Float[np.ndarray, "k rows columns"]:
    """Give at [k, i, j] the least value in the square of 2^k pixels from pixel (i, j) on; the greatest, where asked."""
    levels = [image]
    side = 1
    pick = np.maximum if greatest else np.minimum
    while 2 * side <= min(image.shape):
        below = levels[-1]
        level = below.copy()
        level[:-side] = pick(level[:-side], below[side:])
        across = level.copy()
        level[:, :-side] = pick(level[:, :-side], across[:, side:])
        levels.append(level)
        side *= 2
    return np.stack(levels)


@no_type_check
@numba.njit(cache=True, nogil=True)
def all_exceed(levels, first_row, last_row, first_column, last_column, limit):
    """Whether every pixel of a rectangle exceeds a limit; `levels`: least values in squares."""
    short = min(last_row - first_row, last_column - first_column) + 1
    level, side = 0, 1
    while 2 * side <= short:
        side *= 2
        level += 1
    row = first_row
    while True:
        row = min(row, last_row - side + 1)
        column = first_column
        while True:
            column = min(column, last_column - side + 1)
            if not levels[level, row, column] > limit:
                return False
            column += side
            if column > last_column:
                break
        row += side
        if row > last_row:
            return True


@no_type_check
@numba.njit(cache=True, nogil=True)
def none_exceeds(levels, first_row, last_row, first_column, last_column, limit):
    """Whether no pixel of a rectangle exceeds a limit; `levels`: greatest values in squares."""
    short = min(last_row - first_row, last_column - first_column) + 1
    level, side = 0, 1
    while 2 * side <= short:
        side *= 2
        level += 1
    row = first_row
    while True:
        row = min(row, last_row - side + 1)
        column = first_column
        while True:
            column = min(column, last_column - side + 1)
            if levels[level, row, column] > limit:
                return False
            column += side
            if column > last_column:
                break
        row += side
        if row > last_row:
            return True


@no_type_check
@numba.njit(cache=True, nogil=True)
def cube_is_free(rule, least, x, y, z):
    """Apply the rule to the cube round a centre in the map's frame; `least`: pyramid of how far pixels are empty."""
    across, down, ahead, distance = in_camera(rule, x, y, z)
    radius = rule.clearance + distance * rule.attitude_error
    if ahead <= radius or distance < rule.nearest or distance > rule.farthest:
        return False
    first_row, last_row, first_column, last_column, inside = window(rule, across, down, ahead, radius)
    return inside and all_exceed(least, first_row, last_row, first_column, last_column, distance + rule.clearance)


_UNDECIDED, _FREE, _NOTHING = 0, 1, 2


@no_type_check
@numba.njit(cache=True, nogil=True)
def _block(rule, least, greatest, x, y, z, spread):
    """Decide all cubes whose centres lie within `spread` of a point at once, where that is sure."""
    across, down, ahead, distance = in_camera(rule, x, y, z)
    near, far = distance - spread - _SURE, distance + spread + _SURE
    if far < rule.nearest or near > rule.farthest:
        return _NOTHING
    # Each ball must lie between the four planes through the sensor and the image's sides.
    smallest = rule.clearance + max(near, 0.0) * rule.attitude_error - spread - _SURE
    for offset, half in ((across, rule.middle_column), (down, rule.middle_row)):
        if (half * ahead - rule.focal * abs(offset)) < smallest * math.sqrt(half * half + rule.focal * rule.focal):
            return _NOTHING
    radius = spread + rule.clearance + far * rule.attitude_error + _SURE
    if ahead <= radius:
        return _UNDECIDED
    first_row, last_row, first_column, last_column, inside = window(rule, across, down, ahead, radius)
    if (
        inside
        and near >= rule.nearest
        and far <= rule.farthest
        and all_exceed(least, first_row, last_row, first_column, last_column, far + rule.clearance)
    ):
        return _FREE
    first_row, last_row = max(first_row, 0), min(last_row, rule.rows - 1)
    first_column, last_column = max(first_column, 0), min(last_column, rule.columns - 1)
    if first_row > last_row or first_column > last_column:
        return _NOTHING
    if none_exceeds(greatest, first_row, last_row, first_column, last_column, near + rule.clearance):
        return _NOTHING
    return _UNDECIDED


@no_type_check
@numba.njit(cache=True, nogil=True)
def free_cubes(rule, least, greatest, origin, spacing, first, last, free, unknown, changed):
    """Free the cubes that the rule frees, in place.

    Args:
        rule: numbers of the view.
        least: pyramid of least ranges; `greatest`: of greatest.
        greatest: see least.
        origin: (3,) lower corner of the grid, m.
        spacing: edge of a cube, m.
        first: (3,) first block that may hold a cube to free; `last`: the one after the last.
        last: see first.
        free: (n, n, n) bool.
        unknown: cubes of each block that are not free.
        changed: set True for blocks of which a cube was freed.

    Returns:
        How many cubes were freed.

    """
    opened = 0
    spread = 0.5 * (BLOCK - 1) * math.sqrt(3.0) * spacing
    for a in range(first[0], last[0]):
        for b in range(first[1], last[1]):
            for c in range(first[2], last[2]):
                if unknown[a, b, c] == 0:
                    continue
                x = origin[0] + (a + 0.5) * BLOCK * spacing
                y = origin[1] + (b + 0.5) * BLOCK * spacing
                z = origin[2] + (c + 0.5) * BLOCK * spacing
                verdict = _block(rule, least, greatest, x, y, z, spread)
                if verdict == _NOTHING:
                    continue
                before = unknown[a, b, c]
                left = 0
                for i in range(a * BLOCK, (a + 1) * BLOCK):
                    for j in range(b * BLOCK, (b + 1) * BLOCK):
                        for k in range(c * BLOCK, (c + 1) * BLOCK):
                            if free[i, j, k]:
                                continue
                            if verdict == _FREE or cube_is_free(
                                rule,
                                least,
                                origin[0] + (i + 0.5) * spacing,
                                origin[1] + (j + 0.5) * spacing,
                                origin[2] + (k + 0.5) * spacing,
                            ):
                                free[i, j, k] = True
                            else:
                                left += 1
                if left < before:
                    unknown[a, b, c] = left
                    changed[a, b, c] = True
                    opened += before - left
    return opened
