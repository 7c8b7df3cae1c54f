"""An ordinary truncated-distance map (Curless & Levoy 1996; KinectFusion, Newcombe et al. 2011), to compare with.

What it has not seen counts as free. It takes the same views as `KnownFreeMap`, on the same cubes, and gives distances
in the same form, so that the same field, law and guard fly by either. Distance along the ray to a cube's centre, the
pixel that the centre falls into, weight 1 a view. A cube is an obstacle where the mean says that the surface passes
through it or in front of it.
"""

import math

import numba
import numpy as np

from keepout.apps.unknown.distance_transform import squares_of
from keepout.apps.unknown.known_free import KnownFreeMap
from keepout.apps.unknown.view import View

TRUNCATION = 4.0
"""Largest signed distance that is averaged, in cubes."""


@numba.njit(cache=True, nogil=True)
def _integrate(mean, weight, origin, spacing, position, axes, focal, ranges, greatest, truncation):
    rows, columns = ranges.shape
    touched = 0
    for i in range(mean.shape[0]):
        dx = origin[0] + spacing * (i + 0.5) - position[0]
        for j in range(mean.shape[1]):
            dy = origin[1] + spacing * (j + 0.5) - position[1]
            if dx * dx + dy * dy > greatest * greatest:
                continue
            for k in range(mean.shape[2]):
                dz = origin[2] + spacing * (k + 0.5) - position[2]
                away = math.sqrt(dx * dx + dy * dy + dz * dz)
                ahead = axes[0, 2] * dx + axes[1, 2] * dy + axes[2, 2] * dz
                if away > greatest or ahead <= 0.0:
                    continue
                right = axes[0, 0] * dx + axes[1, 0] * dy + axes[2, 0] * dz
                down = axes[0, 1] * dx + axes[1, 1] * dy + axes[2, 1] * dz
                column = math.floor(focal * right / ahead + 0.5 * columns)
                row = math.floor(focal * down / ahead + 0.5 * rows)
                if row < 0 or column < 0 or row >= rows or column >= columns:
                    continue
                signed = min(ranges[row, column] - away, truncation)
                if signed >= -truncation:  # not where the pixel says nothing: nan
                    weight[i, j, k] += 1.0
                    mean[i, j, k] += (signed - mean[i, j, k]) / weight[i, j, k]
                    touched += 1
    return touched


class TruncatedDistanceMap:
    """Mean truncated signed distance of each cube, on the grid of a `KnownFreeMap`.

    Args:
        like: a map whose grid, cap and sensor are taken over; nothing is taken of what it has seen.

    """

    def __init__(self, like: KnownFreeMap):
        self.origin, self.spacing, self.cap = like.origin, like.spacing, like.cap
        self.truncation, self.greatest = TRUNCATION * like.spacing, like.bounds.greatest_range
        self.mean = np.full(like.free.shape, self.truncation, dtype=np.float32)  # unseen: free
        self.weight = np.zeros_like(self.mean)

    def see(self, view: View) -> int:
        """Average a view in; gives how many cubes it said something of."""
        pose = np.ascontiguousarray(view.position), np.ascontiguousarray(view.axes)
        grid = self.mean, self.weight, self.origin, self.spacing
        return _integrate(*grid, *pose, view.camera.focal, view.ranges, self.greatest, self.truncation)

    def squares(self) -> np.ndarray:
        """Squared distance of each corner to the nearest obstacle, in cells, capped: as `KnownFreeMap.squares`."""
        return squares_of((self.weight == 0) | (self.mean > 0.5 * self.spacing), round(self.cap / self.spacing))
