"""Where a field is learned or sampled, and beyond which it is continued."""

import dataclasses

import numpy as np
from jaxtyping import Float

from keepout.core.geometry.distance import Distance


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
