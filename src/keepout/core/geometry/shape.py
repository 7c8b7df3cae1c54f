"""Simple bodies that enclose a target, to measure what a tighter shape buys."""

from typing import NamedTuple

import numpy as np
import scipy.spatial
from jaxtyping import Float

from keepout.core.errors import MeshError

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
