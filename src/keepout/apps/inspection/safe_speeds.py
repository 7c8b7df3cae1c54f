"""The speed of each leg as it is begun: no faster than planned, and than is passively safe from where the chaser is."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from keepout.apps.inspection.passive import Drifting
from keepout.apps.inspection.problem import Problem
from keepout.core.mission.scenario import Scenario

Point = Float[np.ndarray, "3"]


@dataclass(eq=False)
class DriftsFlown:
    """Legs as they were begun.

    Attributes:
        legs: flown, with those to hold points.
        slowed: of them that were flown below the speed limit, since no greater speed was safe.
        unsafe: of them for which no speed was found safe; they were flown at the slowest speed that is tried.

    """

    legs: int = 0
    slowed: int = 0
    unsafe: int = 0

    def summary(self) -> dict[str, Any]:
        """Give the figures as plain numbers for JSON."""
        return {"legs_flown": self.legs, "legs_flown_slowed": self.slowed, "legs_flown_unsafe": self.unsafe}


@dataclass(frozen=True, eq=False)
class SafeSpeeds:
    """Chooses the greatest speed of each leg; where passive safety is not asked for, it limits none.

    Attributes:
        problem: has the ways.
        drifting: judges them; None where passive safety is not asked for.
        flown: what became of the legs; None likewise.

    """

    problem: Problem
    drifting: Drifting | None
    flown: DriftsFlown | None

    @classmethod
    def of(cls, problem: Problem, scenario: Scenario) -> "SafeSpeeds":
        """Choose for a scenario."""
        drifting = Drifting.of(scenario, problem.target.distance.distance)
        return cls(problem, drifting, None if drifting is None else DriftsFlown())

    def of_leg(self, planned: float, position: Point, place: Point, now: float) -> float:
        """Give the greatest speed of a leg, m/s, and count it.

        Args:
            planned: its greatest speed by the plan, m/s.
            position: where the chaser is, m.
            place: where the law leads, m.
            now: s.

        """
        if self.drifting is None or self.flown is None:
            return math.inf
        limit = self.drifting.scenario.chaser.speed_limit
        course = self.problem.ways_from(position).path(position, place)
        if course is None:
            course = np.stack([position, place])
        until = now + float(np.linalg.norm(place - position)) / limit
        found = float(self.drifting.speeds([course], np.array([[now, until]]))[0])
        speed = min(planned, max(found, self.drifting.slowest))
        self.flown.legs += 1
        self.flown.unsafe += found == 0.0
        self.flown.slowed += speed < limit
        return speed
