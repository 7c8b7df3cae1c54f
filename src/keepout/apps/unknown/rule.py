"""The rule that frees cubes: its numbers for one view, windows on the image, and blocks of 8 x 8 x 8 cubes first.

The rule and why it is safe: docs/mapping.md. A block is freed or passed over at once only where that follows for each
of its cubes; every other cube is decided by the rule itself. The least range in a window is exact, so the cubes freed
are the rule's, bit for bit.

All that is compiled together stands in this file: numba knows by a file's date whether what it kept is still right.
"""

import math
from typing import NamedTuple, no_type_check

import numba
import numpy as np
from jaxtyping import Float

from keepout.apps.unknown.view import SensorBounds, View

SLACK = 1e-6
"""Metres, and pixels: more than the rounding of the rule's operations and of axes, so that it errs to "not free"."""


class Rule(NamedTuple):
    """The numbers of one view that the rule needs: plain floats for compiled loops."""

    place: tuple[float, ...]
    """Estimated place of the sensor, m."""
    right: tuple[float, ...]
    down: tuple[float, ...]
    ahead: tuple[float, ...]
    """Camera axes in the map's frame."""
    focal: float
    """Pixels."""
    middle_column: float
    middle_row: float
    columns: int
    rows: int
    clearance: float
    """rho + w + eps_p + slack: what a range must exceed the distance by, and the ball's radius without D eps_theta."""
    attitude_error: float
    nearest: float
    """Least distance D of a cube that can be freed, m."""
    farthest: float
    """Greatest distance D of a cube that can be freed, m."""
    slack: float
    """Pixels that each window is widened by on each side."""


def rule_of(view: View, bounds: SensorBounds, spacing: float) -> Rule:
    """Gather the numbers for one view; spacing: edge of the cubes, m."""
    camera = view.camera
    # rho + eps_p: from the estimated place to a cube's farthest point, beyond the cube's centre.
    reach = 0.5 * math.sqrt(3.0) * spacing + bounds.position_error
    place, right, down, ahead = (tuple(vector.tolist()) for vector in (view.position, *view.axes.T))
    return Rule(
        place,
        right,
        down,
        ahead,
        camera.focal,
        0.5 * camera.width,
        0.5 * camera.height,
        camera.width,
        camera.height,
        reach + bounds.surely_returned_width + SLACK,
        bounds.attitude_error,
        bounds.least_range + reach + SLACK,
        bounds.usable_range(camera) - reach - SLACK,
        SLACK,
    )


def empty_ranges(view: View, bounds: SensorBounds) -> Float[np.ndarray, "height width"]:
    """Give how far each pixel says that its rays are empty, m; minus infinity where it says nothing.

    Beyond the greatest range no return says nothing, whatever the sure empty range.
    """
    sure = min(bounds.sure_empty_range, bounds.greatest_range)
    empty = view.ranges - bounds.range_error
    empty[np.isposinf(empty)] = sure if sure > 0.0 else -np.inf
    empty[np.isnan(empty)] = -np.inf
    return empty


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


BLOCK = 8
"""Cubes across a block."""
_SURE = 1e-5
"""Metres, and pixels' worth of metres: a block is decided at once only by more than this, far above all rounding."""


@no_type_check
@numba.njit(cache=True, nogil=True, inline="always")
def slopes(across, ahead, radius):
    """Give the least and the greatest slope of lines through the origin that meet a disc in the half-plane ahead.

    The disc's centre is (across, ahead), and ahead > radius. They are the two tangents: the roots u of
    (across - u ahead)^2 = radius^2 (1 + u^2).
    """
    below = ahead * ahead - radius * radius
    spread = radius * math.sqrt(across * across + below)
    return (across * ahead - spread) / below, (across * ahead + spread) / below


@no_type_check
@numba.njit(cache=True, nogil=True, inline="always")
def _pixel(place, count):
    """Give the pixel that holds a place on the image: -1 before the first, `count` behind the last."""
    # A place on the last pixel's far side belongs to it.
    return count - 1 if place == count else math.floor(min(max(place, -1.0), float(count)))


@no_type_check
@numba.njit(cache=True, nogil=True)
def window(rule, x, y, z, radius):
    """Give the pixels that meet the bounding rectangle of a ball's projection.

    Args:
        rule: of the view.
        x: of the ball's centre in camera axes, m; y and z as well, with z > radius.
        y: see x.
        z: see x.
        radius: of the ball, m.

    Returns:
        First and last row, first and last column, -1 and the count standing for all beyond the image; whether all of
        the rectangle lies in the image.

    """
    left, right = slopes(x, z, radius)
    top, bottom = slopes(y, z, radius)
    left = rule.focal * left + rule.middle_column - rule.slack
    right = rule.focal * right + rule.middle_column + rule.slack
    top = rule.focal * top + rule.middle_row - rule.slack
    bottom = rule.focal * bottom + rule.middle_row + rule.slack
    inside = left >= 0.0 and top >= 0.0 and right <= rule.columns and bottom <= rule.rows
    return (
        _pixel(top, rule.rows),
        _pixel(bottom, rule.rows),
        _pixel(left, rule.columns),
        _pixel(right, rule.columns),
        inside,
    )


@no_type_check
@numba.njit(cache=True, nogil=True, inline="always")
def in_camera(rule, x, y, z):
    """Give a point of the map's frame in camera axes, and its distance from the sensor's place."""
    dx, dy, dz = x - rule.place[0], y - rule.place[1], z - rule.place[2]
    return (
        rule.right[0] * dx + rule.right[1] * dy + rule.right[2] * dz,
        rule.down[0] * dx + rule.down[1] * dy + rule.down[2] * dz,
        rule.ahead[0] * dx + rule.ahead[1] * dy + rule.ahead[2] * dz,
        math.sqrt(dx * dx + dy * dy + dz * dz),
    )


@no_type_check
@numba.njit(cache=True, nogil=True)
def every_pixel(levels, first_row, last_row, first_column, last_column, limit, exceeds):
    """Whether every pixel of a rectangle exceeds a limit, or none does, as `exceeds` asks.

    That "its value exceeds the limit" is `exceeds` is asked of each of the largest squares that cover the rectangle;
    `levels` is the pyramid of least values where all should exceed, of greatest values where none should.
    """
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
            if (levels[level, row, column] > limit) != exceeds:
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
    limit = distance + rule.clearance
    return inside and every_pixel(least, first_row, last_row, first_column, last_column, limit, True)


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
        and every_pixel(least, first_row, last_row, first_column, last_column, far + rule.clearance, True)
    ):
        return _FREE
    first_row, last_row = max(first_row, 0), min(last_row, rule.rows - 1)
    first_column, last_column = max(first_column, 0), min(last_column, rule.columns - 1)
    if first_row > last_row or first_column > last_column:
        return _NOTHING
    if every_pixel(greatest, first_row, last_row, first_column, last_column, near + rule.clearance, False):
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
