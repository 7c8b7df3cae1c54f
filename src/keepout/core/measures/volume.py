"""Volumes: what a field keeps a chaser out of, against what the target itself does, its hull and its ellipsoid.

For a chaser of radius R the exact contact solid holds every point at distance R or less from the triangles, and what
is sealed off from the outside; the learned one is {f̃ ≤ R + e_h}. Both are measured on one octree: cells that lie wholly
in or wholly out count exactly, and the smallest ones by one random point each (stratified, so unbiased however thin
the parts are).
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.spatial
from jaxtyping import Bool, Float
from scipy.special import elliprg

from keepout.core.errors import FieldError, MeshError
from keepout.core.fields.evaluate import values
from keepout.core.fields.field import Field
from keepout.core.geometry.distance import ExactDistance
from keepout.core.geometry.octree import SQRT3, refine
from keepout.core.geometry.offset_solid import OffsetSolid
from keepout.core.measures.surface import default_spacing
from keepout.core.progress import Progress, silent

Points = Float[np.ndarray, "n 3"]


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
        leaf: side of the smallest cells, metres; default twice `surface.default_spacing`.
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
    room = float(max(radii.max(), heights.max(), 0.0)) + 1.0
    extent = float((distance.upper - distance.lower).max()) + 2.0 * room
    depth = max(1, int(np.ceil(np.log2(extent / leaf))))
    side = leaf * 2.0**depth
    origin = 0.5 * (distance.lower + distance.upper) - 0.5 * side

    def visit(centres: Points, half_width: float, level: int) -> tuple[Bool[np.ndarray, "n"], tuple[np.ndarray, ...]]:
        progress(0.9 * (level / depth) ** 2, f"cells of {2.0 * half_width:.2g} m")
        last = level == depth
        points = centres + (generator.uniform(-half_width, half_width, size=centres.shape) if last else 0.0)
        learned = values(field, points)[:, None] - heights
        contact = _contact(solid, points, radii)
        reach = SQRT3 * half_width
        split = (np.abs(learned) <= steepest * reach).any(axis=1) | (np.abs(contact) <= reach).any(axis=1)
        near = ((centres + half_width > distance.lower - room) & (centres - half_width < distance.upper + room)).all(1)
        return split & near, (learned <= 0.0, contact <= 0.0)

    cells, (learned, contact) = refine(origin, side, depth, visit, 2)
    cube = (2.0 * cells.half_width) ** 3
    both, either = cube @ (learned & contact), cube @ (learned | contact)
    # A random point of a leaf is in or out; its variance is at most a quarter of the leaf's volume squared.
    mixed = int((cells.level == depth).sum())
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


def _contact(solid: OffsetSolid, points: Points, radii: Float[np.ndarray, "r"]) -> Float[np.ndarray, "n r"]:
    """min(d - R, g), 1-Lipschitz: not positive where a ball of radius R touches, or in the offset solid."""
    return np.minimum(solid.distance.distance(points)[:, None] - radii, solid.signed_distance(points)[:, None])


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
