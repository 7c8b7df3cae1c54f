"""The chaser as one value: what every layer that steers it must know of its body."""

import math
from dataclasses import dataclass

from keepout.core.errors import ScenarioError
from keepout.core.motion.actuator import Thrusters


@dataclass(frozen=True)
class Chaser:
    """A ball with one thruster pair an axis.

    Attributes:
        mass: kg.
        radius: of the ball that holds the chaser, m.
        force_limit: of the thrusters, per body axis, N.
        speed_limit: m/s, that a law must keep.

    Raises:
        ScenarioError: a number that is not finite, or not positive (a radius may be 0).

    """

    mass: float
    radius: float
    force_limit: float
    speed_limit: float

    def __post_init__(self) -> None:
        """Check each number against its range."""
        for name, unit in (("mass", "kg"), ("force_limit", "N"), ("speed_limit", "m/s")):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ScenarioError(f"chaser: {name}: {value} {unit}; it must be positive and finite")
        if not (math.isfinite(self.radius) and self.radius >= 0.0):
            raise ScenarioError(f"chaser: radius: {self.radius} m; it must be finite and at least 0")

    @property
    def authority(self) -> float:
        """Acceleration that the thrusters give along every axis, m/s²."""
        return self.force_limit / self.mass

    @property
    def thrusters(self) -> Thrusters:
        """The thrusters, each axis limited on its own."""
        return Thrusters(self.force_limit)
