"""The surface {f̃ = level} of a field as triangles and how far it lies from the target's, and volumes.

An octree finds the cells that the level set can meet; f̃ is evaluated at their corners only, and marching cubes
(Lewiner et al. 2003, scikit-image) runs over them slab by slab. A long target is so cut finely in little memory.

Volumes compare what a field keeps a chaser out of with what the target itself does, its hull and its ellipsoid. For a
chaser of radius R the exact contact solid holds every point at distance R or less from the triangles, and what is
sealed off from the outside; the learned one is {f̃ ≤ R + e_h}. Both are measured on one octree: cells that lie wholly in
or wholly out count exactly, and the smallest ones by one random point each (stratified, so unbiased however thin the
parts are).
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.spatial
from jaxtyping import Bool, Float, Int
from scipy.special import elliprg
from skimage import measure

from keepout.core.errors import FieldError, MeshError
from keepout.core.fields.field import Field, values, values_and_gradients
from keepout.core.geometry.distance import Distance, ExactDistance, Points
from keepout.core.geometry.level_set import surface_points
from keepout.core.geometry.octree import SQRT3, refine
from keepout.core.geometry.offset_solid import OffsetSolid
from keepout.core.progress import Progress, silent

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


class _Around(NamedTuple):
    """The cube of an octree about a target, and the box of what lies within some room of it, metres."""

    lower: Float[np.ndarray, "3"]
    upper: Float[np.ndarray, "3"]
    origin: Float[np.ndarray, "3"]
    side: float
    depth: int

    @classmethod
    def of(cls, distance: Distance, room: float, leaf: float) -> "_Around":
        extent = float((distance.upper - distance.lower).max()) + 2.0 * room
        depth = max(1, int(np.ceil(np.log2(extent / leaf))))
        side = leaf * 2.0**depth
        origin = 0.5 * (distance.lower + distance.upper) - 0.5 * side
        return cls(distance.lower - room, distance.upper + room, origin, side, depth)

    def reached(self, centres: Points, half_width: float) -> Bool[np.ndarray, "n"]:
        """Say which cells reach into the box."""
        return np.asarray(((centres + half_width > self.lower) & (centres - half_width < self.upper)).all(axis=1))


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
    around = _Around.of(distance, max(level, 0.0) + 1.0, spacing)

    def visit(centres: Points, half_width: float, _: int) -> tuple[Bool[np.ndarray, "n"], tuple[Bool[np.ndarray, "n"]]]:
        meets = np.abs(values(field, centres) - level) <= steepest * SQRT3 * half_width
        # Nothing is known of the target outside its own surroundings.
        meets &= around.reached(centres, half_width)
        return meets, (meets,)

    progress(0.0, "cells of the surface")
    cells, (meets,) = refine(around.origin, around.side, around.depth, visit, 1)
    index = cells.index[meets & (cells.level == around.depth)].astype(np.int64)
    index = index[np.argsort(index[:, 0], kind="stable")]
    all_vertices, all_faces, count = [], [], 0
    slab = index[:, 0] // _SLAB
    starts = np.flatnonzero(np.diff(slab, prepend=-1))
    for place, (start, end) in enumerate(zip(starts, [*starts[1:], len(index)])):
        progress((place + 1) / (len(starts) + 1), f"slab {place + 1} of {len(starts)}")
        vertices, faces = _marching_cubes(field, index[start:end], around.origin, spacing, level)
        all_vertices.append(vertices)
        all_faces.append(faces + count)
        count += len(vertices)
    if count == 0:
        raise FieldError(f"level {level:g} m: the field takes it nowhere near the target")
    return Surface(np.concatenate(all_vertices), np.concatenate(all_faces), spacing)


def _marching_cubes(
    field: Field, cells: Int[np.ndarray, "m 3"], origin: Float[np.ndarray, "3"], spacing: float, level: float
) -> tuple[Points, Int[np.ndarray, "f 3"]]:
    """Vertices and faces of the level set in some cells of a grid."""
    low = cells.min(axis=0)
    i, j, k = (cells - low).T
    shape = (cells.max(axis=0) - low + 2).tolist()
    wanted = np.zeros(shape, dtype=bool)
    for a, b, c in np.ndindex(2, 2, 2):
        wanted[i + a, j + b, k + c] = True
    nodes = np.argwhere(wanted)
    volume = np.full(shape, np.float32(level + 1e6))
    volume[wanted] = values(field, origin + (nodes + low) * spacing)
    # scikit-image's mask belongs to the far corner of a cell.
    mask = np.zeros(shape, dtype=bool)
    mask[i + 1, j + 1, k + 1] = True
    inside = volume[wanted] < level
    if inside.all() or not inside.any():
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    vertices, faces, _, _ = measure.marching_cubes(
        volume, level, spacing=(spacing,) * 3, gradient_direction="descent", mask=mask, allow_degenerate=False
    )
    return vertices.astype(np.float64) + origin + low * spacing, faces.astype(np.int64)


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


class Ellipsoid(NamedTuple):
    """{x : (x - centre)ᵀ matrix (x - centre) ≤ 1}."""

    centre: Float[np.ndarray, "3"]
    matrix: Float[np.ndarray, "3 3"]

    @property
    def semi_axes(self) -> Float[np.ndarray, "3"]:
        """Semi-axes in falling order, metres."""
        return np.sort(1.0 / np.sqrt(np.linalg.eigvalsh(self.matrix)))[::-1]

    @property
    def volume(self) -> float:
        """Cubic metres."""
        return float(4.0 / 3.0 * np.pi / np.sqrt(np.linalg.det(self.matrix)))


@dataclasses.dataclass(frozen=True)
class Volumes:
    """Cubic metres from which each shape keeps the centre of a chaser of one radius.

    Attributes:
        chaser_radius: R, metres.
        level: metres; the learned solid is {f̃ ≤ level}.
        learned: its volume.
        contact: of the exact contact solid; for R below the offset, of the offset solid.
        iou: volume of the intersection of these two over that of their union.
        hull: of the target's convex hull, grown by R.
        ellipsoid: of the smallest ellipsoid round the target, grown by R.
        standard_error: of `learned` and `contact`, from the octree's smallest cells.

    """

    chaser_radius: float
    level: float
    learned: float
    contact: float
    iou: float
    hull: float
    ellipsoid: float
    standard_error: float


def measure_volumes(
    field: Field,
    solid: OffsetSolid,
    levels: Sequence[tuple[float, float]],
    *,
    steepest: float,
    leaf: float | None = None,
    seed: int = 0,
    progress: Progress = silent,
) -> list[Volumes]:
    """Measure the learned and the exact contact solid for each (chaser radius, level) in metres.

    Args:
        field: the field.
        solid: the target's offset solid.
        levels: pairs (R, level).
        steepest: a bound of ‖∇f̃‖, by which cells count as wholly in or out.
        leaf: side of the smallest cells, metres; default twice `default_spacing`.
        seed: of the random points.
        progress: called as the octree deepens.

    Raises:
        FieldError: no levels, a negative radius, a leaf that is not positive, or a target that is not a mesh.

    """
    distance = solid.distance
    leaf = 2.0 * default_spacing(distance) if leaf is None else leaf
    if not isinstance(distance, ExactDistance):
        raise FieldError("volumes are measured against a mesh, not a point cloud")
    if not levels or min(radius for radius, _ in levels) < 0.0:
        raise FieldError(f"levels {list(levels)}: at least one (radius, level) is needed, radii 0 m or more")
    if not leaf > 0.0:
        raise FieldError(f"leaf {leaf:g} m: it must be positive")
    generator = np.random.default_rng(seed)
    radii, heights = np.array(levels, dtype=np.float64).T
    around = _Around.of(distance, float(max(radii.max(), heights.max(), 0.0)) + 1.0, leaf)

    def visit(centres: Points, half_width: float, level: int) -> tuple[Bool[np.ndarray, "n"], tuple[np.ndarray, ...]]:
        progress(0.9 * (level / around.depth) ** 2, f"cells of {2.0 * half_width:.2g} m")
        last = level == around.depth
        points = centres + (generator.uniform(-half_width, half_width, size=centres.shape) if last else 0.0)
        learned = values(field, points)[:, None] - heights
        # min(d - R, g), 1-Lipschitz: not positive where a ball of radius R touches, or in the offset solid.
        contact = np.minimum(distance.distance(points)[:, None] - radii, solid.signed_distance(points)[:, None])
        reach = SQRT3 * half_width
        split = (np.abs(learned) <= steepest * reach).any(axis=1) | (np.abs(contact) <= reach).any(axis=1)
        return split & around.reached(centres, half_width), (learned <= 0.0, contact <= 0.0)

    cells, (learned, contact) = refine(around.origin, around.side, around.depth, visit, 2)
    cube = (2.0 * cells.half_width) ** 3
    both, either = cube @ (learned & contact), cube @ (learned | contact)
    # A random point of a leaf is in or out; its variance is at most a quarter of the leaf's volume squared.
    mixed = int((cells.level == around.depth).sum())
    corners = distance.vertices[np.unique(distance.faces)]
    hull, ellipsoid = scipy.spatial.ConvexHull(corners), smallest_ellipsoid(corners, 1e-5)
    progress(1.0, "")
    return [
        Volumes(
            chaser_radius=float(radius),
            level=float(height),
            learned=float(cube @ learned[:, i]),
            contact=float(cube @ contact[:, i]),
            iou=float(both[i] / either[i]) if either[i] > 0.0 else 0.0,
            hull=grown_hull_volume(hull, float(radius)),
            ellipsoid=grown_ellipsoid_volume(ellipsoid, float(radius)),
            standard_error=float(0.5 * np.sqrt(mixed) * leaf**3),
        )
        for i, (radius, height) in enumerate(zip(radii, heights))
    ]


def grown_hull_volume(hull: scipy.spatial.ConvexHull, radius: float) -> float:
    """Volume in cubic metres of all points within `radius` of a convex hull: Steiner's formula V + A R + M R² + 4/3πR³.

    M is half the sum over the edges of length times the angle between the outward normals on its two sides.
    """
    curved = 0.0
    for facet, neighbours in enumerate(hull.neighbors):
        for opposite, neighbour in enumerate(neighbours):
            if neighbour > facet:
                ends = hull.points[np.delete(hull.simplices[facet], opposite)]
                cosine = float(hull.equations[facet, :3] @ hull.equations[neighbour, :3])
                curved += 0.5 * float(np.linalg.norm(ends[1] - ends[0])) * float(np.arccos(np.clip(cosine, -1.0, 1.0)))
    return float(hull.volume + hull.area * radius + curved * radius**2 + 4.0 / 3.0 * np.pi * radius**3)


def grown_ellipsoid_volume(ellipsoid: Ellipsoid, radius: float) -> float:
    """Volume in cubic metres of all points within `radius` of an ellipsoid, by Steiner's formula.

    With Carlson's symmetric integral, A = 4π abc R_G(a⁻², b⁻², c⁻²) and M = 4π R_G(a², b², c²), the integral of the
    support function over all directions (DLMF 19.16.3, 19.33.1).
    """
    a, b, c = ellipsoid.semi_axes
    area = 4.0 * np.pi * a * b * c * float(elliprg(a**-2, b**-2, c**-2))
    curved = 4.0 * np.pi * float(elliprg(a**2, b**2, c**2))
    return float(ellipsoid.volume + area * radius + curved * radius**2 + 4.0 / 3.0 * np.pi * radius**3)


def convex_hull(points: Points) -> tuple[Float[np.ndarray, "corners 3"], float]:
    """Corners (n, 3) of the convex hull, and its volume in cubic metres (Qhull).

    Raises:
        MeshError: fewer than four points, or all in one plane.

    """
    try:
        hull = scipy.spatial.ConvexHull(points)
    except (scipy.spatial.QhullError, ValueError) as cause:
        raise MeshError(f"convex hull: {len(points)} points span no volume; at least four not in a plane do") from cause
    return points[hull.vertices], float(hull.volume)


def smallest_ellipsoid(points: Points, tolerance: float = 1e-7) -> Ellipsoid:
    """Find the ellipsoid of least volume round all points: Khachiyan's algorithm with Todd and Yildirim's away steps.

    Its volume is at most (1 + tolerance)^1.5 of the least; it is scaled so that no point lies outside.

    Raises:
        MeshError: points without volume, or no convergence in 100 000 steps.

    """
    corners, _ = convex_hull(points)
    middle = corners.mean(axis=0)
    scale = float(np.abs(corners - middle).max())
    lifted = np.column_stack([(corners - middle) / scale, np.ones(len(corners))])
    weights = np.full(len(corners), 1.0 / len(corners))
    for _ in range(100_000):
        moments = lifted.T @ (weights[:, None] * lifted)
        spread = np.einsum("ij,ij->i", lifted @ np.linalg.inv(moments), lifted)
        far, near = int(spread.argmax()), int(np.where(weights > 0.0, spread, np.inf).argmin())
        if spread[far] - 4.0 <= 4.0 * tolerance and 4.0 - spread[near] <= 4.0 * tolerance:
            break
        if spread[far] - 4.0 >= 4.0 - spread[near]:
            chosen, step = far, (spread[far] - 4.0) / (4.0 * (spread[far] - 1.0))
        else:
            chosen = near
            step = max((spread[near] - 4.0) / (4.0 * (spread[near] - 1.0)), -weights[near] / (1.0 - weights[near]))
        weights *= 1.0 - step
        weights[chosen] = max(weights[chosen] + step, 0.0)
    else:
        raise MeshError(f"ellipsoid: no convergence to {tolerance} in 100000 steps; a tolerance of 1e-6 is easier")
    flat = lifted[:, :3]
    centre = weights @ flat
    covariance = flat.T @ (weights[:, None] * flat) - np.outer(centre, centre)
    matrix = np.linalg.inv(covariance) / 3.0
    matrix /= np.einsum("ij,jk,ik->i", flat - centre, matrix, flat - centre).max()
    return Ellipsoid(centre * scale + middle, matrix / scale**2)
