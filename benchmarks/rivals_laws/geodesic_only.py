"""Geodesic guidance followed without any barrier: what the filter adds to a good way.

The velocity of Keepout's geodesic guidance is tracked with the default law's own gain (0.5/s, limited to the
authority), so that the barrier is all that is missing.
"""

import dataclasses

from jaxtyping import Array, Float, PyTree

from keepout.core.control.guidance import Guidance
from keepout.core.motion.relative import MotionState
from rivals_laws.observed import ObservedLaw, Plant, tracking
from rivals_laws.rival import Rival
from rivals_laws.rival_case import Point, RivalCase


class GuidanceOnly(ObservedLaw):
    """Tracks a guidance's velocity and knows of no field."""

    plant: Plant
    guidance: Guidance

    @property
    def goal(self) -> Float[Array, "3"]:
        """Where the guidance leads, m."""
        return self.guidance.goal

    def acceleration(self, own: PyTree, estimate: MotionState) -> tuple[PyTree, Float[Array, "3"]]:
        """Track the desired velocity."""
        wanted = self.guidance.desired_velocity(estimate.position)
        return own, tracking(self.plant, wanted, estimate.velocity)


@dataclasses.dataclass(frozen=True)
class GeodesicOnly(Rival):
    """Keepout's guidance without its barrier."""

    name = "geodesic without CBF"

    def law(self, case: RivalCase, start: Point, goal: Point) -> GuidanceOnly:
        """Follow the geodesic."""
        return GuidanceOnly(Plant.of(case), case.geodesic(start, goal))


RIVALS = (GeodesicOnly(),)
