"""The numbers that a law is designed for, as one value."""

from dataclasses import dataclass

from keepout.core.motion.chaser import Chaser
from keepout.core.motion.relative import RelativeMotion


@dataclass(frozen=True)
class Operation:
    """What a law is designed for, beside the field and the goal.

    Attributes:
        chaser: the body to steer.
        motion: the model behind the drift compensation.
        error_bound: e_h of the field, certified for the chaser's radius, m.
        margin: the operator's own, m.
        period: between control steps, s.
        disturbance_bound: largest norm of the force that nobody commanded, N.

    """

    chaser: Chaser
    motion: RelativeMotion
    error_bound: float
    disturbance_bound: float
    margin: float = 0.1
    period: float = 1.0

    @property
    def keep_out(self) -> float:
        """Value of the field, m, down to which the chaser may come: error bound, radius and margin together."""
        return self.error_bound + self.chaser.radius + self.margin
