"""Target and level surfaces as they are drawn: not too many triangles, how open each is, and a field's own normals."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from keepout.core.compiled.kept_executables import Arrays, kept_arrays
from keepout.core.fields.field import Field, values_and_gradients
from keepout.core.geometry.distance import Distance
from keepout.core.geometry.target import Target
from keepout.core.progress import Progress, silent

MOST_TRIANGLES = 40_000
"""A browser without a graphics card still turns a mesh of so many several times a second."""
_REACHES = (0.01, 0.04)
"""Shares of the target's size over which a triangle looks for what shades it."""
_COARSER = 1.25
_CELLS_ALONG = 160
"""Cells of the marching cubes along the target's longest side, where that is fine enough."""
_FINEST = 400
"""Cells along it at most."""
_WELD = 1e-4
"""Metres within which corners are one: the seams between the slabs of the marching cubes."""
_FLATTENED = 0.04
"""Share of a cell by which fewer triangles may lie off the surface that was cut."""


@dataclass(frozen=True, eq=False)
class DrawnBody:
    """A target as it is drawn, metres.

    Attributes:
        vertices: of the triangles, or the middles of a point cloud's balls.
        faces: the triangles; none of a point cloud.
        openness: 0 to 1 for each triangle.
        triangles: how many the mesh has.
        remark: what the drawing leaves out of the target, as a sentence; empty where it is drawn whole.

    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    openness: Float[np.ndarray, "f"]
    triangles: int
    remark: str


def drawn_body(target: Target) -> DrawnBody:
    """Give a target's mesh as it is drawn; a mesh of very many triangles is drawn with fewer."""
    used, faces = np.unique(target.faces, return_inverse=True)
    vertices, faces = target.vertices[used], faces.reshape(-1, 3)
    if target.ball_radius == 0.0:
        side = float(np.ptp(vertices, axis=0).max()) / 1000.0
        vertices, faces, _ = fewer(vertices, faces, MOST_TRIANGLES, side=side)
        drawn, whole, kind = len(faces), len(target.faces), "triangles"
    else:
        chosen = np.linspace(0, len(vertices) - 1, min(len(vertices), MOST_TRIANGLES)).astype(int)
        vertices, faces = vertices[chosen], np.empty((0, 3), int)
        drawn, whole, kind = len(vertices), len(used), "points"
    remark = f"The target is drawn with {drawn:,} of its {whole:,} {kind}; distances are to all of it."
    remark = remark if drawn < whole else ""
    return DrawnBody(vertices, faces, _openness(target, vertices, faces), len(target.faces), remark)


def fewer(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], most: int, *, side: float
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "g 3"], Int[np.ndarray, " f"]]:
    """Move vertices of one cell of a grid to their mean, the grid coarser until few enough triangles are left.

    Args:
        vertices: m.
        faces: of a mesh; one that has no more than `most` is given back as it is.
        most: triangles that may be left.
        side: of the first grid's cells, m.

    Returns:
        Vertices, faces, and which of these faces each given one became, -1: none.

    """
    whole, became = (vertices, faces), np.arange(len(faces))
    while len(faces) > most:
        _, place, count = np.unique(
            np.floor(whole[0] / side).astype(np.int64), axis=0, return_inverse=True, return_counts=True
        )
        vertices = np.zeros((len(count), 3))
        np.add.at(vertices, place.reshape(-1), whole[0])
        vertices /= count[:, None]
        faces = place.reshape(-1)[whole[1]]
        kept = np.flatnonzero(_have_corners(faces))
        _, once, same = np.unique(np.sort(faces[kept], axis=1), axis=0, return_index=True, return_inverse=True)
        order = np.argsort(once)
        became = np.full(len(whole[1]), -1)
        became[kept] = np.argsort(order)[same.reshape(-1)]
        faces = faces[kept[once[order]]]
        side *= _COARSER
    return vertices, faces, became


def _have_corners(faces: Int[np.ndarray, "f 3"]) -> Bool[np.ndarray, " f"]:
    """Which triangles have three corners."""
    return (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])


def _openness(target: Target, vertices: np.ndarray, faces: np.ndarray) -> Float[np.ndarray, "f"]:
    """Say how far what stands opposite is from each triangle, on its freer side: 1 in the open, to 0 in a corner."""
    if len(faces) == 0:
        return np.ones(0)
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    middle = corners.mean(axis=1)
    size = float(np.ptp(target.vertices, axis=0).max())
    openness = np.ones(len(faces))
    for reach in _REACHES:
        sides = [
            target.distance.distance(middle + sign * reach * size * normal) / (reach * size) for sign in (1.0, -1.0)
        ]
        openness *= np.clip(np.maximum(*sides), 0.0, 1.0)
    return openness


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
    from keepout.flights.surface import extract_surface  # takes long to import: only where a surface is cut

    cut = extract_surface(field, distance, level, steepest=steepest, spacing=spacing, progress=progress)
    vertices, faces, within = _simplified(cut.vertices, cut.faces, _FLATTENED * spacing)
    _, gradient = values_and_gradients(field, vertices)
    length = np.linalg.norm(gradient, axis=1, keepdims=True)
    normals = gradient / np.where(length > 0.0, length, 1.0)
    return {"vertices": vertices, "normals": normals, "faces": faces, "within": np.asarray(within)}


def _simplified(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], tolerance: float
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "g 3"], float]:
    """Give a surface with fewer triangles, and how far it may lie off; one that is not closed stays as it is."""
    import manifold3d

    _, first, place = np.unique(
        np.rint(vertices / _WELD).astype(np.int64), axis=0, return_index=True, return_inverse=True
    )
    welded, joined = vertices[first], place.reshape(-1)[faces]
    joined = joined[_have_corners(joined)]
    mesh = manifold3d.Mesh(welded.astype(np.float32), joined.astype(np.uint32))
    mesh.merge()
    solid = manifold3d.Manifold(mesh)
    if solid.status() != manifold3d.Error.NoError:
        return welded, joined, 0.0
    simple = solid.simplify(tolerance).to_mesh()
    return simple.vert_properties[:, :3].astype(np.float64), simple.tri_verts.astype(np.int64), tolerance
