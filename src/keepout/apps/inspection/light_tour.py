"""A tour in a light that moves: what is looked at is chosen together with when.

With a sun that turns and sets, a view is worth what of it is lit at the moment, and no order is good at another time.
So the tour is made forward in time. From where the chaser is, each view is judged at the moments from its arrival on:
by the area that it would newly show then, over the time until then, and what is lit only for a little longer counts for
more. Where Δv counts, what is divided by is not the time alone (`weights`). This greedy tour is then improved: from a
random view on it is made again, with other weights and some chance, and what sees more, or as much at less cost, is
kept.

A leg sets out straight towards its view and keeps one speed. At a view the velocity changes to that of the next leg;
where the chaser waits for light or stays, it stops and sets out anew (`tour`).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse

from keepout.apps.inspection.candidates import Views
from keepout.apps.inspection.cover import fewest_views, shortlist
from keepout.apps.inspection.plan import InspectionPlan, Task
from keepout.apps.inspection.seeing.patches import Areas
from keepout.apps.inspection.tour import Tour, weights
from keepout.core.cores import kernel
from keepout.core.geometry.distance import Point
from keepout.core.progress import Progress

_BASE = 0.2
"""Share of the speed that every leg costs in Δv when views are compared: one straight ahead is not free."""
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
_AMONG = 1500
"""Views that a tour is made from, about."""
_BOUND = 0.1
"""Share of the usual work that goes into the bound on the number of views."""
_TRIES = 1500
"""Tours made again, at most, and usually."""
_TAKEN = 0.9
"""Share of the speed limit at which a tour is made: a law slows down for corners and near the target."""

Stops = tuple[tuple[int, float], ...]
"""Rows of views, and the times at which they are worth something, s."""


@dataclass(frozen=True, eq=False)
class LightTour(Tour):
    """Views in order, row 1 the first of them, and when each is worth what it shows.

    Attributes:
        area: that the views show in time, m².

    """

    area: float


class _Legs(NamedTuple):
    """The legs from where a chaser is to some views.

    Attributes:
        arrival: s; infinite where no way leads.
        velocity: on the leg, m/s.
        change: from the velocity before to that of the leg, m/s.
        stop: from that of the leg to rest, m/s.

    """

    arrival: Float[np.ndarray, " v"]
    velocity: Float[np.ndarray, "v 3"]
    change: Float[np.ndarray, " v"]
    stop: Float[np.ndarray, " v"]


@dataclass(eq=False)
class LightTours:
    """Makes tours forward in time: views, their order and their times, so that as much as is wanted is seen.

    Attributes:
        task: what is wanted, when what is lit, and where and when a tour begins, at rest.
        views: to choose from.
        lengths: (m) of the ways from a view, by its row, or from the start, -1, to all views; infinite without a way.

    """

    task: Task
    views: Views
    lengths: Callable[[int], Float[np.ndarray, " v"]]

    def __post_init__(self) -> None:
        task, chaser, inspect = self.task, self.task.scenario.chaser, self.task.scenario.inspect
        self._speed, self._acceleration = _TAKEN * chaser.speed_limit, chaser.force_limit / chaser.mass
        self._prices = weights(inspect.objective, inspect.delta_v_worth, side=0.0)
        wanted = task.areas > 0.0
        sees, lit = sparse.csr_array(self.views.sees[:, wanted]), task.lit.lit[:, wanted]
        self._areas, self._indptr, self._indices = task.areas[wanted], sees.indptr.astype(np.int64), sees.indices
        self._indices = self._indices.astype(np.int64)
        self._times = task.lit.times
        self._step = float(self._times[1] - self._times[0]) if len(self._times) > 1 else 1.0
        # Between two times that is lit which is lit at both: here it counts from the first of them on.
        self._lit = lit.copy()
        self._lit[:-1] &= lit[1:]
        self._remaining = np.cumsum(self._lit[::-1], axis=0, dtype=np.int32)[::-1]
        anything: Bool[np.ndarray, " t"] = np.any(self._lit, axis=1)
        bright = np.where(np.append(anything, True), np.arange(len(anything) + 1), len(anything))
        self._next_light = np.minimum.accumulate(bright[::-1])[::-1]

    def best(self, tries: int, *, seed: int = 0) -> LightTour:
        """Give the best tour found: as much as is wanted is seen, at the least cost.

        Args:
            tries: how often a tour is made again to improve it, at most.
            seed: of the chance in it.

        """
        generator = np.random.default_rng(seed)
        best = max((self._made((), scarcity, 0.0, generator) for scarcity in _SCARCITY), key=self._score)
        in_vain = 0
        for _ in range(tries):
            if not len(best.order) or in_vain >= _IN_VAIN:
                break
            rows = (best.order - 1).tolist()
            cut = int(generator.integers(len(rows)))
            kept = tuple(zip(rows[:cut], best.times[:cut].tolist(), strict=True))
            scarcity, chance = float(generator.choice(_SCARCITY)), float(generator.choice(_CHANCE))
            tried = self._made(kept, scarcity, chance, generator, rows[cut])
            in_vain += 1
            if self._score(tried) > self._score(best):
                best, in_vain = tried, 0
        return best

    def _score(self, tour: LightTour) -> tuple[float, float]:
        """Say how good a tour is: by what it shows, no more than is wanted, and then by what it costs."""
        of_seconds, of_delta_v = self._prices
        cost = of_seconds * (tour.end - self.task.time) + of_delta_v * tour.delta_v
        return min(tour.area, self.task.goal * (1.0 - 1e-9)), -cost

    def _made(
        self, kept: Stops, scarcity: float, chance: float, generator: np.random.Generator, barred: int = -1
    ) -> LightTour:
        """Make a tour: some views at their times, then by greed; the first of these is not the view barred."""
        left, inspect = self._areas.copy(), self.task.scenario.inspect
        rows, times = [row for row, _ in kept], [at for _, at in kept]
        now, here, moving, delta_v = self.task.time, -1, np.zeros(3), 0.0
        for row, at in kept:
            self._strike(left, row, at)
            spent, moving = self._flown(self._legs(here, now, moving, np.array([row])), 0, at)
            now, here, delta_v = at + inspect.dwell, row, delta_v + spent
        whole = float(self._areas.sum())
        while whole - float(left.sum()) < self.task.goal and len(rows) < inspect.most_views:
            legs = self._legs(here, now, moving, np.arange(len(self.views.positions)))
            row = min(max(int((now - self._times[0]) / self._step), 0), len(self._times) - 1)
            worth = left * (1.0 + self._remaining[row]) ** -scarcity
            gains = np.exp(chance * generator.standard_normal(len(legs.arrival)))
            if len(rows) == len(kept) and barred >= 0:
                gains[barred] = 0.0
            view, at = self._best(left, worth, now, gains, legs)
            if view < 0:
                break
            now = max(float(self._times[at]), float(legs.arrival[view]))
            spent, moving = self._flown(legs, view, now)
            delta_v += spent
            rows.append(view)
            times.append(now)
            self._strike(left, view, now)
            now, here = now + inspect.dwell, view
        shown, delta_v = whole - float(left.sum()), delta_v + float(np.linalg.norm(moving))
        order = np.array(rows, dtype=np.int64) + 1
        return LightTour(order, np.array(times, dtype=np.float64), now, delta_v, shown)

    def _legs(self, here: int, now: float, moving: Point, rows: Int[np.ndarray, " v"]) -> _Legs:
        """Give the legs from a view, or the start, to some, of a chaser that moves so (m/s)."""
        task, views = self.task, self.views
        place, looking = (
            (task.position, task.boresight) if here < 0 else (views.positions[here], views.boresights[here])
        )
        way = self.lengths(here)[rows]
        taken = np.maximum(way / self._speed, task.turns(looking[None], views.boresights[rows])[0])
        arrival = now + taken + np.minimum(way, 1.0) * self._speed / self._acceleration
        stays = rows == here
        way = np.where(stays, 0.0, way)
        reached: Bool[np.ndarray, " v"] = np.isfinite(way)
        speed = np.where(reached, way, 0.0) / np.where(reached, np.maximum(taken, 1e-9), 1.0)
        ahead = views.positions[rows] - place
        velocity = (speed / np.maximum(np.linalg.norm(ahead, axis=1), 1e-9))[:, None] * ahead
        change, stop = np.linalg.norm(velocity - moving, axis=1), np.linalg.norm(velocity, axis=1)
        return _Legs(np.where(stays, now, arrival), velocity, change, stop)

    def _flown(self, legs: _Legs, view: int, at: float) -> tuple[float, Point]:
        """Give the Δv of a leg to a view that is worth something at a time, and the velocity after it."""
        if self.task.scenario.inspect.dwell > 0.0 or at > float(legs.arrival[view]) + self._step:
            return float(legs.change[view] + legs.stop[view]), np.zeros(3)
        return float(legs.change[view]), legs.velocity[view]

    def _best(
        self, left: Areas, worth: Areas, now: float, gains: Float[np.ndarray, " v"], legs: _Legs
    ) -> tuple[int, int]:
        """Give the view to go to next and the moment of it, or -1; later moments count where none soon shows enough."""
        times, least, soonest = self._times, _LEAST * float(self._areas.sum()), 0
        first = np.ceil((legs.arrival - times[0]) / self._step - 1e-9)
        first = np.where(np.isfinite(first), first, len(times)).astype(np.int64)
        shown = self._indptr, self._indices, left, worth, self._lit
        spent = legs.arrival, legs.change + _BASE * self._speed, legs.stop, self._step
        enough: Bool[np.ndarray, " t"] | None = None
        while soonest < len(times):
            begins = self._next_light[np.clip(first, soonest, len(times))]
            view, at = _next_view(shown, begins, times, now, gains, least, spent, self._prices)
            if view >= 0:
                return int(view), int(at)
            if enough is None:
                enough = self._lit @ left >= least
                soonest = int(first.min())
            later = np.flatnonzero(enough[soonest + _AHEAD :])
            if not len(later):
                break
            soonest += _AHEAD + int(later[0])
        return -1, -1

    def _strike(self, left: Areas, row: int, at: float) -> None:
        n = min(max(int((at - self._times[0]) / self._step + 1e-6), 0), len(self._times) - 1)
        units = self._indices[self._indptr[row] : self._indptr[row + 1]]
        left[units[self._lit[n, units]]] = 0.0


@kernel()
def _next_view(shown, begins, times, now, gains, least, legs, prices):
    """Give the view and the moment with the most worth for its cost, or -1."""
    indptr, indices, left, worth, lit = shown
    arrival, change, stop, step = legs
    of_seconds, of_delta_v = prices
    best, best_view, best_at = 0.0, -1, -1
    for view in range(len(begins)):
        if gains[view] <= 0.0:
            continue
        for at in range(begins[view], min(begins[view] + _AHEAD, len(times))):
            area, value = 0.0, 0.0
            for place in range(indptr[view], indptr[view + 1]):
                unit = indices[place]
                if left[unit] > 0.0 and lit[at, unit]:
                    area += left[unit]
                    value += worth[unit]
            spent = change[view] + (stop[view] if times[at] > arrival[view] + step else 0.0)
            rate = gains[view] * value / (of_seconds * (times[at] - now + _SETTLE) + of_delta_v * spent)
            if area >= least and rate > best:
                best, best_view, best_at = rate, view, at
    return best_view, best_at


def plan_in_light(task: Task, views: Views, progress: Progress) -> InspectionPlan:
    """Plan views together with their times; the bound on their number is that of the same views in any light.

    Args:
        task: what is to be planned.
        views: candidates.
        progress: told of the tour.

    """
    scenario, found = task.scenario, len(views.positions)
    views = views.only(shortlist(views.sees, task.areas, _AMONG))
    made = LightTours(task, views, task.nearly(views)).best(round(task.effort * _TRIES), seed=scenario.seed)
    progress(0.6, f"{len(made.order)} views show {made.area:.1f} m2 in time")
    effort = _BOUND * task.effort
    bound = fewest_views(views.sees, task.areas, min(task.goal, made.area), effort=effort, seed=scenario.seed)
    # A view may be flown to twice, each time as a row of its own.
    tour = replace(made, order=np.arange(1, len(made.order) + 1))
    return replace(
        task.drawn_up(views.only(made.order - 1), tour, task.drifting).plan,
        candidates=found,
        short_list=len(views.positions),
        fewest_views=min(bound.fewest, len(made.order)),
        greedy_views=bound.greedy,
    )
