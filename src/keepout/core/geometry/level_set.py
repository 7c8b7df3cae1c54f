"""Level sets of the distance to a target: random points on them, and the largest value of a linear function on one."""

import numpy as np
from jaxtyping import Bool, Float

from keepout.core.cores import kernel, share_among_cores
from keepout.core.geometry.distance import (
    DEEPEST,
    BallCloudDistance,
    Distance,
    ExactDistance,
    Points,
    box_distance_squared,
    on_triangle,
)

_SLACK = 1e-9
"""Metres. Far above the rounding of the distances, far below any length that matters."""


def surface_points(distance: Distance, count: int, generator: np.random.Generator, *, by_area: float = 1.0) -> Points:
    """Points on the triangles: a share `by_area` uniform over the surface, the rest the same number a triangle.

    The second kind gives small parts their share of attention. Of a ball cloud: points on the balls.
    """
    if isinstance(distance, BallCloudDistance):
        direction = random_directions(generator, count)
        return distance.centres[generator.integers(len(distance.centres), size=count)] + distance.radius * direction
    corners = distance.vertices[distance.faces]
    areas = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    uniform = generator.choice(len(areas), round(by_area * count), p=areas / areas.sum())
    each = generator.integers(len(areas), size=count - len(uniform))
    face = np.concatenate([uniform, each])
    u, v = generator.random((2, count))
    u, v = np.where(u + v > 1.0, [1.0 - u, 1.0 - v], [u, v])
    a, b, c = corners[face].transpose(1, 0, 2)
    return a + u[:, None] * (b - a) + v[:, None] * (c - a)


def random_directions(generator: np.random.Generator, count: int) -> Points:
    """Draw unit vectors, uniform over the sphere."""
    direction = generator.normal(size=(count, 3))
    return direction / np.linalg.norm(direction, axis=1, keepdims=True)


def towards_level(
    distance: ExactDistance, points: Points, level: float
) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, "n"], Float[np.ndarray, "n 3"]]:
    """Points moved along the distance's gradient to {d = level}, which of them arrive there, to 1e-9 m, and normals.

    Those that take more than a few steps are between two surfaces and zigzag; hardly one arrives later. The normals are
    the level set's, unit vectors; on the surface itself those of the triangles, whichever way they are wound.
    """
    if level == 0.0:
        _, points, faces = distance.closest(points)
        a, b, c = np.moveaxis(distance.vertices[distance.faces[faces]], 1, 0)
        normal = np.cross(b - a, c - a)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
        return points, np.ones(len(points), bool), normal
    points, away, normal = points.copy(), np.arange(len(points)), np.empty(np.shape(points))
    for _ in range(6):
        d, normal[away] = distance.distance_and_gradient(points[away])
        short = np.abs(level - d) >= 1e-9
        points[away[short]] += ((level - d)[:, None] * normal[away])[short]
        away = away[short]
    arrived = np.ones(len(points), bool)
    d, normal[away] = distance.distance_and_gradient(points[away])
    arrived[away] = np.abs(d - level) < 1e-9
    return points, arrived, normal


def onto_level(distance: ExactDistance, points: Points, level: float) -> Float[np.ndarray, "m 3"]:
    """Points moved along the distance's gradient onto {d = level}; those that do not arrive are left out."""
    points, arrived, _ = towards_level(distance, points, level)
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
    start = (surface_points if uniform else sharp_points)(distance, count, generator)
    if level == 0.0:
        return start
    return onto_level(distance, start + level * random_directions(generator, len(start)), level)


def largest_on_level(
    distance: ExactDistance,
    level: float,
    centres: Float[np.ndarray, "n 3"],
    half_widths: Float[np.ndarray, "n 3"],
    slopes: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, "n"]:
    """Upper bound of slope·(p - c) over the points p of each box with d(p) = level.

    A box that meets {d = R} also holds points up to its diagonal off that surface, and a bound over the whole box
    pays for them. Every triangle's own distance d_T is convex, so d_T(p) ≥ d_T(c) + g·(p - c) with g its gradient at
    the box's centre c; where d(p) = R some triangle has d_T(p) = R, hence g·(p - c) ≤ R - d_T(c). The level set inside
    the box lies in the union of these half-spaces, over the triangles that come near enough.

    Args:
        distance: exact unsigned distance to triangles.
        level: metres, positive.
        centres: c of each box, metres.
        half_widths: of each box, along the axes, metres.
        slopes: of the linear function of each box.

    Returns:
        The bound; minus infinity where the box provably does not meet the level set.

    """
    answer = np.empty(len(centres))
    tree, centres = distance.tree, np.ascontiguousarray(centres)

    def work(part: slice) -> None:
        _largest(tree, level, centres[part], half_widths[part], slopes[part], answer[part])

    share_among_cores(work, len(centres))
    return answer


@kernel()
def _reach(v, half):
    """Max v·q over |q_i| ≤ half_i."""
    return half[0] * abs(v[0]) + half[1] * abs(v[1]) + half[2] * abs(v[2])


@kernel()
def _over_cut(v, g, half, limit):
    """Max v·q over |q_i| ≤ half_i, g·q ≤ limit: by duality the least over λ ≥ 0 of λ limit + Σ half_i |v_i - λ g_i|."""
    if -_reach(g, half) > limit:
        return -np.inf
    best = _reach(v, half)
    for axis in range(3):
        if g[axis] != 0.0:
            factor = v[axis] / g[axis]
            if factor > 0.0:
                value = factor * limit
                for other in range(3):
                    value += half[other] * abs(v[other] - factor * g[other])
                best = min(best, value)
    return best


@kernel()
def _largest(tree, level, centres, half_widths, slopes, answer):
    stack = np.empty(DEEPEST, dtype=np.int64)
    g = np.empty(3)
    for i in range(len(centres)):
        x, y, z = centres[i, 0], centres[i, 1], centres[i, 2]
        half = half_widths[i]
        v = slopes[i]
        whole = _reach(v, half)
        far = level + np.sqrt(half[0] ** 2 + half[1] ** 2 + half[2] ** 2) + _SLACK
        best = -np.inf
        depth = 1
        stack[0] = 0
        while depth > 0 and best < whole:
            depth -= 1
            node = stack[depth]
            if box_distance_squared(tree.lower, tree.upper, node, x, y, z) > far * far:
                continue
            if tree.amount[node] == 0:
                stack[depth] = tree.right[node]
                stack[depth + 1] = node + 1
                depth += 2
                continue
            for triangle in range(tree.first[node], tree.first[node] + tree.amount[node]):
                squared, qx, qy, qz = on_triangle(tree.corners, tree.plane, triangle, x, y, z)
                if squared > far * far:
                    continue
                d = np.sqrt(squared)
                if d < 1e-6:  # no gradient to speak of
                    best = whole
                    break
                g[0], g[1], g[2] = (x - qx) / d, (y - qy) / d, (z - qz) / d
                best = max(best, _over_cut(v, g, half, level - d + _SLACK))
        answer[i] = best
