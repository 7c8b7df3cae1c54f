"""Sight lines: whether nothing of a mesh stands between a camera, or the sun, and the whole of a patch."""

import numpy as np
from jaxtyping import Bool, Float, Int

from keepout.apps.inspection.seeing import pyramid_kernel
from keepout.apps.inspection.seeing.patches import Patches
from keepout.core.errors import InspectionError
from keepout.core.geometry.distance import TriangleSoup
from keepout.core.geometry.first_hit import DEEPEST, build_tree

LIFT = pyramid_kernel.LIFT
"""What lies at most this far above a patch's plane does not block, nor what is as near below the camera's height, m."""
FARTHEST = 1e5
"""Places may have coordinates up to this, m: beyond it rounding comes near the margins."""

Units = Int[np.ndarray, " m"]


class Sightlines:
    """The pyramids from places, and the prisms from the sun, to a mesh's patches.

    A pair is called clear only if for every triangle of the mesh a plane is found that separates it from the pyramid,
    of which the part at most `LIFT` above the patch's plane, and that at most `LIFT` below the camera's height, do
    not count. So no straight line from the place to any point of the patch meets the mesh between these two heights.
    The other way round a pair may be called blocked that is clear by less than rounding. docs/seeing.md has the proof.

    Args:
        vertices: (V, 3) of the mesh, m.
        faces: (F, 3) vertex indices; all of them block.
        patches: the units.

    Raises:
        MeshError: no faces, an index outside the vertices, or a vertex that is not finite.

    """

    def __init__(self, vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], patches: Patches):
        soup = TriangleSoup(vertices, faces)
        self.patches = patches
        self._tree = build_tree(soup.vertices[soup.faces])
        self._largest = float(max(np.abs(soup.lower).max(), np.abs(soup.upper).max()))
        self._corners = np.ascontiguousarray(patches.corners, dtype=np.float64)
        self._counts = np.ascontiguousarray(patches.counts, dtype=np.int64)

    def clear(self, places: Float[np.ndarray, "#m 3"], units: Units) -> Bool[np.ndarray, " m"]:
        """Say of each pair whether nothing stands between the place and the whole of the unit.

        A place behind the unit's plane, or less than a few `LIFT` above it, sees nothing of it.

        Args:
            places: (m, 3), or (1, 3) for one place, m, body frame. Pairs that are neighbours in the list had better
                be neighbours in space: each looks first at what blocked the one before.
            units: (m,) 2 i + side.

        Raises:
            InspectionError: a place that is not finite or farther than `FARTHEST`, or a unit that there is not.

        """
        places = np.ascontiguousarray(places, dtype=np.float64)
        if not (np.isfinite(places).all() and np.abs(places).max(initial=0.0) <= FARTHEST):
            raise InspectionError(f"sight lines: a place is not finite or has a coordinate beyond {FARTHEST:g} m")
        largest = max(self._largest, float(np.abs(places).max(initial=0.0)))
        return self._look(places, 1.0, units, largest)

    def lit(self, sun: Float[np.ndarray, "3"], units: Units) -> Bool[np.ndarray, " m"]:
        """Say of each unit whether nothing stands between the whole of it and the sun, taken as infinitely far.

        Args:
            sun: (3,) towards the sun, of any length but zero, body frame.
            units: (m,) 2 i + side.

        Raises:
            InspectionError: a direction that is not finite or zero, or a unit that there is not.

        """
        sun = np.asarray(sun, dtype=np.float64)
        length = float(np.linalg.norm(sun))
        if not 0.0 < length < np.inf:
            raise InspectionError(f"sight lines: the direction to the sun is {sun.tolist()}; it must not be zero")
        return self._look((sun / length)[None], 0.0, units, self._largest)

    def _look(
        self, eyes: Float[np.ndarray, "#m 3"], far: float, units: Units, largest: float
    ) -> Bool[np.ndarray, " m"]:
        units = np.ascontiguousarray(units, dtype=np.int64)
        if len(units) and (units.min() < 0 or units.max() >= self.patches.units):
            raise InspectionError(
                f"sight lines: unit {units.min()} or {units.max()} is outside 0 to {self.patches.units - 1}"
            )
        clear = np.empty(len(units), dtype=bool)
        tree = self._tree
        pyramid_kernel.look(
            tree.boxes,
            tree.children,
            tree.first,
            tree.corners,
            DEEPEST,
            self._corners,
            self._counts,
            self.patches.centres,
            self.patches.normals,
            eyes,
            far,
            units,
            largest,
            clear,
        )
        return clear
