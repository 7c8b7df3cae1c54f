"""The numbers of the rule that frees cubes, gathered for one view; the rule and why it is safe: docs/mapping.md."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from keepout.apps.unknown.mapping.view import SensorBounds, View

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
        reach + bounds.surely_returned_width + SLACK,
        bounds.attitude_error,
        bounds.least_range + reach + SLACK,
        bounds.usable_range(camera) - reach - SLACK,
        SLACK,
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
