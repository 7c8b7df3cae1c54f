"""A mesh cut into patches: its plane regions along a grid in each one's plane, into few convex pieces."""

import math

import numpy as np
from jaxtyping import Float, Int

from keepout.apps.inspection.seeing import clip, merge
from keepout.apps.inspection.seeing.flat import Regions, regions
from keepout.apps.inspection.seeing.patches import Patches
from keepout.apps.inspection.seeing.sides import closed_parts
from keepout.core.errors import InspectionError
from keepout.core.geometry.target import Target
from keepout.core.progress import Progress, silent

MOST_PATCHES = 3_000_000
"""More than these are refused: their corners alone take half a gigabyte."""
_LEAST_SHARE = 1e-11
"""Pieces below this share of a full cell's area are left out: they are what rounding leaves along the lines."""


def cut(target: Target, size: float, *, progress: Progress = silent) -> Patches:
    """Cut a target's surface into convex plane patches.

    Faces that hang together in one plane are taken as one region. A grid in that plane, along the region's longest
    border, cuts it into cells of at most `size`; the pieces of a cell are put together to as few convex patches as a
    greedy search finds. The areas of all patches sum to the area of the mesh.

    Args:
        target: the mesh; a point cloud has no surface to cut.
        size: edge of the cells, m.
        progress: told how far the work is.

    Raises:
        InspectionError: a point cloud, a mesh without area, a size that is not above 0, or more than `MOST_PATCHES`
            patches.

    """
    if target.ball_radius > 0.0:
        raise InspectionError(f"{target.name}: a point cloud has no surface to be seen; a mesh or a map has")
    if not 0.0 < size < math.inf:
        raise InspectionError(f"patch size is {size:g} m; it must be a number above 0")
    vertices, faces = np.asarray(target.vertices, dtype=np.float64), np.array(target.faces, dtype=np.int64)
    progress(0.0, "finding plane regions")
    closed, inward = closed_parts(vertices, faces)
    faces[inward] = faces[inward][:, ::-1]
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    face_areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    if not face_areas.sum() > 0.0:
        raise InspectionError(f"{target.name}: its {len(faces)} faces have no area; there is nothing to be seen")
    _refuse_many(target, size, float(face_areas.sum()) / size**2)
    found = regions(vertices, faces)
    progress(0.3, f"cutting {len(found.extent)} plane regions")
    return _patches(target, size, found, closed, vertices[faces], face_areas, progress)


def _patches(
    target: Target,
    size: float,
    found: Regions,
    closed: np.ndarray,
    triangles: Float[np.ndarray, "f 3 3"],
    face_areas: Float[np.ndarray, " f"],
    progress: Progress,
) -> Patches:
    cells = np.maximum(np.ceil(found.extent / size - 1e-9), 1.0).astype(np.int64)
    steps = found.extent / cells
    inside = np.maximum(found.region, 0)
    flat = np.einsum("fij,fkj->fki", found.axes[inside][:, :2], triangles - found.origin[inside][:, None])
    least = _LEAST_SHARE * size**2
    none = (np.empty((0, clip.PIECE_CORNERS, 2)), _whole(0), np.empty(0), _whole(0), _whole(0))
    flat = np.ascontiguousarray(flat)
    number = int(clip.pieces(flat, found.region, steps, cells, least, *none))
    _refuse_many(target, size, number / 8.0)  # pieces, of which several make a patch
    corners, counts = np.zeros((number, clip.PIECE_CORNERS, 2)), _whole(number)
    areas, cell, face = np.empty(number), _whole(number), _whole(number)
    clip.pieces(flat, found.region, steps, cells, least, corners, counts, areas, cell, face)
    progress(0.6, f"putting {number} pieces together")
    order = np.lexsort((cell, found.region[face]))
    corners, counts, areas, cell, face = corners[order], counts[order], areas[order], cell[order], face[order]
    # A face may lean in its region's plane: its pieces count with the area that they have on the mesh.
    in_plane = np.bincount(face, weights=areas, minlength=len(face_areas))
    true_areas = areas * face_areas[face] / in_plane[face]
    region = found.region[face]
    new = (
        np.concatenate([[True], (region[1:] != region[:-1]) | (cell[1:] != cell[:-1])]) if number else np.empty(0, bool)
    )
    begin = np.append(np.flatnonzero(new), number)
    kept = merge.merged(corners, counts, areas, true_areas, face, begin)
    _refuse_many(target, size, float(kept.sum()))
    patches = _placed(found, closed, corners[kept], counts[kept], true_areas[kept], face[kept], size)
    progress(1.0, f"{len(patches.areas)} patches")
    return patches


def _placed(
    found: Regions,
    closed: np.ndarray,
    flat: Float[np.ndarray, "n c 2"],
    counts: Int[np.ndarray, " n"],
    areas: Float[np.ndarray, " n"],
    faces: Int[np.ndarray, " n"],
    size: float,
) -> Patches:
    most = int(counts.max())
    last = np.minimum(np.arange(most), counts[:, None] - 1)
    flat = np.take_along_axis(flat, last[:, :, None], axis=1)
    x, y = flat[..., 0] - flat[:, :1, 0], flat[..., 1] - flat[:, :1, 1]
    wedge = x[:, :-1] * y[:, 1:] - x[:, 1:] * y[:, :-1]
    total = wedge.sum(axis=1)
    centre = flat[:, 0] + np.stack(
        [((x[:, :-1] + x[:, 1:]) * wedge).sum(axis=1), ((y[:, :-1] + y[:, 1:]) * wedge).sum(axis=1)], axis=1
    ) / (3.0 * total[:, None])
    region = found.region[faces]
    origin, axes = found.origin[region], found.axes[region]
    return Patches(
        corners=origin[:, None] + np.einsum("nkc,ncj->nkj", flat, axes[:, :2]),
        counts=counts,
        normals=np.ascontiguousarray(axes[:, 2]),
        areas=areas,
        centres=origin + np.einsum("nc,ncj->nj", centre, axes[:, :2]),
        faces=faces,
        counted=np.stack([np.ones(len(areas), dtype=bool), ~closed[faces]], axis=1).reshape(-1),
        size=float(size),
    )


def _refuse_many(target: Target, size: float, patches: float) -> None:
    if patches > MOST_PATCHES:
        raise InspectionError(
            f"{target.name}: patches of {size:g} m are at least {patches:.0f}; at most {MOST_PATCHES} are taken: "
            f"a size of about {size * math.sqrt(patches / MOST_PATCHES) * 1.2:.2g} m would do"
        )


def _whole(count: int) -> Int[np.ndarray, " n"]:
    return np.zeros(count, dtype=np.int64)
