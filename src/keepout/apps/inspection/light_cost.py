"""What a tour in a light that moves costs: time, Δv, or both, as the order of views in a still light does.

A leg sets out straight towards its view and keeps one speed. At a view the velocity changes to that of the next leg;
where the chaser waits for light or stays, it stops and sets out anew (`tour`).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from keepout.apps.inspection.tour import Objective

_SIDE = 1e-3
"""Seconds count so little where Δv is made least: ties are broken by them."""
_BASE = 0.2
"""Share of the speed that every leg costs in Δv when views are compared: one straight ahead is not free."""


@dataclass(frozen=True)
class Cost:
    """What an objective counts.

    Attributes:
        seconds: what a second costs.
        delta_v: what 1 m/s costs.

    """

    seconds: float = 1.0
    delta_v: float = 0.0

    @classmethod
    def of(cls, objective: Objective, worth: float) -> "Cost":
        """Take it from a scenario's objective; `worth` is that of Δv where both count, s per m/s."""
        return {"time": cls(), "delta_v": cls(_SIDE, 100.0), "both": cls(1.0, worth)}[objective]

    def whole(self, seconds: float, delta_v: float) -> float:
        """Give the cost of a tour."""
        return self.seconds * seconds + self.delta_v * delta_v


@dataclass(frozen=True, eq=False)
class Departures:
    """The legs from where a chaser is to some views.

    Attributes:
        arrival: s; infinite where no way leads.
        velocity: (v, 3) on the leg, m/s.
        change: from the velocity before to that of the leg, m/s.
        stop: from that of the leg to rest, m/s.

    """

    arrival: Float[np.ndarray, " v"]
    velocity: Float[np.ndarray, "v 3"]
    change: Float[np.ndarray, " v"]
    stop: Float[np.ndarray, " v"]

    @classmethod
    def of(
        cls,
        arrival: Float[np.ndarray, " v"],
        way: Float[np.ndarray, " v"],
        taken: Float[np.ndarray, " v"],
        ahead: Float[np.ndarray, "v 3"],
        moving: Float[np.ndarray, "3"],
    ) -> "Departures":
        """Work out the velocities.

        Args:
            arrival: at each view, s.
            way: to it, m.
            taken: for that way, s.
            ahead: from here to it, m, straight.
            moving: velocity before, m/s.

        """
        reached: Bool[np.ndarray, " v"] = np.isfinite(way)
        speed = np.where(reached, way, 0.0) / np.where(reached, np.maximum(taken, 1e-9), 1.0)
        away = np.linalg.norm(ahead, axis=1)
        velocity = (speed / np.maximum(away, 1e-9))[:, None] * ahead
        stop = np.linalg.norm(velocity, axis=1)
        return cls(arrival, velocity, np.linalg.norm(velocity - moving, axis=1), stop)

    def base(self, speed: float) -> Float[np.ndarray, " v"]:
        """Give the Δv by which views are compared when they are flown through, m/s; `speed` is the greatest."""
        return self.change + _BASE * speed
