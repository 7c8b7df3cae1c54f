"""Simple bodies that enclose a target, to measure what a tighter shape buys."""

from typing import NamedTuple

import numpy as np
import scipy.spatial
import trimesh
from jaxtyping import Float

from keepout.errors import MeshError

Cloud = Float[np.ndarray, "n 3"]


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


class Capsule(NamedTuple):
    """All points within `radius` of the segment from `start` to `end`."""

    start: Float[np.ndarray, "3"]
    end: Float[np.ndarray, "3"]
    radius: float

    @property
    def volume(self) -> float:
        """Cubic metres."""
        return float(np.pi * self.radius**2 * (np.linalg.norm(self.end - self.start) + 4.0 / 3.0 * self.radius))


class OrientedBox(NamedTuple):
    """A box with its own axes: columns of `axes`; full sizes along them."""

    centre: Float[np.ndarray, "3"]
    axes: Float[np.ndarray, "3 3"]
    size: Float[np.ndarray, "3"]

    @property
    def volume(self) -> float:
        """Cubic metres."""
        return float(np.prod(self.size))


def convex_hull(points: Cloud) -> tuple[Float[np.ndarray, "corners 3"], float]:
    """Corners (n, 3) of the convex hull, and its volume in cubic metres (Qhull).

    Raises:
        MeshError: fewer than four points, or all in one plane.

    """
    try:
        hull = scipy.spatial.ConvexHull(points)
    except (scipy.spatial.QhullError, ValueError) as cause:
        raise MeshError(f"convex hull: {len(points)} points span no volume; at least four not in a plane do") from cause
    return points[hull.vertices], float(hull.volume)


def enclosed_volume(vertices: Cloud, faces: np.ndarray) -> float:
    """Volume in cubic metres inside a closed, outward oriented mesh, by the divergence theorem.

    It means nothing for an open or wrongly oriented mesh: use `OffsetSolid.sealed_volume` there.
    """
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)


def smallest_ellipsoid(points: Cloud, tolerance: float = 1e-7) -> Ellipsoid:
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


def best_box(points: Cloud) -> OrientedBox:
    """Find a box of small volume round all points, one of its sides along a face of the hull (trimesh)."""
    corners, _ = convex_hull(points)
    to_origin, size = trimesh.bounds.oriented_bounds(corners)
    axes = to_origin[:3, :3].T
    return OrientedBox(-axes @ to_origin[:3, 3], axes, np.asarray(size, dtype=np.float64))


def best_capsule(points: Cloud) -> Capsule:
    """Find a capsule of small volume round all points.

    The axis passes through the centre of the smallest circle round the points seen along it; the directions tried are
    the axes of the best box and of the smallest ellipsoid. For a direction, radius and ends are the least.
    """
    corners, _ = convex_hull(points)
    ellipsoid = np.linalg.eigh(smallest_ellipsoid(corners, 1e-4).matrix)[1]
    directions = np.column_stack([ellipsoid, best_box(corners).axes]).T
    return min((_capsule_along(corners, direction) for direction in directions), key=lambda capsule: capsule.volume)


def _capsule_along(corners: Cloud, direction: Float[np.ndarray, "3"]) -> Capsule:
    across = np.linalg.svd(direction[None])[2][1:]
    circle, radius = trimesh.nsphere.minimum_nsphere(corners @ across.T)
    foot = np.asarray(circle) @ across
    # No optimiser's rounding may leave a corner outside.
    offsets = np.linalg.norm(corners @ across.T - circle, axis=1)
    radius = max(float(radius), float(offsets.max()))
    along = corners @ direction
    slack = np.sqrt(np.maximum(radius**2 - offsets**2, 0.0))
    first, last = float((along + slack).min()), float((along - slack).max())
    if first > last:
        first = last = 0.5 * (first + last)
        radius = float(np.linalg.norm(corners - (foot + first * direction), axis=1).max())
    return Capsule(foot + first * direction, foot + last * direction, radius)
