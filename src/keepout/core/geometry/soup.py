"""A triangle soup as distances and rays take it: any triangles, checked once."""

import numpy as np
from jaxtyping import Float, Int

from keepout.core.errors import MeshError


class TriangleSoup:
    """Triangles without order, sides or holes; `lower` and `upper` (3,) are the corners of the box that holds them.

    Args:
        vertices: (V, 3) positions in metres.
        faces: (F, 3) vertex indices; at least one.

    Raises:
        MeshError: no faces, an index outside the vertices, or a vertex that is not finite.

    """

    def __init__(self, vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]):
        self.vertices = np.ascontiguousarray(vertices, dtype=np.float64)
        self.faces = np.ascontiguousarray(faces, dtype=np.int64)
        if len(self.faces) == 0:
            raise MeshError("distances and rays need at least one triangle, and there are 0")
        if self.faces.min() < 0 or self.faces.max() >= len(self.vertices):
            raise MeshError(
                f"faces: index {self.faces.max()} or {self.faces.min()} is outside 0 to {len(self.vertices) - 1}"
            )
        used = self.vertices[self.faces]
        if not np.isfinite(used).all():
            raise MeshError("vertices: a triangle has a corner that is not finite; every coordinate must be a number")
        self.lower: Float[np.ndarray, 3] = used.min(axis=(0, 1))
        self.upper: Float[np.ndarray, 3] = used.max(axis=(0, 1))
