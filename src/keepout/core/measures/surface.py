"""The surface {f̃ = level} of a field as triangles, and how far it lies from the surface of the target.

An octree finds the cells that the level set can meet; f̃ is evaluated at their corners only, and marching cubes
(Lewiner et al. 2003, scikit-image) runs over them slab by slab. A long target is so cut finely in little memory.
"""

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int
from skimage import measure

from keepout.core.errors import FieldError
from keepout.core.fields.evaluate import values, values_and_gradients
from keepout.core.fields.field import Field
from keepout.core.geometry.distance import Distance, ExactDistance
from keepout.core.geometry.level_set import surface_points
from keepout.core.geometry.octree import SQRT3, refine
from keepout.core.geometry.offset_solid import OffsetSolid
from keepout.core.progress import Progress, silent

Points = Float[np.ndarray, "n 3"]

_SURFACE_CELLS = 4e5
"""The default spacing makes about this many cells of the target's one-sided surface: a few seconds for a small
network."""
FINEST_SPACING = 0.03
"""Metres. The default spacing is no less: a field is trained at an offset of this size."""
_SLAB = 32
"""Cells that marching cubes sees at once along the first axis."""
_SLOPE_ALLOWANCE = 1.2
DEEPLY_HIDDEN = 0.1
"""Metres. Pieces of a level set that lie deeper than this inside the sealed solid concern no chaser."""


@dataclasses.dataclass(frozen=True)
class Surface:
    """A triangle mesh with its normals outward, towards rising f̃.

    Attributes:
        vertices: (V, 3) metres.
        faces: (F, 3) vertex indices. The slabs are not welded: vertices on their seams occur twice.
        spacing: of the grid it was cut from, metres.

    """

    vertices: Points
    faces: Int[np.ndarray, "f 3"]
    spacing: float


def default_spacing(distance: Distance) -> float:
    """Grid spacing in metres that resolves a target of this area in seconds."""
    return max(FINEST_SPACING, float(np.sqrt(distance.area / _SURFACE_CELLS)))


def steepest_slope(field: Field, distance: Distance, *, count: int = 20_000, seed: int = 0) -> float:
    """Return the largest ‖∇f̃‖ found on and near the target's surface, plus a fifth: enough to measure with."""
    generator = np.random.default_rng(seed)
    points = surface_points(distance, count, generator, by_area=0.5)
    points[::2] += generator.normal(scale=0.2, size=points[::2].shape)
    return _SLOPE_ALLOWANCE * float(np.linalg.norm(values_and_gradients(field, points)[1], axis=1).max())


def extract_surface(
    field: Field,
    distance: Distance,
    level: float,
    *,
    steepest: float,
    spacing: float | None = None,
    progress: Progress = silent,
) -> Surface:
    """Triangulate {f̃ = level} around a target.

    Args:
        field: the field.
        distance: of the target, which says where to look: level + 1 m around its bounding box.
        level: metres.
        steepest: a bound of ‖∇f̃‖, by which cells are left out. Pieces may be missed where it is exceeded.
        spacing: of the grid, metres; default `default_spacing`. Features thinner than it are lost.
        progress: called as the slabs are done.

    Raises:
        FieldError: a spacing that is not positive, or a level that the field does not take there.

    """
    spacing = default_spacing(distance) if spacing is None else spacing
    if not spacing > 0.0:
        raise FieldError(f"spacing {spacing:g} m: it must be positive")
    room = max(level, 0.0) + 1.0
    extent = float((distance.upper - distance.lower).max()) + 2.0 * room
    depth = max(1, int(np.ceil(np.log2(extent / spacing))))
    side = spacing * 2.0**depth
    origin = 0.5 * (distance.lower + distance.upper) - 0.5 * side

    def visit(centres: Points, half_width: float, _: int) -> tuple[Bool[np.ndarray, "n"], tuple[Bool[np.ndarray, "n"]]]:
        meets = np.abs(values(field, centres) - level) <= steepest * SQRT3 * half_width
        # Nothing is known of the target outside its own surroundings.
        meets &= ((centres + half_width > distance.lower - room) & (centres - half_width < distance.upper + room)).all(
            axis=1
        )
        return meets, (meets,)

    progress(0.0, "cells of the surface")
    cells, (meets,) = refine(origin, side, depth, visit, 1)
    index = cells.index[meets & (cells.level == depth)].astype(np.int64)
    mesh = _marching_cubes(lambda points: values(field, points), index, origin, spacing, level, progress)
    if mesh is None:
        raise FieldError(f"level {level:g} m: the field takes it nowhere near the target")
    return Surface(*mesh, spacing)


def _marching_cubes(
    function: Callable[[Points], Float[np.ndarray, "n"]],
    index: Int[np.ndarray, "cells 3"],
    origin: Float[np.ndarray, "3"],
    spacing: float,
    level: float,
    progress: Progress,
) -> tuple[Points, Int[np.ndarray, "f 3"]] | None:
    """Vertices and faces of the level set in the chosen cells of a grid."""
    all_vertices, all_faces, count = [], [], 0
    index = index[np.argsort(index[:, 0], kind="stable")]
    slab = index[:, 0] // _SLAB
    starts = np.flatnonzero(np.diff(slab, prepend=-1))
    for place, (start, end) in enumerate(zip(starts, [*starts[1:], len(index)])):
        progress((place + 1) / (len(starts) + 1), f"slab {place + 1} of {len(starts)}")
        cells = index[start:end]
        low = cells.min(axis=0)
        i, j, k = (cells - low).T
        shape = (cells.max(axis=0) - low + 2).tolist()
        wanted = np.zeros(shape, dtype=bool)
        for a in (0, 1):
            for b in (0, 1):
                for c in (0, 1):
                    wanted[i + a, j + b, k + c] = True
        nodes = np.argwhere(wanted)
        volume = np.full(shape, np.float32(level + 1e6))
        volume[wanted] = function(origin + (nodes + low) * spacing)
        # scikit-image's mask belongs to the far corner of a cell.
        mask = np.zeros(shape, dtype=bool)
        mask[i + 1, j + 1, k + 1] = True
        inside = volume[wanted] < level
        if inside.all() or not inside.any():
            continue
        vertices, faces, _, _ = measure.marching_cubes(
            volume, level, spacing=(spacing,) * 3, gradient_direction="descent", mask=mask, allow_degenerate=False
        )
        all_vertices.append(vertices.astype(np.float64) + origin + low * spacing)
        all_faces.append(faces.astype(np.int64) + count)
        count += len(vertices)
    if count == 0:
        return None
    return np.concatenate(all_vertices), np.concatenate(all_faces)


@dataclasses.dataclass(frozen=True)
class SurfaceDistance:
    """Distances between the learned surface and the part of the target's surface that the exterior sees, metres.

    Attributes:
        level: of the learned surface {f̃ = level}.
        learned_to_target: mean over the learned surface of the exact distance to the target.
        learned_to_target_95: its 95th percentile by area.
        target_to_learned: mean over the target's visible surface of the exact distance to the learned triangles.
        chamfer: the mean of these two.
        learned_to_target_maximum: the largest of the first, over the vertices of the learned surface.
        target_to_learned_maximum: the largest of the second, over the samples.
        hausdorff: the larger of these two.
        hidden_share: of the learned surface's area that lies deep inside the sealed solid; it is left out.
        spacing: of the marching cubes.
        count: samples on each surface.

    """

    level: float
    learned_to_target: float
    learned_to_target_95: float
    target_to_learned: float
    chamfer: float
    learned_to_target_maximum: float
    target_to_learned_maximum: float
    hausdorff: float
    hidden_share: float
    spacing: float
    count: int


def visible_points(solid: OffsetSolid, count: int, generator: np.random.Generator) -> Points:
    """Points of the target's surface that are nearest to some exterior point just off it; at most `count`."""
    distance = solid.distance
    off = 1.01 * 0.5 * (solid.envelope + solid.offset)  # hidden cells reach no farther past a surface
    found: list[Points] = []
    for _ in range(20):
        start = surface_points(distance, count, generator)
        direction = generator.normal(size=start.shape)
        points = start + off * direction / np.linalg.norm(direction, axis=1, keepdims=True)
        for _ in range(3):
            d, gradient = distance.distance_and_gradient(points)
            points = points + (1.001 * off - d)[:, None] * gradient
        d, closest, _ = distance.closest(points)
        found.append(closest[(d > off) & solid.is_exterior(points)])
        if sum(len(part) for part in found) >= count:
            break
    return np.concatenate(found)[:count]


def surface_distance(
    surface: Surface, solid: OffsetSolid, level: float, *, count: int = 200_000, seed: int = 0
) -> SurfaceDistance:
    """Measure how far a learned surface and the target's visible surface lie apart, both ways.

    Raises:
        FieldError: all of the learned surface is hidden, or all of the target's.

    """
    generator = np.random.default_rng(seed)
    learned = ExactDistance(surface.vertices, surface.faces)
    samples = surface_points(learned, count, generator)
    open_ = solid.signed_distance(samples) > -DEEPLY_HIDDEN
    corners = surface.vertices[solid.signed_distance(surface.vertices) > -DEEPLY_HIDDEN]
    visible = visible_points(solid, count, generator)
    if not open_.any() or len(visible) == 0:
        raise FieldError(f"level {level:g} m: no part of the learned surface, or of the target, faces the outside")
    out = solid.distance.distance(samples[open_])
    back = learned.distance(visible)
    farthest_out = float(max(solid.distance.distance(corners).max(initial=0.0), out.max()))
    return SurfaceDistance(
        level=float(level),
        learned_to_target=float(out.mean()),
        learned_to_target_95=float(np.quantile(out, 0.95)),
        target_to_learned=float(back.mean()),
        chamfer=float(0.5 * (out.mean() + back.mean())),
        learned_to_target_maximum=farthest_out,
        target_to_learned_maximum=float(back.max()),
        hausdorff=max(farthest_out, float(back.max())),
        hidden_share=float(1.0 - open_.mean()),
        spacing=surface.spacing,
        count=count,
    )
