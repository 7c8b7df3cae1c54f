"""Training samples: points with exact signed distance and gradient, where a chaser can see."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Float32

from keepout.core.fields.domain import Domain
from keepout.core.geometry.distance import Distance
from keepout.core.geometry.level_set import Points, surface_points
from keepout.core.geometry.offset_solid import OffsetSolid
from keepout.core.learning.losses import Batch

HIDDEN_DEPTH = 0.1
"""Metres. In space that no chaser reaches, Keepout's loss only asks the field to stay below minus this (or the exact
value nearer by)."""


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


def label(solid: OffsetSolid, points: Points, *, whole_depth: bool = False) -> Samples:
    """Exact labels for points: signed distance of the offset solid, gradient where one surface decides it.

    The cells that cover the solid's skin are left out of the labels, which are d - offset up to the surface; what the
    solid seals keeps them.

    Args:
        solid: the obstacle.
        points: (n, 3) metres.
        whole_depth: whether hidden points are labelled with their depth, for a loss that learns the distance inside
            as well, instead of `HIDDEN_DEPTH` at most. It is exact where the nearest surface is the way out, and
            within the size of the solid's cells elsewhere.

    """
    points = points.astype(np.float32).astype(np.float64)
    signed = solid.signed_distance(points)
    d, gradient = solid.distance.distance_and_gradient(points)
    reachable = solid.is_reachable(points)
    bare = np.where(
        signed > 0.0, np.minimum(d - solid.offset, signed + solid.envelope - solid.offset), d - solid.offset
    )
    smooth = reachable & (bare == d - solid.offset) & (d > 1e-4)
    if whole_depth:
        # The solid understates a depth by its offset and a cell's half-diagonal at most, and overstates it by what
        # its cells reach past the surface.
        slack = solid.offset + 0.5 * (solid.envelope + solid.offset)
        depth = np.clip(-(d + solid.offset), signed - slack, signed + solid.envelope)
    else:
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
