"""Training samples: points with exact signed distance and gradient, where a chaser can see."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Float32

from keepout.fields.losses import Batch
from keepout.geometry.distance import BallCloudDistance, Distance, ExactDistance
from keepout.geometry.offset_solid import OffsetSolid

Points = Float[np.ndarray, "n 3"]

HIDDEN_DEPTH = 0.1
"""Metres. In space that no chaser reaches, the field only has to stay below minus this (or the exact value nearer
by)."""


@dataclasses.dataclass(frozen=True)
class Domain:
    """Balls about one centre, metres: of the target, of the learned field, and of its continuation."""

    centre: Float[np.ndarray, "3"]
    target_radius: float
    domain_radius: float
    outer_radius: float

    @classmethod
    def around(cls, distance: Distance) -> "Domain":
        """Return the domain around a target: ρ_0 = 1.25 ρ_T, ρ_1 = 1.5 ρ_T, at least 2 m and 4 m beyond it."""
        centre = 0.5 * (distance.lower + distance.upper)
        radius = 0.5 * float(np.linalg.norm(distance.upper - distance.lower))
        return cls(centre, radius, max(1.25 * radius, radius + 2.0), max(1.5 * radius, radius + 4.0))

    @property
    def learned_radius(self) -> float:
        """The largest radius at which the continuation asks the field."""
        return 0.5 * (self.domain_radius + self.outer_radius)

    @property
    def room(self) -> float:
        """How far from the surface gaps between parts are sampled as densely as the rest of the room, metres."""
        return max(1.2, 0.05 * self.target_radius)


@dataclasses.dataclass(frozen=True)
class Samples:
    """Labelled points.

    Attributes:
        points: (n, 3) metres.
        distance: (n,) the value to learn, metres; where `hidden`, only an upper limit.
        gradient: (n, 3) its unit gradient; zeros where `smooth` is False.
        smooth: whether the gradient is known: the nearest surface, not a sealed mouth, decides the distance.
        hidden: points no chaser reaches.

    """

    points: Float32[np.ndarray, "n 3"]
    distance: Float32[np.ndarray, "n"]
    gradient: Float32[np.ndarray, "n 3"]
    smooth: Bool[np.ndarray, "n"]
    hidden: Bool[np.ndarray, "n"]


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


def label(solid: OffsetSolid, points: Points) -> Samples:
    """Exact labels for points: signed distance of the offset solid, gradient where one surface decides it.

    The cells that cover the solid's skin are left out of the labels, which are d - offset up to the surface; what the
    solid seals keeps them.
    """
    points = points.astype(np.float32).astype(np.float64)
    signed = solid.signed_distance(points)
    d, gradient = solid.distance.distance_and_gradient(points)
    reachable = solid.is_reachable(points)
    bare = np.where(
        signed > 0.0, np.minimum(d - solid.offset, signed + solid.envelope - solid.offset), d - solid.offset
    )
    smooth = reachable & (bare == d - solid.offset) & (d > 1e-4)
    depth = np.maximum(signed, -np.minimum(d + solid.offset, HIDDEN_DEPTH))
    return Samples(
        points.astype(np.float32),
        np.where(reachable, bare, np.minimum(depth, 0.0)).astype(np.float32),
        np.where(smooth[:, None], gradient, 0.0).astype(np.float32),
        smooth,
        ~reachable,
    )


def normalised(samples: Samples, domain: Domain, weight: Float[np.ndarray, "n"]) -> Batch:
    """Bring samples into the form of the losses, each with its weight."""
    x = ((samples.points.astype(np.float64) - domain.centre) / domain.learned_radius).astype(np.float32)
    columns = (x, samples.distance, samples.gradient, samples.smooth, samples.hidden, weight.astype(np.float32))
    return Batch(*(jnp.asarray(column) for column in columns))


def room_points(distance: Distance, domain: Domain, count: int, generator: np.random.Generator) -> Points:
    """Points around the target: each anywhere in a ball of radius `Domain.room` about a point of the surface."""
    start = surface_points(distance, count, generator, by_area=0.5)
    direction = generator.normal(size=start.shape)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return start + domain.room * generator.random((count, 1)) ** (1 / 3) * direction


def training_points(
    distance: Distance, domain: Domain, count: int, generator: np.random.Generator, *, room_share: float = 0.0
) -> Points:
    """Points around the target: on the surface, log-uniform in distance from it, in the room next to it, in the ball.

    Those in the ball are spread over the learned one, a little denser inside.
    """
    on, volume, room = count // 10, count // 6, round(room_share * count)
    near = count - on - volume - room
    start = surface_points(distance, on + near, generator, by_area=0.5)
    direction = generator.normal(size=(on + near, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    length = np.exp(generator.uniform(np.log(5e-3), np.log(0.6 * domain.target_radius), size=on + near))
    length[:on] = 0.0
    ball = generator.normal(size=(volume, 3))
    ball *= (domain.learned_radius * generator.random(volume) ** (1 / 2.2) / np.linalg.norm(ball, axis=1))[:, None]
    between = room_points(distance, domain, room, generator)
    points = np.concatenate([start + length[:, None] * direction, ball + domain.centre, between])
    inside = np.linalg.norm(points - domain.centre, axis=1) <= domain.learned_radius
    return points[inside]
