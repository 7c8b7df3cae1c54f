"""The surface in patches: convex plane pieces of a mesh, each with two sides that are seen apart."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int


@dataclass(frozen=True, eq=False)
class Patches:
    """Convex plane pieces of a mesh, none wider than `size` along either axis of its plane's grid.

    Each has two *units*: unit 2 i is patch i from the side that its normal points to, unit 2 i + 1 from the other.

    Attributes:
        corners: (n, most, 3) m, body frame, counter-clockwise about the normal; the last corner repeated to fill up.
        counts: (n,) corners of each.
        normals: (n, 3) unit vectors.
        areas: (n,) m².
        centres: (n, 3) centroids, m.
        faces: (n,) a face of the mesh that the patch lies on.
        counted: (2 n,) whether a unit is one that anybody asks to see: not the inner side of a closed part.
        size: edge of the grid that cut them, m.

    """

    corners: Float[np.ndarray, "n most 3"]
    counts: Int[np.ndarray, " n"]
    normals: Float[np.ndarray, "n 3"]
    areas: Float[np.ndarray, " n"]
    centres: Float[np.ndarray, "n 3"]
    faces: Int[np.ndarray, " n"]
    counted: Bool[np.ndarray, " units"]
    size: float

    @property
    def units(self) -> int:
        """Two for each patch."""
        return 2 * len(self.areas)

    def unit_normals(self) -> Float[np.ndarray, "units 3"]:
        """Give the unit vectors out of each unit's side."""
        return np.stack([self.normals, -self.normals], axis=1).reshape(-1, 3)

    def unit_areas(self) -> Float[np.ndarray, " units"]:
        """Area of each unit, m²; 0 for those that are not counted."""
        return np.repeat(self.areas, 2) * self.counted

    def corners_of(self, units: Int[np.ndarray, " k"]) -> Float[np.ndarray, "corners 3"]:
        """Give all corners of some units' patches, m."""
        corners = self.corners[units // 2]
        return corners[np.arange(corners.shape[1]) < self.counts[units // 2][:, None]]

    def coverage(self, seen: Bool[np.ndarray, " units"]) -> float:
        """Give the share, 0 to 1, that the units seen have of the area counted."""
        areas = self.unit_areas()
        return float(areas[seen].sum() / areas.sum())
