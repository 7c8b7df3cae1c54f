"""A mesh as room to stay out of: the convex hull of each of its parts, by planes and by corners."""

import functools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.spatial
from jaxtyping import Float, Int

from keepout.core.errors import MeshError
from keepout.core.geometry.target import part_labels, read_surface, weld
from keepout.core.kept import digest

_MOST_PLANES = 4096
"""Of all parts together, each counted as if it had as many as the one with the most."""
_HALF_SHEET = 1e-3
"""Metres by which a flat part is made thicker to every side."""


@dataclass(frozen=True)
class Hull:
    """A convex body.

    Attributes:
        corners: its vertices, m.
        faces: triangles between them, whose order says nothing of their side.
        normals: outward unit normals of its planes.
        offsets: of these planes, m: a point p is in the body where no normal · p is above its offset.

    """

    corners: Float[np.ndarray, "corners 3"]
    faces: Int[np.ndarray, "faces 3"]
    normals: Float[np.ndarray, "planes 3"]
    offsets: Float[np.ndarray, "planes"]


@dataclass(frozen=True, eq=False)
class Hulls:
    """The parts of a mesh, and its file's digest."""

    parts: tuple[Hull, ...]
    sha256: str

    @property
    def planes(self) -> int:
        """Of all parts together, each counted as if it had as many as the one with the most."""
        return len(self.parts) * max(len(hull.offsets) for hull in self.parts)

    @property
    def surface(self) -> tuple[Float[np.ndarray, "corners 3"], Int[np.ndarray, "faces 3"]]:
        """The corners of all parts, m, and the triangles between them."""
        begins = np.cumsum([0, *(len(hull.corners) for hull in self.parts)])[:-1]
        faces = [hull.faces + begin for hull, begin in zip(self.parts, begins, strict=True)]
        return np.concatenate([hull.corners for hull in self.parts]), np.concatenate(faces)


def hulls_of(file: str, units: str | None) -> Hulls:
    """Give the convex hull of each part of a mesh file, of triangles that hang together.

    A part that is flatter than 2 mm is made 2 mm thicker.

    Args:
        file: of the mesh; a point cloud is none.
        units: of its numbers; None: as the file says.

    Raises:
        MeshError: the file cannot be read, or there are too many planes.

    """
    try:
        found = digest(Path(file).read_bytes())
    except OSError as error:
        raise MeshError(f"cannot be read ({error.strerror})") from None
    return _hulls(file, units, found)


@functools.lru_cache(maxsize=16)
def _hulls(file: str, units: str | None, sha256: str) -> Hulls:
    surface = read_surface(Path(file), units=units, scale=None, drop_stray=False, thickness=None)
    part = part_labels(weld(surface.vertices, surface.faces))
    parts = tuple(_hull(surface.vertices[np.unique(surface.faces[part == k])]) for k in range(int(part.max()) + 1))
    found = Hulls(parts, sha256)
    if found.planes > _MOST_PLANES:
        raise MeshError(
            f"{len(parts)} parts, whose hulls have up to {found.planes // len(parts)} planes: {found.planes} together, "
            f"and at most {_MOST_PLANES} are flown; give a simpler mesh"
        )
    return found


def _hull(points: Float[np.ndarray, "n 3"]) -> Hull:
    # Rounding makes a thin hull of a sheet that is turned, whose planes would go on far beside it.
    spread = points - points.mean(axis=0)
    across = np.ptp(spread @ np.linalg.svd(spread, full_matrices=False)[2][-1])
    if len(points) < 4 or across < 2.0 * _HALF_SHEET:
        about = _HALF_SHEET * np.array(np.meshgrid(*3 * [(-1.0, 1.0)])).reshape(3, -1).T
        points = (points[:, None] + about).reshape(-1, 3)
    found = scipy.spatial.ConvexHull(points)
    # Triangles of one plane have its equation to the last digits or so; one of them is enough.
    _, first = np.unique(found.equations.round(9), axis=0, return_index=True)
    normals, offsets = found.equations[first, :3], -found.equations[first, 3]
    corner, faces = np.unique(found.simplices, return_inverse=True)
    # No corner is outside, however its planes were rounded.
    offsets = np.maximum(offsets, (points[corner] @ normals.T).max(axis=0))
    return Hull(points[corner], faces.reshape(-1, 3), normals, offsets)
