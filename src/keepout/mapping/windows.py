"""The rule that frees a cube, for one cube: its window on the image, and the ranges that the window must exceed.

Which number of the assumptions each length comes from, and why the rule is safe: docs/mapping.md.
"""

import math
from typing import NamedTuple, no_type_check

import numba
import numpy as np
from jaxtyping import Float

from keepout.mapping.view import SensorBounds, View

SLACK = 1e-6
"""Metres, and pixels: more than the rounding of the rule's operations and of axes, so that it errs to "not free"."""


class Rule(NamedTuple):
    """The numbers of one view that the rule needs: plain floats for compiled loops."""

    place: tuple[float, float, float]
    """Estimated place of the sensor, m."""
    right: tuple[float, float, float]
    down: tuple[float, float, float]
    ahead: tuple[float, float, float]
    """Camera axes in the map's frame."""
    focal: float
    """Pixels."""
    middle_column: float
    middle_row: float
    columns: int
    rows: int
    half_diagonal: float
    """rho: of a cube, m."""
    clearance: float
    """rho + w + eps_p + slack: what a range must exceed the distance by, and the ball's radius without D eps_theta."""
    attitude_error: float
    nearest: float
    """Least distance D of a cube that can be freed, m."""
    farthest: float
    """Greatest distance D of a cube that can be freed, m."""


def rule_of(view: View, bounds: SensorBounds, spacing: float) -> Rule:
    """Gather the numbers for one view; spacing: edge of the cubes, m."""
    half_diagonal = 0.5 * math.sqrt(3.0) * spacing
    camera = view.camera
    reach = half_diagonal + bounds.position_error
    return Rule(
        _triple(view.position),
        _triple(view.axes[:, 0]),
        _triple(view.axes[:, 1]),
        _triple(view.axes[:, 2]),
        camera.focal,
        0.5 * camera.width,
        0.5 * camera.height,
        camera.width,
        camera.height,
        half_diagonal,
        reach + bounds.surely_returned_width + SLACK,
        bounds.attitude_error,
        bounds.least_range + reach + SLACK,
        bounds.usable_range(camera) - reach - SLACK,
    )


def _triple(vector: Float[np.ndarray, "3"]) -> tuple[float, float, float]:
    return float(vector[0]), float(vector[1]), float(vector[2])


def empty_ranges(view: View, bounds: SensorBounds) -> Float[np.ndarray, "height width"]:
    """Give how far each pixel says that its rays are empty, m; minus infinity where it says nothing.

    Beyond the greatest range no return says nothing, whatever the sure empty range.
    """
    sure = min(bounds.sure_empty_range, bounds.greatest_range)
    empty = view.ranges - bounds.range_error
    empty[np.isposinf(empty)] = sure if sure > 0.0 else -np.inf
    empty[np.isnan(empty)] = -np.inf
    return empty


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
    left = rule.focal * left + rule.middle_column - SLACK
    right = rule.focal * right + rule.middle_column + SLACK
    top = rule.focal * top + rule.middle_row - SLACK
    bottom = rule.focal * bottom + rule.middle_row + SLACK
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
