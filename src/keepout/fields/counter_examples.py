"""Counter-examples: where a field is most wrong, on the dangerous side and on the other, found anew as it learns."""

import dataclasses
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from keepout.fields import losses
from keepout.fields.sampling import (
    Domain,
    Points,
    Samples,
    label,
    level_points,
    normalised,
    onto_level,
    surface_points,
    training_points,
)
from keepout.geometry.distance import ExactDistance
from keepout.geometry.offset_solid import OffsetSolid

ON_SURFACE, ON_LEVEL, NEAR, NEAR_FIELD = 200_000, 200_000, 60_000, 1.2
"""Candidates on the surface (new ones every round), on the chaser's contact surface, and within so many metres."""
WORST, ROUNDS_KEPT = 1500, 3
"""Worst over-statements of each kind that a round keeps, and the rounds that are learned from."""
ASCENT = (0.06, 0.03, 0.015)
"""Metres. Random steps by which the worst candidates climb."""
JITTERED, JITTER = 0.6, 0.03
"""The share of them that is moved off its surface, and by how much, metres."""

Values = Callable[[Float[np.ndarray, "_ 3"]], Float[np.ndarray, "_"]]
"""f̃ in metres at points in metres."""


@dataclasses.dataclass(frozen=True)
class Hunt:
    """Where over-statement is hunted: on the surface, where the chaser touches, and in all the near field.

    Under-statement, which costs room but no safety, is hunted in the near field only.

    Attributes:
        solid: the target's offset solid.
        domain: of the field.
        chaser_radius: metres.
        contact: points where a chaser touches; none for radius 0 or a point cloud.
        near: labelled points near the surface.
        webs: worst under-statements that a round keeps.

    """

    solid: OffsetSolid
    domain: Domain
    chaser_radius: float
    contact: Points
    near: Samples
    webs: int

    @classmethod
    def prepare(
        cls, solid: OffsetSolid, domain: Domain, chaser_radius: float, webs: int, generator: np.random.Generator
    ) -> "Hunt":
        """Sample the candidates that stay."""
        distance = solid.distance
        contact = np.zeros((0, 3))
        if isinstance(distance, ExactDistance) and chaser_radius > 0.0:
            contact = level_points(distance, chaser_radius, ON_LEVEL, generator)
        near = training_points(distance, domain, 3 * NEAR, generator)
        near = label(solid, near[distance.distance(near) < NEAR_FIELD][:NEAR])
        return cls(solid, domain, chaser_radius, contact, near, webs)

    @property
    def kept(self) -> int:
        """Number of counter-examples that are learned from at a time."""
        return ROUNDS_KEPT * (WORST * (3 if len(self.contact) else 2) + self.webs)

    def worst(self, values: Values, generator: np.random.Generator) -> tuple[losses.Batch, float]:
        """Return labelled counter-examples, and the largest f̃ - R found where a chaser touches, metres."""
        surface = surface_points(self.solid.distance, ON_SURFACE, generator, by_area=0.5)
        chosen, largest = [], -np.inf
        for points, level in ((surface, 0.0), (self.contact, self.chaser_radius)):
            if len(points):
                points, value = self._climb(values, points, level, generator)
                chosen.append(points)
                largest = max(largest, float(value.max()) - level)
        excess = values(self.near.points.astype(np.float64)) - self.near.distance
        lack = np.where(self.near.hidden, -np.inf, -excess)
        for best in (_largest(excess), _largest(lack, self.webs)):
            chosen.append(self.near.points[best].astype(np.float64))
        points = np.concatenate(chosen)
        points += JITTER * generator.normal(size=points.shape) * (generator.random((len(points), 1)) < JITTERED)
        batch = normalised(label(self.solid, points), self.domain)
        # Here every error counts in full, near the surface or not.
        return batch._replace(weight=jnp.ones_like(batch.weight)), largest

    def _climb(
        self, values: Values, points: Points, level: float, generator: np.random.Generator
    ) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k"]]:
        """Return the worst candidates of one level set after a random ascent on it, and f̃ there."""
        value = values(points)
        best = _largest(value)
        points, value = points[best], value[best]
        distance = self.solid.distance
        if not isinstance(distance, ExactDistance):
            return points, value
        for step in ASCENT:
            moved = onto_level(distance, points + step * generator.normal(size=points.shape), level)
            points, value = np.concatenate([points, moved]), np.concatenate([value, values(moved)])
            best = _largest(value)
            points, value = points[best], value[best]
        return points, value


def _largest(value: Float[np.ndarray, "_"], count: int = WORST) -> np.ndarray:
    """Return the indices of the `count` largest values, or of all if there are fewer."""
    if len(value) <= count:
        return np.arange(len(value))
    return np.argpartition(-value, count)[:count]
