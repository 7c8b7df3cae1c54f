"""Patches as triangles, for pictures: each with the patch that it is part of."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from keepout.apps.inspection.seeing.patches import Patches

_WELD = 1e-6
"""Metres within which corners are one."""


@dataclass(frozen=True, eq=False)
class PatchMesh:
    """Triangles that together are the patches.

    Attributes:
        vertices: m.
        faces: counter-clockwise about the normal of their patch.
        patch: of each face.

    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    patch: Int[np.ndarray, " f"]

    @classmethod
    def of(cls, patches: Patches) -> "PatchMesh":
        """Divide each patch into triangles that share its first corner."""
        most = patches.corners.shape[1]
        second = np.arange(1, most - 1)
        patch, place = np.nonzero(second[None] + 1 < patches.counts[:, None])
        first = most * patch
        faces = np.column_stack([first, first + second[place], first + second[place] + 1])
        _, kept, joined = np.unique(
            np.rint(patches.corners.reshape(-1, 3) / _WELD).astype(np.int64),
            axis=0,
            return_index=True,
            return_inverse=True,
        )
        return cls(patches.corners.reshape(-1, 3)[kept], joined.reshape(-1)[faces], patch)

    def triangles(self) -> Float[np.ndarray, "f 3 3"]:
        """Give the corners of each face, m."""
        return self.vertices[self.faces]
