"""Round bodies that enclose a point cloud: the smallest ball, and a small capsule."""

import itertools
from typing import NamedTuple

import numpy as np
import scipy.optimize
from jaxtyping import Float

from keepout.flights.surface import Points, convex_hull

Point = Float[np.ndarray, "3"]


class Ball(NamedTuple):
    """{x : ‖x − centre‖ ≤ radius}, metres."""

    centre: Point
    radius: float

    @property
    def volume(self) -> float:
        """Cubic metres."""
        return float(4.0 / 3.0 * np.pi * self.radius**3)


class Capsule(NamedTuple):
    """All points within `radius` of the segment from `start` to `end`, metres."""

    start: Point
    end: Point
    radius: float

    @property
    def volume(self) -> float:
        """Cubic metres."""
        length = float(np.linalg.norm(self.end - self.start))
        return float(np.pi * self.radius**2 * (length + 4.0 / 3.0 * self.radius))


def smallest_ball(points: Points) -> Ball:
    """Find the ball of least radius round all points.

    The farthest point outside the ball of at most four is added, and the smallest ball round these five found among
    the balls through two to four of them; its radius rises every time, so it ends (as the simplex method does).

    Raises:
        MeshError: points without volume.

    """
    corners, _ = convex_hull(points)
    scale = float(np.ptp(corners, axis=0).max())
    support, ball = corners[:1], Ball(corners[0], 0.0)
    while True:
        distance = np.linalg.norm(corners - ball.centre, axis=1)
        far = int(distance.argmax())
        if distance[far] <= ball.radius + 1e-12 * scale:
            return Ball(ball.centre, float(distance[far]))
        support = np.vstack([support, corners[far]])
        candidates = []
        for count in (2, 3, 4):
            for chosen in itertools.combinations(range(len(support)), count):
                through = _through(support[list(chosen)])
                outside = np.linalg.norm(support - through.centre, axis=1).max() - through.radius
                if outside <= 1e-13 * scale:
                    candidates.append((through.radius, chosen, through))
        radius, chosen, through = min(candidates, key=lambda found: found[0])
        if radius <= ball.radius:  # only rounding is left
            return Ball(ball.centre, float(distance[far]))
        support, ball = support[list(chosen)], through


def _through(points: Float[np.ndarray, "n 3"]) -> Ball:
    """Give the ball through two to four points whose centre lies in their plane."""
    edges = points[1:] - points[0]
    weights = np.linalg.lstsq(edges @ edges.T, 0.5 * np.sum(edges**2, axis=1), rcond=None)[0]
    centre = points[0] + weights @ edges
    return Ball(centre, float(np.linalg.norm(points[0] - centre)))


def small_capsule(points: Points) -> Capsule:
    """Find a capsule of small volume round all points: Nelder and Mead over axis, place and radius, from six starts.

    A local search: no smaller capsule need be near, but one far from the axes of inertia may be. It encloses all points
    whatever the search finds: the ends follow from axis and radius, and the radius is at last that of the farthest.

    Raises:
        MeshError: points without volume.

    """
    corners, _ = convex_hull(points)
    middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
    scale = float(np.abs(corners - middle).max())
    cloud = (corners - middle) / scale

    def capsule(numbers: np.ndarray) -> Capsule:
        axis = numbers[:3] / max(float(np.linalg.norm(numbers[:3])), 1e-12)
        place = numbers[3:6] - (numbers[3:6] @ axis) * axis
        along = cloud @ axis
        away = np.linalg.norm(cloud - place - along[:, None] * axis, axis=1)
        radius = float(away.max() * (1.0 + abs(numbers[6])))
        cap = np.sqrt(np.maximum(radius**2 - away**2, 0.0))
        low, high = float((along + cap).min()), float((along - cap).max())
        if low > high:  # a ball in the middle is enough
            low = high = 0.5 * (low + high)
        return Capsule(place + low * axis, place + high * axis, radius)

    inertia = np.linalg.eigh(np.cov(cloud.T))[1].T
    found = []
    for axis in (*np.eye(3), *inertia):
        search = scipy.optimize.minimize(
            lambda numbers: capsule(numbers).volume,
            np.concatenate([axis, np.zeros(3), [0.01]]),
            method="Nelder-Mead",
            options={"maxiter": 800, "xatol": 1e-7, "fatol": 1e-9, "adaptive": True},
        )
        found.append(capsule(search.x))
    best = min(found, key=lambda one: one.volume)
    start, end = best.start * scale + middle, best.end * scale + middle
    return Capsule(start, end, float(to_segment(corners, start, end).max()))


def to_segment(points: Points, start: Point, end: Point) -> Float[np.ndarray, " n"]:
    """Distance of each point from a segment, m."""
    edge = end - start
    square = float(edge @ edge)
    share = np.clip((points - start) @ edge / square, 0.0, 1.0) if square > 0.0 else np.zeros(len(points))
    return np.linalg.norm(points - start - share[:, None] * edge, axis=1)
