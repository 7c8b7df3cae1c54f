"""A tour in a light that moves: what is looked at is chosen together with when.

With a sun that turns and sets, a view is worth what of it is lit at the moment, and no order is good at another time.
So the tour is made forward in time. From where the chaser is, each view is judged at the moments from its arrival on:
by the area that it would newly show then, over the time until then, and what is lit only for a little longer counts for
more. Where Δv counts, what is divided by is not the time alone (`light_cost`). This greedy tour is then improved: from
a random view on it is made again, with other weights and some chance, and what sees more, or as much at less cost, is
kept.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse

from keepout.apps.inspection.light_cost import Cost, Departures
from keepout.apps.inspection.lit_times import LitTimes
from keepout.apps.inspection.tour import turning_time
from keepout.apps.inspection.viewpoints import Views

_AHEAD = 12
"""Moments from the arrival on at which a view is judged."""
_SCARCITY = (0.0, 0.3, 0.6, 0.9, 1.2)
"""Powers of the light left of a unit by which its area is divided; each makes a greedy tour."""
_SETTLE = 20.0
"""Seconds added to every leg when views are compared: a near view that shows little is not free."""
_CHANCE = (0.0, 0.1, 0.3)
"""Spread of the logarithm of a view's worth when a tour is made again."""
_IN_VAIN = 400
"""Tours made again without one that is better, after which the search ends."""
_LEAST = 1e-4
"""Of what is to be seen, the share below which a view is not worth a leg."""

Lengths = Callable[[int], Float[np.ndarray, " v"]]
"""Lengths (m) of the ways from a view, by its row, or from the start, -1, to all views; infinite where none leads."""


@dataclass(frozen=True)
class Pace:
    """How fast a chaser goes and a camera turns.

    Attributes:
        speed: m/s.
        acceleration: m/s².
        turn_rate: rad/s.
        turn_acceleration: rad/s².
        dwell: at every view, s.

    """

    speed: float
    acceleration: float
    turn_rate: float
    turn_acceleration: float
    dwell: float


@dataclass(frozen=True, eq=False)
class LightTour:
    """Views in order, and when each is worth what it shows.

    Attributes:
        rows: (k,) of the views.
        times: (k,) on arrival or later, when the light is better, s.
        end: s.
        area: that the views show in time, m².
        delta_v: with the stop at the end, m/s.

    """

    rows: Int[np.ndarray, " k"]
    times: Float[np.ndarray, " k"]
    end: float
    area: float
    delta_v: float


class _Moments:
    """What is lit at each of the times, and how much light is left to each unit after it."""

    def __init__(self, lit: LitTimes) -> None:
        self.times = lit.times
        # Between two times that is lit which is lit at both: here it counts from the first of them on.
        self.lit = lit.lit.copy()
        self.lit[:-1] &= lit.lit[1:]
        step = float(lit.times[1] - lit.times[0]) if len(lit.times) > 1 else 1.0
        self.step = step
        self.remaining = np.cumsum(self.lit[::-1], axis=0, dtype=np.int32)[::-1]
        anything: Bool[np.ndarray, " t"] = np.any(self.lit, axis=1)
        following = np.full(len(anything) + 1, len(anything))
        for n in range(len(anything) - 1, -1, -1):
            following[n] = n if anything[n] else following[n + 1]
        self.next_light = following


def tour_in_light(
    views: Views,
    lit: LitTimes,
    areas: Float[np.ndarray, " units"],
    goal: float,
    lengths: Lengths,
    looking: Float[np.ndarray, "3"],
    pace: Pace,
    begin: float,
    *,
    start: Float[np.ndarray, "3"],
    cost: Cost,
    most_views: int,
    tries: int,
    seed: int = 0,
) -> LightTour:
    """Choose views, their order and their times, so that as much as is wanted is seen, at the least cost.

    Args:
        views: to choose from.
        lit: when what is lit.
        areas: (units,) m², 0 for what is not wanted.
        goal: m² to be seen.
        lengths: of ways.
        looking: (3,) where the camera looks at the start.
        pace: of chaser and camera.
        begin: s.
        start: (3,) where the chaser is, at rest, m.
        cost: what is made least.
        most_views: in the tour.
        tries: how often a tour is made again to improve it, at most.
        seed: of the chance in it.

    """
    asked = areas > 0.0
    views = replace(views, sees=sparse.csr_array(views.sees[:, asked]))
    lit, areas = replace(lit, lit=lit.lit[:, asked]), areas[asked]
    generator = np.random.default_rng(seed)
    maker = _Maker(views, _Moments(lit), areas, goal, lengths, looking, pace, begin, most_views, start, cost)
    best = max((maker.made((), scarcity, 0.0, generator) for scarcity in _SCARCITY), key=maker.score)
    in_vain = 0
    for _ in range(tries):
        if not len(best.rows) or in_vain >= _IN_VAIN:
            break
        cut = int(generator.integers(len(best.rows)))
        kept = tuple(zip(best.rows[:cut].tolist(), best.times[:cut].tolist(), strict=True))
        tried = maker.made(
            kept, float(generator.choice(_SCARCITY)), float(generator.choice(_CHANCE)), generator, int(best.rows[cut])
        )
        in_vain += 1
        if maker.score(tried) > maker.score(best):
            best, in_vain = tried, 0
    return best


class _Maker:
    """Makes tours forward in time."""

    def __init__(
        self,
        views: Views,
        moments: _Moments,
        areas: Float[np.ndarray, " units"],
        goal: float,
        lengths: Lengths,
        looking: Float[np.ndarray, "3"],
        pace: Pace,
        begin: float,
        most_views: int,
        start: Float[np.ndarray, "3"],
        cost: Cost,
    ) -> None:
        self.views, self.moments, self.areas, self.goal = views, moments, areas, goal
        self.lengths, self.looking, self.pace, self.begin, self.most_views = lengths, looking, pace, begin, most_views
        self.start, self.cost = start, cost
        self.indptr, self.indices = views.sees.indptr.astype(np.int64), views.sees.indices.astype(np.int64)

    def score(self, tour: LightTour) -> tuple[float, float]:
        """Say how good a tour is: by what it shows, no more than is wanted, and then by what it costs."""
        return min(tour.area, self.goal * (1.0 - 1e-9)), -self.cost.whole(tour.end - self.begin, tour.delta_v)

    def made(
        self,
        kept: tuple[tuple[int, float], ...],
        scarcity: float,
        chance: float,
        generator: np.random.Generator,
        barred: int = -1,
    ) -> LightTour:
        """Make a tour: some views at their times, then by greed; the first of these is not the view barred."""
        moments, pace = self.moments, self.pace
        left = self.areas.copy()
        rows, times = [row for row, _ in kept], [at for _, at in kept]
        now, here, moving, delta_v = self.begin, -1, np.zeros(3), 0.0
        for row, at in kept:
            self._strike(left, row, at)
            spent, moving = self._flown(self._departures(here, now, moving, np.array([row])), 0, at, moving)
            now, here, delta_v = at + pace.dwell, row, delta_v + spent
        whole = float(self.areas.sum())
        while whole - float(left.sum()) < self.goal and len(rows) < self.most_views:
            legs = self._departures(here, now, moving, np.arange(len(self.views.positions)))
            arrival = legs.arrival
            first = np.ceil((arrival - moments.times[0]) / moments.step - 1e-9)
            first = np.where(np.isfinite(first), first, len(moments.times)).astype(np.int64)
            row = min(max(int((now - moments.times[0]) / moments.step), 0), len(moments.times) - 1)
            worth = left * (1.0 + moments.remaining[row]) ** -scarcity
            gains = np.exp(chance * generator.standard_normal(len(arrival)))
            if len(rows) == len(kept) and barred >= 0:
                gains[barred] = 0.0
            view, at = self._best(left, worth, first, now, gains, legs)
            if view < 0:
                break
            now = max(float(moments.times[at]), float(arrival[view]))
            spent, moving = self._flown(legs, view, now, moving)
            delta_v += spent
            rows.append(int(view))
            times.append(now)
            self._strike(left, int(view), now)
            now += pace.dwell
            here = int(view)
        return LightTour(
            np.array(rows, dtype=np.int64),
            np.array(times, dtype=np.float64),
            now,
            whole - float(left.sum()),
            delta_v + float(np.linalg.norm(moving)),
        )

    def _departures(
        self, here: int, now: float, moving: Float[np.ndarray, "3"], rows: Int[np.ndarray, " v"]
    ) -> Departures:
        """Give the legs from a view, or the start, to some."""
        pace, views = self.pace, self.views
        looking, place = (self.looking, self.start) if here < 0 else (views.boresights[here], views.positions[here])
        turns = turning_time(looking[None], views.boresights[rows], pace.turn_rate, pace.turn_acceleration)[0]
        way = self.lengths(here)[rows]
        taken = np.maximum(way / pace.speed, turns)
        arrival = now + taken + np.minimum(way, 1.0) * pace.speed / pace.acceleration
        stays = rows == here
        return Departures.of(
            np.where(stays, now, arrival),
            np.where(stays, 0.0, way),
            taken,
            views.positions[rows] - place,
            moving,
        )

    def _flown(
        self, legs: Departures, view: int, at: float, moving: Float[np.ndarray, "3"]
    ) -> tuple[float, Float[np.ndarray, "3"]]:
        """Give the Δv of a leg to a view that is worth something at a time, and the velocity after it."""
        if self.pace.dwell > 0.0 or at > float(legs.arrival[view]) + self.moments.step:
            return float(legs.change[view] + legs.stop[view]), np.zeros(3)
        return float(legs.change[view]), legs.velocity[view]

    def _best(
        self,
        left: Float[np.ndarray, " units"],
        worth: Float[np.ndarray, " units"],
        first: Int[np.ndarray, " v"],
        now: float,
        gains: Float[np.ndarray, " v"],
        legs: Departures,
    ) -> tuple[int, int]:
        """Give the view to go to next and the moment of it, or -1; later moments count where none soon shows enough."""
        moments, least, soonest = self.moments, _LEAST * float(self.areas.sum()), 0
        enough: Bool[np.ndarray, " t"] | None = None
        while soonest < len(moments.times):
            view, at = _next_view(
                self.indptr,
                self.indices,
                left,
                worth,
                moments.lit,
                moments.next_light,
                np.clip(first, soonest, len(moments.times)),
                moments.times,
                now,
                gains,
                _AHEAD,
                _SETTLE,
                least,
                (legs.arrival, legs.base(self.pace.speed), legs.stop, moments.step),
                (self.cost.seconds, self.cost.delta_v),
            )
            if view >= 0:
                return int(view), int(at)
            if enough is None:
                enough = moments.lit @ left >= least
                soonest = int(first.min())
            later = np.flatnonzero(enough[soonest + _AHEAD :])
            if not len(later):
                break
            soonest += _AHEAD + int(later[0])
        return -1, -1

    def _strike(self, left: Float[np.ndarray, " units"], row: int, at: float) -> None:
        moments = self.moments
        n = min(max(int((at - moments.times[0]) / moments.step + 1e-6), 0), len(moments.times) - 1)
        units = self.indices[self.indptr[row] : self.indptr[row + 1]]
        left[units[moments.lit[n, units]]] = 0.0


@numba.njit(cache=True)
@no_type_check
def _next_view(
    indptr, indices, left, worth, lit, next_light, first, times, now, gains, ahead, settle, least, legs, prices
):
    """Give the view and the moment with the most worth for its cost, or -1."""
    arrival, change, stop, step = legs
    of_seconds, of_delta_v = prices
    best, best_view, best_at = 0.0, -1, -1
    for view in range(len(first)):
        if gains[view] <= 0.0:
            continue
        begin = next_light[first[view]]
        for at in range(begin, min(begin + ahead, len(times))):
            area, value = 0.0, 0.0
            for place in range(indptr[view], indptr[view + 1]):
                unit = indices[place]
                if left[unit] > 0.0 and lit[at, unit]:
                    area += left[unit]
                    value += worth[unit]
            spent = change[view] + (stop[view] if times[at] > arrival[view] + step else 0.0)
            rate = gains[view] * value / (of_seconds * (times[at] - now + settle) + of_delta_v * spent)
            if area >= least and rate > best:
                best, best_view, best_at = rate, view, at
    return best_view, best_at
