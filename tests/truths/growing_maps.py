"""Maps of known-free cubes made by hand: which cubes are free is given, distances are SciPy's, and brute force."""

import numpy as np
from scipy import ndimage

from keepout.apps.unknown.map_field import MapField

SPACING, CAP = 0.1, 1.2


class Cubes:
    """Cubes of `SPACING` metres over a ball, grown as `mapping` grows its box; `solid` says which are not free."""

    def __init__(self, centre, radius, spacing=SPACING, cap=CAP):
        self.spacing, self.cells = spacing, round(cap / spacing)
        reach = radius + cap + 3.0 * spacing
        self.count = int(np.ceil(2.0 * reach / spacing))
        self.origin = np.asarray(centre, float) - 0.5 * spacing * self.count
        ticks = np.arange(self.count)
        axes = [first + spacing * (ticks + 0.5) for first in self.origin]
        self.centres = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        # Every cube that meets the ball.
        nearest = np.maximum(np.abs(self.centres - centre) - 0.5 * spacing, 0.0)
        self.solid = np.sum(nearest**2, axis=-1) <= radius**2

    def squares(self, solid=None):
        return squared_distances(self.solid if solid is None else solid, self.cells)

    def field(self, solid=None):
        return MapField.of(self.squares(solid), self.origin, self.spacing)

    def distance(self, points, solid=None):
        """Distance (m) of each point to the solid cubes, by brute force over all of them."""
        lower = self.origin + self.spacing * np.argwhere(self.solid if solid is None else solid)
        nearest = np.full(len(points), np.inf)
        for number, point in enumerate(points):
            away = np.maximum(np.maximum(lower - point, point - lower - self.spacing), 0.0)
            nearest[number] = np.sqrt(np.min(np.sum(away**2, axis=-1), initial=np.inf))
        return nearest


def squared_distances(solid, cells):
    """Squared distance, in cells, of each corner of a cube to the nearest solid cube, at most `cells`²."""
    # A node is a corner of the cube nearest to it where it lies on it; else the nearest point of it is a corner.
    corners = np.zeros([n + 1 for n in solid.shape], bool)
    for shift in np.ndindex(2, 2, 2):
        corners[tuple(slice(s, s + n) for s, n in zip(shift, solid.shape, strict=True))] |= solid
    if not corners.any():
        return np.full(corners.shape, cells**2, np.uint16)
    distance = ndimage.distance_transform_edt(~corners)
    return np.minimum(np.rint(distance**2), cells**2).astype(np.uint16)
