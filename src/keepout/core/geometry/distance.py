"""Exact unsigned distance from points to a triangle soup, or to a cloud of balls, in float64."""

import functools

import numpy as np
from jaxtyping import Float, Int

from keepout.core.errors import MeshError
from keepout.core.geometry import bvh
from keepout.core.geometry.soup import TriangleSoup

Points = Float[np.ndarray, "n 3"]


class ExactDistance(TriangleSoup):
    """Unsigned distance to a triangle soup: no orientation, no watertightness, no signs.

    Found with a bounding-volume hierarchy (`bvh`); agrees with brute force over all triangles to 1e-12 m. Degenerate
    triangles count as the segment or point that they are.

    Args:
        vertices: (V, 3) positions in metres.
        faces: (F, 3) vertex indices; at least one.

    Raises:
        MeshError: no faces, an index outside the vertices, or a vertex that is not finite.

    """

    @functools.cached_property
    def area(self) -> float:
        """Total area of the triangles, one side, square metres."""
        a, b, c = np.moveaxis(self.vertices[self.faces], 1, 0)
        return 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())

    @functools.cached_property
    def tree(self) -> bvh.Tree:
        """The triangles' bounding-volume hierarchy, built when first asked for."""
        return bvh.build(self.vertices[self.faces])

    def distance(self, points: Points) -> Float[np.ndarray, "n"]:
        """Unsigned distance in metres, one per point."""
        return self.closest(points)[0]

    def closest(self, points: Points) -> tuple[Float[np.ndarray, "n"], Points, Int[np.ndarray, "n"]]:
        """Distance (n,) in metres, closest point (n, 3) on the soup, and the triangle (n,) it lies on."""
        return bvh.closest(self.tree, _checked(points))

    def distance_and_gradient(self, points: Points) -> tuple[Float[np.ndarray, "n"], Points]:
        """Distance (n,) in metres and its gradient (n, 3), the unit vector (p - c)/d away from the closest point c.

        Where d = 0 the distance has no gradient, and zeros are returned; within rounding of the surface (1e-15 m) the
        direction is noise. Where several closest points tie (the medial axis) the gradient is that of one of them.
        """
        distance, closest, _ = self.closest(points)
        return distance, _away(points, closest)


class BallCloudDistance:
    """Unsigned distance to a union of equal balls, one a point: what a point cloud without normals can promise.

    Args:
        centres: (N, 3) in metres; at least one.
        radius: of every ball, metres, positive.

    Raises:
        MeshError: no points, a point that is not finite, or a radius that is not positive.

    """

    def __init__(self, centres: Float[np.ndarray, "v 3"], radius: float):
        self.centres = np.ascontiguousarray(centres, dtype=np.float64)
        self.radius = float(radius)
        if len(self.centres) == 0:
            raise MeshError("a point cloud needs at least one point, and there are 0")
        if not np.isfinite(self.centres).all():
            raise MeshError("point cloud: a coordinate is not finite; every coordinate must be a number")
        if not (np.isfinite(self.radius) and self.radius > 0.0):
            raise MeshError(f"point cloud: thickness {2 * self.radius} m; it must be positive")
        self.lower: Float[np.ndarray, 3] = self.centres.min(axis=0) - self.radius
        self.upper: Float[np.ndarray, 3] = self.centres.max(axis=0) + self.radius
        self.area = float(4.0 * np.pi * self.radius**2 * len(self.centres))
        from scipy.spatial import KDTree  # what has triangles does not wait for it

        self._tree = KDTree(self.centres)

    def distance(self, points: Points) -> Float[np.ndarray, "n"]:
        """Unsigned distance in metres, one per point; zero inside a ball."""
        return self.closest(points)[0]

    def closest(self, points: Points) -> tuple[Float[np.ndarray, "n"], Points, Int[np.ndarray, "n"]]:
        """Distance (n,) in metres, closest point (n, 3) of the balls, and the ball (n,) it belongs to."""
        points = _checked(points)
        to_centre, ball = self._tree.query(points)
        direction = _away(points, self.centres[ball])
        reach = np.minimum(self.radius, to_centre)
        closest = self.centres[ball] + reach[:, None] * direction
        return np.maximum(to_centre - self.radius, 0.0), closest, np.asarray(ball, dtype=np.int64)

    def distance_and_gradient(self, points: Points) -> tuple[Float[np.ndarray, "n"], Points]:
        """Distance (n,) in metres and its gradient (n, 3), a unit vector; zeros inside the balls, where d = 0."""
        points = _checked(points)
        to_centre, ball = self._tree.query(points)
        distance = np.maximum(to_centre - self.radius, 0.0)
        return distance, np.where((distance > 0.0)[:, None], _away(points, self.centres[ball]), 0.0)


Distance = ExactDistance | BallCloudDistance


def _checked(points: Points) -> Points:
    points = np.ascontiguousarray(points, dtype=np.float64)
    if not np.isfinite(points).all():
        raise MeshError("points: a query point is not finite; every coordinate must be a number")
    return points


def _away(points: Points, closest: Points) -> Points:
    """Make unit vectors from the closest points to the points; zeros where they coincide."""
    difference = points - closest
    length = np.linalg.norm(difference, axis=1)
    return difference / np.where(length > 0.0, length, 1.0)[:, None]
