"""Passive safety of legs: how fast a leg may be flown so that a chaser that stops thrusting on it touches nothing.

A leg is judged at its speed from states all along its course. Near its ends, where the chaser gains and loses that
speed, it is judged at every lower speed that is tried too, and from rest at the place that it leads to. The states of a
straight piece lie `_APART` from each other at most, and each stands for all that are nearer to it than half of that:
the tube of its drift (`spread`) holds theirs. So no place of the course is left out. Of speeds only those tried are
judged, and a turn from one leg to the next is not.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from keepout.apps.inspection.passive import passive_safety, states_at_times
from keepout.core.mission.scenario import Scenario

Distance = Callable[[Float[np.ndarray, "points 3"]], Float[np.ndarray, "points"]]
Course = Float[np.ndarray, "corners 3"]

_SPEEDS = (1.0, 0.75, 0.5, 0.375, 0.25, 0.1875, 0.125, 0.09375, 0.0625, 0.046875, 0.03125)
"""Shares of the speed limit at which a leg is judged."""
_APART = 0.2
"""Metres from one judged state of a piece to the next, at most."""
_CHANGING = 1.5
"""Metres from either end of a leg within which it may be flown more slowly than on the rest."""


@dataclass(frozen=True)
class DriftsPlanned:
    """What passive safety made of a plan.

    Attributes:
        legs: of the order that was judged, with those to views that were left out.
        safe: of them that are passively safe at some speed.
        slowed: of these that are safe only below the speed limit.
        views_left_out: views in the order to which no leg was safe.
        candidates_left_out: places tried for views at which rest is not safe.

    """

    legs: int = 0
    safe: int = 0
    slowed: int = 0
    views_left_out: int = 0
    candidates_left_out: int = 0

    def summary(self) -> dict[str, Any]:
        """Give the figures as plain numbers for JSON."""
        return {
            "legs": self.legs,
            "legs_passive_safe": self.safe,
            "legs_slowed": self.slowed,
            "views_left_out_passive": self.views_left_out,
            "candidates_left_out_passive": self.candidates_left_out,
        }


@dataclass(frozen=True, eq=False)
class Drifting:
    """Judges places and legs by the drifts that begin there.

    Attributes:
        scenario: as flown; `inspect.passive_safety` is how long a drift lasts.
        distance: exact and unsigned, to the target's mesh, m.

    """

    scenario: Scenario
    distance: Distance

    @classmethod
    def of(cls, scenario: Scenario, distance: Distance) -> "Drifting | None":
        """Give the judge of a scenario; None where passive safety is not asked for."""
        return cls(scenario, distance) if scenario.inspect.passive_safety > 0.0 else None

    @property
    def slowest(self) -> float:
        """The least speed at which a leg is judged, m/s."""
        return _SPEEDS[-1] * self.scenario.chaser.speed_limit

    def at_rest(self, places: Float[np.ndarray, "n 3"], time: float) -> Bool[np.ndarray, " n"]:
        """Say of places whether a drift from rest there at a time (s) is safe."""
        times = np.full(len(places), time)
        return self._safe(times, np.asarray(places, dtype=float), np.zeros((len(places), 3)), 0.0)

    def speeds(self, courses: Sequence[Course], times: Float[np.ndarray, "legs 2"]) -> Float[np.ndarray, " legs"]:
        """Give the greatest safe speed of each leg, m/s; 0 where none is.

        Args:
            courses: corners of the legs, m.
            times: at which each begins and ends, s: the target is taken as it is in between.

        """
        found, speeds = np.zeros(len(courses)), self.scenario.chaser.speed_limit * np.array(_SPEEDS)
        if not courses:
            return found
        along = [_Along.of(course, *when) for course, when in zip(courses, times.tolist(), strict=True)]
        which = np.repeat(np.arange(len(along)), [len(one.times) for one in along])
        place, ahead, at, gone, left = (
            np.concatenate([getattr(one, name) for one in along])
            for name in ("places", "ahead", "times", "gone", "left")
        )
        changing = np.minimum(gone, left) <= _CHANGING

        def safe(states: Bool[np.ndarray, " n"], speed: float) -> Bool[np.ndarray, " legs"]:
            answer = np.ones(len(courses), dtype=bool)
            answer[which[states][~self._safe(at[states], place[states], speed * ahead[states], 0.5 * _APART)]] = False
            return answer

        up_to = [safe(left <= 0.5 * _APART, 0.0)]
        for speed in reversed(speeds):
            up_to.append(up_to[-1] & safe(changing & up_to[-1][which], speed))
        for speed, near_ends in zip(speeds, reversed(up_to[1:]), strict=True):
            open_ = near_ends & (found == 0.0)
            found[open_ & safe(~changing & open_[which], speed)] = speed
        return found

    def _safe(
        self,
        times: Float[np.ndarray, " n"],
        places: Float[np.ndarray, "n 3"],
        velocities: Float[np.ndarray, "n 3"],
        position_error: float,
    ) -> Bool[np.ndarray, " n"]:
        if not len(places):
            return np.zeros(0, dtype=bool)
        return passive_safety(
            self.scenario,
            self.distance,
            states_at_times(self.scenario, times, places, velocities),
            self.scenario.inspect.passive_safety,
            push=0.0,
            position_error=position_error,
            enough=0.0,
        ).safe


@dataclass(frozen=True, eq=False)
class _Along:
    """States along a course, so dense that each place of a piece is half of `_APART` or less from one of the piece.

    Attributes:
        places: (n, 3) m.
        ahead: (n, 3) unit vectors along the course; 0 where it goes nowhere.
        times: (n,) s.
        gone: (n,) of the course before each, m.
        left: (n,) of it after each, m.

    """

    places: Float[np.ndarray, "n 3"]
    ahead: Float[np.ndarray, "n 3"]
    times: Float[np.ndarray, " n"]
    gone: Float[np.ndarray, " n"]
    left: Float[np.ndarray, " n"]

    @classmethod
    def of(cls, course: Course, begin: float, end: float) -> "_Along":
        # A view for which no light comes is planned for no time.
        begin = begin if math.isfinite(begin) else 0.0
        end = end if math.isfinite(end) else begin
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(course, axis=0), axis=1))])
        whole = float(along[-1])
        if whole == 0.0:
            return cls(course[:1], np.zeros((1, 3)), np.array([begin]), np.zeros(1), np.zeros(1))
        places, ahead, done = [], [], []
        for (low, high), (a, b) in zip(pairwise(along.tolist()), pairwise(course), strict=True):
            if high > low:
                count = math.ceil((high - low) / _APART - 1e-9)
                share = (np.arange(count) + 0.5) / count
                places.append(a + share[:, None] * (b - a))
                ahead.append(np.tile((b - a) / (high - low), (count, 1)))
                done.append(low + share * (high - low))
        gone = np.concatenate(done)
        return cls(
            np.concatenate(places), np.concatenate(ahead), begin + (end - begin) * gone / whole, gone, whole - gone
        )
