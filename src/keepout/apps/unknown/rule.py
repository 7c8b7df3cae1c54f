"""The rule that frees cubes: its numbers for one view, and windows on the image.

The rule and why it is safe: docs/mapping.md. The least range in a window is exact.

All that is compiled together stands in this file: numba knows by a file's date whether what it kept is still right.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from keepout.apps.unknown.view import SensorBounds, View
from keepout.core.cores import kernel

SLACK = 1e-6
"""Metres, and pixels that a window is widened by on each side: more than the rounding of the rule's operations and of
axes, so that it errs to "not free"."""


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
    """Half the columns and half the rows."""
    clearance: float
    """rho + w + eps_p + slack: what a range must exceed the distance by, and the ball's radius without D eps_theta."""
    attitude_error: float
    nearest: float
    """Least distance D of a cube that can be freed, m."""
    farthest: float
    """Greatest distance D of a cube that can be freed, m."""


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
        reach + bounds.surely_returned_width + SLACK,
        bounds.attitude_error,
        bounds.least_range + reach + SLACK,
        bounds.usable_range(camera) - reach - SLACK,
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


def pyramid(image: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "k rows columns"]:
    """Give at [k, i, j] the least value in the square of 2^k pixels from pixel (i, j) on."""
    levels = [image]
    side = 1
    while 2 * side <= min(image.shape):
        below = levels[-1]
        level = below.copy()
        level[:-side] = np.minimum(level[:-side], below[side:])
        across = level.copy()
        level[:, :-side] = np.minimum(level[:, :-side], across[:, side:])
        levels.append(level)
        side *= 2
    return np.stack(levels)


BLOCK = 8
"""Cubes across a block: those without an unknown cube are passed over, and distances made anew where one changed."""


@kernel(inline="always")
def _pixels(rule, across, ahead, radius, middle):
    """Give the first and the last pixel that a ball's projection meets along one axis of the image, or twice -1.

    The ball's centre in camera axes is (across, ahead) along this axis and the boresight, and ahead > radius. The least
    and the greatest slope of lines through the origin that meet that disc are the two tangents': the roots u of
    (across - u ahead)^2 = radius^2 (1 + u^2). Of a ball that reaches beyond the image no pixel is given.
    """
    below = ahead * ahead - radius * radius
    spread = radius * math.sqrt(across * across + below)
    first = rule.focal * ((across * ahead - spread) / below) + middle - SLACK
    last = rule.focal * ((across * ahead + spread) / below) + middle + SLACK
    if first < 0.0 or last > 2.0 * middle:
        return -1, -1
    # A place on the last pixel's far side belongs to it.
    return math.floor(first), min(math.floor(last), math.floor(2.0 * middle) - 1)


@kernel()
def all_exceed(least, first_row, last_row, first_column, last_column, limit):
    """Whether every pixel of a rectangle exceeds a limit: each of the largest squares of the pyramid that cover it."""
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
            if not least[level, row, column] > limit:
                return False
            column += side
            if column > last_column:
                break
        row += side
        if row > last_row:
            return True


@kernel(inline="always")
def cube_is_free(rule, least, x, y, z):
    """Apply the rule to the cube round a centre in the map's frame; `least`: pyramid of how far pixels are empty."""
    dx, dy, dz = x - rule.place[0], y - rule.place[1], z - rule.place[2]
    distance = math.sqrt(dx * dx + dy * dy + dz * dz)
    ahead = rule.ahead[0] * dx + rule.ahead[1] * dy + rule.ahead[2] * dz
    radius = rule.clearance + distance * rule.attitude_error
    if ahead <= radius or distance < rule.nearest or distance > rule.farthest:
        return False
    limit = distance + rule.clearance
    across = rule.right[0] * dx + rule.right[1] * dy + rule.right[2] * dz
    down = rule.down[0] * dx + rule.down[1] * dy + rule.down[2] * dz
    # The pixel that looks at the centre is one of the window: where it says no, nothing else need be asked.
    column, row = rule.focal * across / ahead + rule.middle_column, rule.focal * down / ahead + rule.middle_row
    rows, columns = least.shape[1:]
    if not (0.0 <= column < columns and 0.0 <= row < rows and least[0, int(row), int(column)] > limit):
        return False
    first_column, last_column = _pixels(rule, across, ahead, radius, rule.middle_column)
    first_row, last_row = _pixels(rule, down, ahead, radius, rule.middle_row)
    if first_column < 0 or first_row < 0:
        return False
    return all_exceed(least, first_row, last_row, first_column, last_column, limit)


@kernel()
def free_cubes(rule, least, origin, spacing, first, last, free, unknown, changed):
    """Free the cubes that the rule frees, in place.

    Args:
        rule: numbers of the view.
        least: pyramid of how far pixels are empty.
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
    for a in range(first[0], last[0]):
        for b in range(first[1], last[1]):
            for c in range(first[2], last[2]):
                left = 0
                for i in range(a * BLOCK, (a + 1) * BLOCK if unknown[a, b, c] else 0):
                    for j in range(b * BLOCK, (b + 1) * BLOCK):
                        for k in range(c * BLOCK, (c + 1) * BLOCK):
                            if free[i, j, k]:
                                continue
                            x, y, z = (i + 0.5) * spacing, (j + 0.5) * spacing, (k + 0.5) * spacing
                            if cube_is_free(rule, least, origin[0] + x, origin[1] + y, origin[2] + z):
                                free[i, j, k] = True
                            else:
                                left += 1
                if left < unknown[a, b, c]:
                    opened += unknown[a, b, c] - left
                    unknown[a, b, c] = left
                    changed[a, b, c] = True
    return opened
