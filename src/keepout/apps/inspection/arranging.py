"""Views put in order, those left out that frames on the way make needless, and the rest pulled towards the way."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse

from keepout.apps.inspection.cover import greedy_cover
from keepout.apps.inspection.itinerary import DrawnUp, LegsKnown, Start, drawn_up, first_seen, legs_of
from keepout.apps.inspection.lit_times import LitTimes
from keepout.apps.inspection.problem import Problem
from keepout.apps.inspection.pulled import pulled
from keepout.apps.inspection.tour import Tour, best_tour, flown
from keepout.apps.inspection.viewpoints import Views
from keepout.apps.inspection.ways import Ways
from keepout.core.progress import Progress

INSIDE = 0.02
"""Metres by which candidates keep more than the stand-off."""
_LED = 0.17
"""The same of views that are pulled: so much that the law leads to the very place."""
_PULLS = 4
"""Times that views are pulled towards the way, at most."""
_WORTH = 0.01
"""Share of the tour's cost that pulling must spare to be done again."""
_MENDS = 3
"""Times that views are added where frames on the way show less than before."""
_FEW = 0.02
"""Share of the views below which leaving out so many is the last time."""
_ASIDE = 0.03
"""Of what may be missed, what is added beyond what is missing."""
_SLACK = 0.2
"""Of what may be missed, what is kept back each time that happened."""
_MISSED = 3
"""Times that leaving views out may lose what frames on the way saw, before the rest stay."""


@dataclass(frozen=True, eq=False)
class Arranged:
    """Views with the ways between them, in order.

    Attributes:
        views: rows in no order.
        between: lengths and directions of the ways between the start and the views, in the order of rows.
        tour: their order.
        drawn: the plan and its legs.

    """

    views: Views
    between: tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "n n 3"]]
    tour: Tour
    drawn: DrawnUp


class Arranger:
    """Orders views, leaves out those that frames on the way make needless, and pulls the rest towards the way."""

    def __init__(
        self,
        problem: Problem,
        candidates: Views,
        lit: LitTimes,
        areas: Float[np.ndarray, " units"],
        goal: float,
        ways: Ways,
        start: Start,
        progress: Progress,
    ) -> None:
        self.candidates = candidates
        self.problem, self.lit, self.areas, self.goal = problem, lit, areas, goal
        self.ways, self.start, self.progress = ways, start, progress
        self.known = LegsKnown()

    def arranged(self, views: Views) -> Arranged:
        """Give the best found of views, starting from an order from nearest to nearest."""
        best = self._fewer(self._mended(self._ordered(views, self._between(views), None)))
        settled = self._mended(self._ordered(best.views, best.between, best.tour.order))
        if self._enough(settled, best) and self._cost(settled) < self._cost(best):
            best = settled
        # A place that a view is pulled to is not known to be safe to rest at.
        for _ in range(0 if self.problem.scenario.inspect.passive_safety > 0.0 else _PULLS):
            views = pulled(
                self.problem,
                best.views,
                best.tour,
                best.drawn,
                self.lit,
                self.ways,
                self.start,
                self.areas,
                self.goal,
                inside=self.problem.scenario.inspect.stand_off + _LED,
            )
            nearer = self._ordered(views, self._between(views), best.tour.order)
            nearer = self._fewer(self._mended(nearer))
            if not self._enough(nearer, best) or self._cost(nearer) >= self._cost(best):
                break
            gained = self._cost(best) - self._cost(nearer)
            best = nearer
            if gained < _WORTH * self._cost(best):
                break
        return best

    def in_order(self, rows: Int[np.ndarray, " k"]) -> Arranged:
        """Give candidates in the order of their rows."""
        views = self.candidates.only(rows)
        between, order = self._between(views), np.arange(len(rows)) + 1
        needs = first_seen(views.sees, order - 1, self.areas)
        tour = flown(legs_of(self.problem, views, needs, self.lit, self.start, between), order)
        drawn = drawn_up(self.problem, views, self.lit, tour, self.ways, self.start, self.areas, self.known)
        return Arranged(views, between, tour, drawn)

    def _between(self, views: Views) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "n n 3"]]:
        return self.ways.lengths(np.concatenate([self.start.position[None], views.positions]), self.known.lengths)

    def _ordered(
        self,
        views: Views,
        between: tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "n n 3"]],
        begin: Int[np.ndarray, " k"] | None,
        *,
        shaken: bool = True,
    ) -> Arranged:
        inspect = self.problem.scenario.inspect
        needs = first_seen(views.sees, np.arange(len(views.positions)), self.areas)
        legs = legs_of(self.problem, views, needs, self.lit, self.start, between)
        tour = best_tour(
            legs,
            inspect.objective,
            worth=inspect.delta_v_worth,
            seed=self.problem.scenario.seed,
            begin=begin,
            shaken=shaken,
        )
        drawn = drawn_up(self.problem, views, self.lit, tour, self.ways, self.start, self.areas, self.known)
        self.progress(0.5, f"{len(drawn.plan.views)} views, {drawn.plan.way_length:.0f} m")
        return Arranged(views, between, tour, drawn)

    def _mended(self, one: Arranged) -> Arranged:
        """Add candidates that see what is missing: frames on the way show other things in another order."""
        for _ in range(_MENDS):
            missing = self.goal - self._seen(one)
            if missing <= 0.0 or len(one.views.positions) >= self.problem.scenario.inspect.most_views:
                break
            left = self.areas * ~one.drawn.plan.covered
            asked = missing + _ASIDE * (float(self.areas.sum()) - self.goal)
            extra = greedy_cover(self.candidates.sees, left, min(asked, float(left.sum())))
            room = self.problem.scenario.inspect.most_views - len(one.views.positions)
            if len(extra) == 0:
                break
            number = len(one.views.positions)
            views = one.views.and_those(self.candidates.only(extra[:room]))
            order = np.concatenate([one.tour.order, np.arange(number, len(views.positions)) + 1])
            one = self._ordered(views, self._between(views), order, shaken=False)
        return one

    def _fewer(self, best: Arranged) -> Arranged:
        """Leave views out as long as the rest see enough."""
        goal, missed = min(self.goal, self._seen(best)), 0
        while missed < _MISSED:
            keep = _needed(best.views.sees, best.tour, self.lit, best.drawn.passing, self.areas, goal)
            if keep.all():
                break
            rows = np.flatnonzero(keep)
            number = np.cumsum(keep)
            order = np.array([number[row - 1] for row in best.tour.order if keep[row - 1]], dtype=np.int64)
            # Hardly another order: what frames on the way saw stays.
            fewer = self._mended(self._ordered(*_kept(best.views, best.between, rows), order, shaken=False))
            if self._enough(fewer, best) and len(fewer.tour.order) < len(best.tour.order):
                left_out = len(best.tour.order) - len(fewer.tour.order)
                best = fewer
                if left_out < _FEW * len(best.tour.order):
                    break
            else:
                # Frames on the way see other things in another order: leave out less.
                goal += _SLACK * (float(self.areas.sum()) - self.goal)
                missed += 1
        return best

    def _seen(self, one: Arranged) -> float:
        return float(self.areas[one.drawn.plan.covered].sum())

    def _enough(self, one: Arranged, like: Arranged) -> bool:
        return self._seen(one) >= min(self.goal, self._seen(like)) * (1.0 - 1e-12)

    def _cost(self, one: Arranged) -> float:
        inspect = self.problem.scenario.inspect
        return one.tour.cost(inspect.objective, inspect.delta_v_worth) - self.start.time


def _kept(
    views: Views, between: tuple[np.ndarray, np.ndarray], rows: Int[np.ndarray, " k"]
) -> tuple[Views, tuple[np.ndarray, np.ndarray]]:
    both = np.concatenate([[0], rows + 1])
    return views.only(rows), (between[0][np.ix_(both, both)], between[1][np.ix_(both, both)])


def _needed(
    sees: sparse.csr_array,
    tour: Tour,
    lit: LitTimes,
    passing: list[Int[np.ndarray, " _"]],
    areas: Float[np.ndarray, " units"],
    goal: float,
) -> Bool[np.ndarray, " v"]:
    """Say which views are needed, given what other legs than the two that would change with a view see."""
    rows = tour.order - 1
    shown = [
        (units := sees.indices[sees.indptr[row] : sees.indptr[row + 1]])[lit.at(float(at))[units]]
        for row, at in zip(rows, tour.times, strict=True)
    ]
    times = np.zeros(len(areas), dtype=np.int64)
    for units in [*shown, *passing]:
        times[units] += 1
    seen = float(areas[times > 0].sum())
    keep = np.ones(len(rows), dtype=bool)
    touched = np.zeros(len(rows) + 2, dtype=bool)
    alone = []
    for n in range(len(rows)):
        less = times.copy()
        for units in (shown[n], *passing[n : n + 2]):
            less[units] -= 1
        alone.append(float(areas[(times > 0) & (less <= 0)].sum()))
    for n in np.argsort(alone):
        less = times.copy()
        for units in (shown[n], *passing[n : n + 2]):
            less[units] -= 1
        lost = float(areas[(times > 0) & (less <= 0)].sum())
        if touched[n : n + 3].any() or seen - lost < goal or keep.sum() <= 1:
            continue
        times, seen, keep[n] = less, seen - lost, False
        touched[n + 1] = True
    answer = np.ones(len(rows), dtype=bool)
    answer[rows[~keep]] = False
    return answer
