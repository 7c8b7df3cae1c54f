"""Random points on a target's triangles and on level sets of the distance to them."""

import numpy as np
from jaxtyping import Bool, Float

from keepout.core.geometry.distance import BallCloudDistance, Distance, ExactDistance

Points = Float[np.ndarray, "n 3"]


def surface_points(distance: Distance, count: int, generator: np.random.Generator, *, by_area: float = 1.0) -> Points:
    """Points on the triangles: a share `by_area` uniform over the surface, the rest the same number a triangle.

    The second kind gives small parts their share of attention. Of a ball cloud: points on the balls.
    """
    if isinstance(distance, BallCloudDistance):
        direction = generator.normal(size=(count, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        return distance.centres[generator.integers(len(distance.centres), size=count)] + distance.radius * direction
    corners = distance.vertices[distance.faces]
    areas = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    uniform = generator.choice(len(areas), round(by_area * count), p=areas / areas.sum())
    each = generator.integers(len(areas), size=count - len(uniform))
    face = np.concatenate([uniform, each])
    u, v = generator.random((2, count))
    flip = u + v > 1.0
    u, v = np.where(flip, 1.0 - u, u), np.where(flip, 1.0 - v, v)
    a, b, c = corners[face].transpose(1, 0, 2)
    return a + u[:, None] * (b - a) + v[:, None] * (c - a)


def towards_level(
    distance: ExactDistance, points: Points, level: float
) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, "n"]]:
    """Points moved along the distance's gradient to {d = level}, and which of them arrive there, to 1e-9 m.

    Those that take more than a few steps are between two surfaces and zigzag; hardly one arrives later.
    """
    if level == 0.0:
        return distance.closest(points)[1], np.ones(len(points), bool)
    points, away = points.copy(), np.arange(len(points))
    for _ in range(6):
        d, gradient = distance.distance_and_gradient(points[away])
        short = np.abs(level - d) >= 1e-9
        away = away[short]
        points[away] += ((level - d)[:, None] * gradient)[short]
    arrived = np.ones(len(points), bool)
    arrived[away] = np.abs(distance.distance(points[away]) - level) < 1e-9
    return points, arrived


def onto_level(distance: ExactDistance, points: Points, level: float) -> Float[np.ndarray, "m 3"]:
    """Points moved along the distance's gradient onto {d = level}; those that do not arrive are left out."""
    points, arrived = towards_level(distance, points, level)
    return points[arrived]


def sharp_points(distance: ExactDistance, count: int, generator: np.random.Generator) -> Points:
    """Points on the triangles, two fifths of them along edges and at corners, where a learned field has its spikes.

    Around a corner the level sets are pieces of spheres, small beside the whole, and samples of the area miss them.
    """
    along = round(0.4 * count)
    face = generator.integers(len(distance.faces), size=along)
    first = generator.integers(3, size=along)
    a = distance.vertices[distance.faces[face, first]]
    b = distance.vertices[distance.faces[face, (first + 1) % 3]]
    part = generator.random((along, 1)) * (generator.random((along, 1)) < 0.5)
    return np.concatenate([surface_points(distance, count - along, generator, by_area=0.5), a + part * (b - a)])


def level_points(
    distance: ExactDistance, level: float, count: int, generator: np.random.Generator, *, uniform: bool = False
) -> Points:
    """At most `count` points with d = level, pushed there from the surface in random directions.

    They start at `sharp_points`, or `uniform` over the surface.
    """
    sample = surface_points if uniform else sharp_points
    start = sample(distance, count, generator)
    if level == 0.0:
        return start
    direction = generator.normal(size=start.shape)
    start = start + level * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    return onto_level(distance, start, level)
