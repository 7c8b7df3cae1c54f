"""A distance as a cubic B-spline on a grid, for a solver that wants second derivatives in its own language."""

import dataclasses
from collections.abc import Callable

import numpy as np
import scipy.interpolate
from jaxtyping import Float

MOST_NODES = 6_000_000


@dataclasses.dataclass(frozen=True)
class FieldSpline:
    """A tensor spline: knots of each axis (m), coefficients (nx, ny, nz) in m, and its grid's spacing (m)."""

    knots: tuple[np.ndarray, np.ndarray, np.ndarray]
    coefficients: Float[np.ndarray, "nx ny nz"]
    spacing: float

    @classmethod
    def interpolating(
        cls, value: Callable[[np.ndarray], np.ndarray], lower: np.ndarray, upper: np.ndarray, spacing: float
    ) -> "FieldSpline":
        """Interpolate `value` of points (n, 3) at the nodes of a grid over a box, all in m.

        The grid is wider than `spacing` where it would have more than `MOST_NODES`.
        """
        spacing = max(spacing, float(np.prod(upper - lower) / MOST_NODES) ** (1.0 / 3.0))
        axes = [np.linspace(a, b, 1 + int(np.ceil((b - a) / spacing))) for a, b in zip(lower, upper, strict=True)]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        coefficients = value(points.reshape(-1, 3)).reshape(points.shape[:3])
        knots = []
        for axis, nodes in enumerate(axes):
            found = scipy.interpolate.make_interp_spline(nodes, coefficients, k=3, axis=axis)
            coefficients = np.moveaxis(found.c, 0, axis)
            knots.append(found.t)
        return cls((knots[0], knots[1], knots[2]), coefficients, spacing)
