"""Onto an ellipse about the target from where a mission starts: two burns, and a coast between them.

The coast follows from Hill's equations, in closed form. That it keeps the stand-off is proved by the exact motion
(`passive`), for a target that begins to turn as it does when the mission starts.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from keepout.apps.inspection.circumnavigation import Circumnavigation, hill_states, in_body
from keepout.apps.inspection.hill import coast_matrix
from keepout.apps.inspection.passive import passive_safety, rows, states_at_times
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.core.motion.rotation import matrix

Distance = Callable[[Float[np.ndarray, "points 3"]], Float[np.ndarray, "points"]]
Point = Float[np.ndarray, "3"]

_LONGEST = 0.1
"""Share of the mission's duration that the coast may take."""
_TRIED = 24
"""Lengths of it that are tried, from the shortest that the speed limit allows."""
_PLACES = 90
"""Of the ellipse to which it may lead."""


@dataclass(frozen=True)
class Transfer:
    """Two burns and a coast.

    Attributes:
        first: of the burns, m/s.
        second: m/s.
        seconds: that the coast takes.
        keeps_stand_off: whether it is proved to.

    """

    first: float
    second: float
    seconds: float
    keeps_stand_off: bool

    @property
    def delta_v(self) -> float:
        """Of both burns, m/s."""
        return self.first + self.second

    def summary(self) -> dict[str, Any]:
        """Give the figures as plain numbers for JSON."""
        return {
            "burn_mps": self.delta_v,
            "transfer_s": self.seconds,
            "transfer_keeps_stand_off": self.keeps_stand_off,
        }


def transfer(scenario: Scenario, distance: Distance, ellipse: Circumnavigation) -> Transfer:
    """Give the cheapest transfer from a scenario's start onto an ellipse, to any place of it.

    Of the coasts tried, those that keep the stand-off go before those that do not. None takes more than a tenth of the
    mission, or begins faster than the chaser may fly.

    Args:
        scenario: its start, orbit, attitude, duration and `inspect.stand_off`.
        distance: exact and unsigned, to the target's mesh, m.
        ellipse: of the same scenario.

    """
    limit = scenario.chaser.speed_limit
    n = float(Surroundings(scenario).motion.orbit.mean_motion)
    start, moving = _in_vvlh(
        scenario, np.asarray(scenario.start.position, float), np.asarray(scenario.start.velocity, float)
    )
    ends, rates = hill_states(n, ellipse.height, ellipse.across, ellipse.tilt, np.linspace(0.0, 2.0 * np.pi, _PLACES))
    longest = _LONGEST * scenario.duration
    shortest = float(np.clip(np.linalg.norm(ends - start, axis=1).min() / limit, scenario.control.period, longest))
    found = []
    for seconds in np.geomspace(shortest, longest, _TRIED).tolist():
        whole = coast_matrix(n, seconds)
        leaving = np.linalg.solve(whole[:3, 3:], (ends - whole[:3, :3] @ start).T).T
        arriving = whole[3:, :3] @ start + leaving @ whole[3:, 3:].T
        first, second = np.linalg.norm(leaving - moving, axis=1), np.linalg.norm(rates - arriving, axis=1)
        keeps = _keeps(scenario, distance, start, leaving, seconds)
        # The longest is told, too, if the start is too far for it.
        slow = (np.linalg.norm(leaving, axis=1) <= limit) | math.isclose(seconds, longest)
        found += [Transfer(float(first[k]), float(second[k]), seconds, bool(keeps[k])) for k in np.flatnonzero(slow)]
    return min(found, key=lambda one: (not one.keeps_stand_off, one.delta_v))


def _keeps(
    scenario: Scenario, distance: Distance, position: Point, velocity: Float[np.ndarray, "n 3"], seconds: float
) -> Bool[np.ndarray, " n"]:
    """Prove of coasts from a place (VVLH) that they keep the stand-off, from the mission's start on."""
    asked = scenario.inspect.stand_off - scenario.chaser.radius
    states = in_body(scenario, 0.0, np.tile(position, (len(velocity), 1)), velocity)
    told = passive_safety(scenario, distance, states, seconds, push=0.0, enough=asked, too_little=asked)
    return told.clearance >= asked


def _in_vvlh(scenario: Scenario, position: Point, velocity: Point) -> tuple[Point, Point]:
    """Give a state of the body frame at the mission's start as seen from VVLH, from the target's centre of mass."""
    motion = Surroundings(scenario).motion
    target = states_at_times(scenario, np.zeros(1), np.zeros((1, 3)), np.zeros((1, 3)))
    one = rows(target, 0)
    turn = np.asarray(matrix(one.attitude))
    turning = np.asarray(one.angular_velocity - matrix(one.attitude) @ motion.orbital_frame(one).angular_velocity)
    from_mass = position - np.asarray(motion.centre_of_mass)
    return turn.T @ from_mass, turn.T @ (velocity + np.cross(turning, from_mass))
