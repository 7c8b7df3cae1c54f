"""Level surfaces of fields as they are drawn: cut, joined, made of fewer triangles, with the field's own normals."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from keepout.core.compiled.kept_arrays import Arrays, kept_arrays
from keepout.core.fields.field import Field, values_and_gradients
from keepout.core.geometry.distance import Distance
from keepout.core.progress import Progress, silent

_CELLS_ALONG = 160
"""Cells of the marching cubes along the target's longest side, where that is fine enough."""
_FINEST = 400
"""Cells along it at most."""
_WELD = 1e-4
"""Metres within which corners are one: the seams between the slabs of the marching cubes."""
_FLATTENED = 0.04
"""Share of a cell by which fewer triangles may lie off the surface that was cut."""


@dataclass(frozen=True, eq=False)
class DrawnSurface:
    """A level surface as triangles: vertices in metres, unit normals towards rising f̃, `within` metres of the cut one.

    `spacing` (m) is that of the marching cubes that cut it.
    """

    vertices: Float[np.ndarray, "v 3"]
    normals: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    spacing: float
    within: float


def drawn_surface(
    field: Field, distance: Distance, level: float, *, steepest: float, progress: Progress = silent
) -> DrawnSurface:
    """Triangulate {f̃ = level} around a target, with few triangles where it is flat.

    A surface that was cut before is taken from the folder of kept programs.

    Args:
        field: the field.
        distance: of the target, which says where to look.
        level: m.
        steepest: a bound of ‖∇f̃‖.
        progress: called as it is cut.

    Raises:
        FieldError: the field does not take this level near the target.

    """
    size = float((distance.upper - distance.lower).max())
    # A sheet no thicker than twice the level is to be cut at all, so cells are no larger than the level.
    spacing = min(size / _CELLS_ALONG, max(abs(level), size / _FINEST))

    def cut() -> Arrays:
        return _cut(field, distance, level, steepest, spacing, progress)

    numbers = (float(level), float(steepest), spacing, _WELD, _FLATTENED)
    made_from = (field, distance.lower, distance.upper, numbers)
    drawn = kept_arrays("surface", made_from, cut, libraries=("scikit-image", "manifold3d"))
    return DrawnSurface(drawn["vertices"], drawn["normals"], drawn["faces"], spacing, float(drawn["within"]))


def _cut(field: Field, distance: Distance, level: float, steepest: float, spacing: float, progress: Progress) -> Arrays:
    from keepout.core.measures.surface import extract_surface  # takes long to import: only where a surface is cut

    cut = extract_surface(field, distance, level, steepest=steepest, spacing=spacing, progress=progress)
    vertices, faces, within = _fewer(cut.vertices, cut.faces, _FLATTENED * spacing)
    _, gradient = values_and_gradients(field, vertices)
    length = np.linalg.norm(gradient, axis=1, keepdims=True)
    normals = gradient / np.where(length > 0.0, length, 1.0)
    return {"vertices": vertices, "normals": normals, "faces": faces, "within": np.asarray(within)}


def _fewer(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], tolerance: float
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "g 3"], float]:
    """Give a surface with fewer triangles, and how far it may lie off; one that is not closed stays as it is."""
    import manifold3d

    _, first, place = np.unique(
        np.rint(vertices / _WELD).astype(np.int64), axis=0, return_index=True, return_inverse=True
    )
    welded, joined = vertices[first], place.reshape(-1)[faces]
    joined = joined[(joined[:, 0] != joined[:, 1]) & (joined[:, 1] != joined[:, 2]) & (joined[:, 2] != joined[:, 0])]
    mesh = manifold3d.Mesh(welded.astype(np.float32), joined.astype(np.uint32))
    mesh.merge()
    solid = manifold3d.Manifold(mesh)
    if solid.status() != manifold3d.Error.NoError:
        return welded, joined, 0.0
    simple = solid.simplify(tolerance).to_mesh()
    return simple.vert_properties[:, :3].astype(np.float64), simple.tri_verts.astype(np.int64), tolerance
