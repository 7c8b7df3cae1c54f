"""What a field learns from: labelled samples, and counter-examples, where it is most wrong, found anew as it learns.

Samples have exact signed distance and gradient, where a chaser can see. Counter-examples are sought on the dangerous
side and on the other.
"""

import dataclasses
from collections.abc import Iterator
from typing import Protocol, runtime_checkable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from keepout.core.fields.continuation import Domain
from keepout.core.geometry.distance import Distance, ExactDistance, Points
from keepout.core.geometry.level_set import level_points, onto_level, random_directions, surface_points, towards_level
from keepout.core.geometry.offset_solid import OffsetSolid
from keepout.core.learning.losses import Batch, TrainingProfile

HIDDEN_DEPTH = 0.1
"""Metres. In space that no chaser reaches, Keepout's loss only asks the field to stay below minus this (or the exact
value nearer by)."""
ON_LEVEL, NEAR = 50_000, 70_000
"""Candidates on the surface, as on the chaser's contact surface, drawn anew every round; and those in the room next to
the surface (`Domain.room`), at most: of the labelled samples, and they stay."""
MOST_WRONG = 4.0
"""Times the mean error: a sample that is more wrong is drawn no more often."""
ROUNDS_KEPT, CLIMBERS = 3, 2048
"""Rounds of counter-examples that are learned from, and the worst candidates of a round that climb."""
ASCENT = (0.08, 0.05, 0.03, 0.02, 0.01, 0.005)
"""Metres. Steps by which they climb."""
PEAKS, COPIES, PEAK_SIZE = 0.1, 5, 0.1
"""Of the over-statements a round keeps, up to this share are peaks, so many metres apart, that are kept so many times:
the error bound is that of the highest, however narrow."""
HIGHEST = 4.0
"""Weight of the highest peak, and of the deepest web; it falls to 1 for what is not over- or under-stated."""
JITTERED, JITTER = 0.6, 0.03
"""The share of them that is moved off its surface, and by how much, metres."""


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

    def picked(self, which: Int[np.ndarray, "m"]) -> "Samples":
        """Give some of them."""
        return Samples(*(getattr(self, entry.name)[which] for entry in dataclasses.fields(Samples)))


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
    d, gradient = solid.distance.distance_and_gradient(points)
    signed = solid.signed_distance(points, d)
    reachable = solid.is_reachable(points, d)
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


def where_wrong(error: Float[np.ndarray, "n"], count: int, generator: np.random.Generator) -> Int[np.ndarray, "m"]:
    """Draw the indices of so many samples, half of them in proportion to an error at each: most where a part moved."""
    share = np.minimum(error / max(float(error.mean()), 1e-9), MOST_WRONG)
    chance = 1.0 / len(error) + share / max(float(share.sum()), 1e-9)
    return generator.choice(len(error), count, p=chance / chance.sum())


def normalised(samples: Samples, domain: Domain, weight: Float[np.ndarray, "n"]) -> Batch:
    """Bring samples into the form of the losses, each with its weight."""
    x = ((samples.points.astype(np.float64) - domain.centre) / domain.learned_radius).astype(np.float32)
    columns = (x, samples.distance, samples.gradient, samples.smooth, samples.hidden, weight.astype(np.float32))
    return Batch(*(jnp.asarray(column) for column in columns))


def room_points(distance: Distance, domain: Domain, count: int, generator: np.random.Generator) -> Points:
    """Points around the target: each anywhere in a ball of radius `Domain.room` about a point of the surface."""
    start = surface_points(distance, count, generator, by_area=0.5)
    direction = random_directions(generator, len(start))
    return start + domain.room * generator.random((count, 1)) ** (1 / 3) * direction


def training_points(
    distance: Distance, domain: Domain, count: int, generator: np.random.Generator, profile: TrainingProfile
) -> Points:
    """Points around the target: on the surface, log-uniform in distance from it, in the room next to it, in the ball.

    Those in the ball are spread over the learned one, a little denser inside. The profile says how many are in the
    room, and from where to where the logarithm reaches.
    """
    on, volume, room = count // 10, count // 6, round(profile.room_share * count)
    near = count - on - volume - room
    start = surface_points(distance, on + near, generator, by_area=0.5)
    direction = random_directions(generator, on + near)
    length = np.exp(generator.uniform(*np.log(np.minimum(profile.spread, 0.6 * domain.target_radius)), size=on + near))
    length[:on] = 0.0
    ball = generator.normal(size=(volume, 3))
    ball *= (domain.learned_radius * generator.random(volume) ** (1 / 2.2) / np.linalg.norm(ball, axis=1))[:, None]
    between = room_points(distance, domain, room, generator)
    points = np.concatenate([start + length[:, None] * direction, ball + domain.centre, between])
    return points[np.linalg.norm(points - domain.centre, axis=1) <= domain.learned_radius]


@runtime_checkable
class Learner(Protocol):
    """The network as it is learned, metres."""

    def value(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Return f̃."""
        ...

    def gradient(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return ∇f̃."""
        ...


@dataclasses.dataclass(frozen=True)
class Hunt:
    """Where over-statement is hunted: on the surface, where the chaser touches, and in all the near field.

    Under-statement, which costs room but no safety, is hunted in the near field only.

    Attributes:
        solid: the target's offset solid.
        domain: of the field.
        levels: distances at which a chaser touches, metres: of a point, and of the chaser if that is another.
        near: labelled points near the surface.
        profile: the numbers of the fit.

    """

    solid: OffsetSolid
    domain: Domain
    levels: tuple[float, ...]
    near: Samples
    profile: TrainingProfile

    @classmethod
    def prepare(
        cls, solid: OffsetSolid, domain: Domain, chaser_radius: float, profile: TrainingProfile, samples: Samples
    ) -> "Hunt":
        """Take the candidates that stay from what is learned: the room next to the surface, evenly picked."""
        near = np.flatnonzero(samples.distance < domain.room)
        near = near[np.linspace(0, len(near) - 1, min(NEAR, len(near))).astype(int)]
        exact = isinstance(solid.distance, ExactDistance) and chaser_radius > 0.0
        return cls(solid, domain, (0.0, chaser_radius) if exact else (0.0,), samples.picked(near), profile)

    @property
    def kept(self) -> int:
        """Number of counter-examples that are learned from at a time."""
        return ROUNDS_KEPT * (self.profile.worst * (len(self.levels) + 1) + self.profile.webs)

    def worst(
        self, learner: Learner, known: Points, generator: np.random.Generator, *, settling: bool = False
    ) -> tuple[Batch, float]:
        """Return labelled counter-examples, and the largest f̃ - R found where a chaser touches, metres.

        Args:
            learner: the network.
            known: (n, 3) points near which it was wrong before, metres: candidates again.
            generator: of the new candidates.
            settling: leave webs alone, and keep more over-statements of the near field in their place.

        """
        chosen, weights, largest, worst = [], [], -np.inf, self.profile.worst
        for level, (points, value) in zip(self.levels, self._climbed(learner, known, generator)):
            peaks = _peaks(points, value)[: int(PEAKS * worst)]
            best = np.concatenate([_largest(value, worst - COPIES * len(peaks)), np.repeat(peaks, COPIES)])
            chosen.append(points[best])
            weights.append(_weights(value[best] - level))
            largest = max(largest, float(value.max()) - level)
        excess = learner.value(self.near.points.astype(np.float64)) - self.near.distance
        lack = np.where(self.near.hidden, -np.inf, -excess)
        excess = np.where(self.near.distance < self.profile.near_field, excess, -np.inf)
        webs = 0 if settling else self.profile.webs
        over, under = _largest(excess, worst + self.profile.webs - webs), _largest(lack, webs)
        chosen += [self.near.points[best].astype(np.float64) for best in (over, under)]
        # A web is deep and rare: a loss that grows with the error alone would rather keep it.
        weights += [np.ones(len(over)), _weights(lack[under])]
        points = np.concatenate(chosen)
        points += JITTER * generator.normal(size=points.shape) * (generator.random((len(points), 1)) < JITTERED)
        return normalised(label(self.solid, points), self.domain, np.concatenate(weights)), largest

    def _candidates(self, level: float, known: Points, generator: np.random.Generator) -> Float[np.ndarray, "k 3"]:
        """Return new points of a level set, and what is nearest on it to those known."""
        distance = self.solid.distance
        if not isinstance(distance, ExactDistance):
            return surface_points(distance, ON_LEVEL, generator)
        # New ones in every round, as a spike is narrower than those of one lie apart.
        new = level_points(distance, level, ON_LEVEL, generator)
        return np.concatenate([new, onto_level(distance, known, level)])

    def _climbed(
        self, learner: Learner, known: Points, generator: np.random.Generator
    ) -> list[tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k"]]]:
        """Return the worst candidates of each level set, each after an ascent on it, and f̃ there."""
        starts = []
        for level in self.levels:
            points = self._candidates(level, known, generator)
            value = learner.value(points)
            best = _largest(value, CLIMBERS)
            starts.append((points[best], value[best]))
        points, value = map(np.concatenate, zip(*starts))
        cuts, distance = np.cumsum([len(best) for best, _ in starts])[:-1], self.solid.distance
        if isinstance(distance, ExactDistance):
            # Together: the network is asked at pieces of one size, which the points of one level would not fill.

            def onto(places: Points) -> Iterator[np.ndarray]:
                parts = (towards_level(distance, *part) for part in zip(np.split(places, cuts), self.levels))
                return map(np.concatenate, zip(*parts))

            _, _, normal = onto(points)
            for step in ASCENT:
                # Along the slope, which narrow spikes need, and at random, which leads over the edges of the surface.
                uphill = _tangential(learner.gradient(points), normal)
                for move in (uphill, generator.normal(size=points.shape)):
                    moved, arrived, across = onto(points + step * move)
                    moved_value = np.where(arrived, learner.value(moved), -np.inf)
                    higher = moved_value > value
                    points, normal = (np.where(higher[:, None], a, b) for a, b in ((moved, points), (across, normal)))
                    value = np.where(higher, moved_value, value)
        return list(zip(np.split(points, cuts), np.split(value, cuts)))


def _tangential(gradient: Float[np.ndarray, "n 3"], normal: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Return the directions along a level set, of these normals, in which a field rises fastest: unit vectors."""
    along = gradient - (gradient * normal).sum(axis=1, keepdims=True) * normal
    return along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-30)


def _peaks(points: Points, value: Float[np.ndarray, "n"]) -> np.ndarray:
    """Return the indices of the highest point of each cell, the highest of all first."""
    order = np.argsort(-value)
    cells = np.floor(points[order] / PEAK_SIZE).astype(np.int64)
    return order[np.sort(np.unique(cells, axis=0, return_index=True)[1])]


def _weights(error: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Return `HIGHEST` for the largest error, falling to 1 at none."""
    return 1.0 + (HIGHEST - 1.0) * np.maximum(error, 0.0) / max(error.max(initial=0.0), 1e-9)


def _largest(value: Float[np.ndarray, "_"], count: int) -> np.ndarray:
    """Return the indices of the `count` largest values, or of all if there are fewer."""
    if len(value) <= count:
        return np.arange(len(value))
    return np.argpartition(-value, count)[:count]
