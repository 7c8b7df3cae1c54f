"""A plan of an inspection: few views that see enough, in a good order.

The number of views is made least first, then what the objective says: their order, by time, Δv or both. Frames on the
way see more than the views were chosen for; views that become needless by that are left out.

A candidate is a place that shows much, wherever that is. In a tour a view has to show only what nothing else shows,
and that may be seen from nearer the way, too. So each view is moved towards the line between its neighbours, and looks
at the middle of what it alone shows, as long as enough is seen.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from keepout.apps.inspection.candidates import Views, aim, candidates, table_of
from keepout.apps.inspection.cover import fewest_views, greedy_cover, shortlist
from keepout.apps.inspection.light import LitTimes
from keepout.apps.inspection.light_tour import plan_in_light
from keepout.apps.inspection.plan import Between, DrawnUp, InspectionPlan, Task
from keepout.apps.inspection.problem import Problem, boresight_of
from keepout.apps.inspection.seeing.patches import Areas, Marks, Units
from keepout.apps.inspection.tour import Tour, best_tour
from keepout.apps.inspection.ways import way_length
from keepout.core.geometry.distance import Point
from keepout.core.progress import Progress, part_of, silent


def plan(
    problem: Problem,
    *,
    position: Point,
    time: float,
    wanted: Marks,
    share: float | None = None,
    boresight: Point | None = None,
    effort: float = 1.0,
    progress: Progress = silent,
) -> InspectionPlan:
    """Plan views that see a share of the area wanted, few of them, and their order.

    Args:
        problem: what there is to be seen, and from where.
        position: (3,) where the chaser is, m, body frame.
        time: s.
        wanted: (units,) to be seen; `covered` of the plan holds none but these.
        share: of their area that is wanted; `inspect.coverage` of the scenario if absent.
        boresight: (3,) where the camera looks; if absent, as at the start of the mission.
        effort: of the usual counted work for the choice of views, how much is spent.
        progress: told of candidates, views and bound.

    """
    scenario = problem.scenario
    share = scenario.inspect.coverage if share is None else share
    wanted = wanted & problem.patches.counted
    areas = problem.patches.unit_areas() * wanted
    if not areas.any():
        return InspectionPlan((), np.zeros_like(wanted), 0.0, 0.0, 0, 0, 0)
    lit = LitTimes.of(problem.camera, wanted, time, max(scenario.duration, time), scenario.camera.period)
    views, unsafe = candidates(problem, wanted & lit.lit.any(axis=0), time, progress=part_of(progress, 0.0, 0.5))
    position = np.asarray(position, dtype=np.float64)
    boresight = boresight_of(scenario, problem.target).direction if boresight is None else boresight
    ways, goal = problem.ways_from(position), share * float(areas.sum())
    task, rest = Task(problem, lit, areas, goal, ways, position, boresight, time, effort), part_of(progress, 0.5, 1.0)
    result = (plan_in_light if lit.changes else _fewest_in_order)(task, views, rest)
    progress(1.0, f"{len(result.views)} views, {result.way_length:.0f} m")
    drifts = None if result.drifts is None else replace(result.drifts, candidates_left_out=unsafe)
    return replace(result, drifts=drifts)


def _fewest_in_order(task: Task, views: Views, progress: Progress) -> InspectionPlan:
    """Choose the fewest views, as many as are allowed at most, and then their order."""
    problem, scenario = task.problem, task.scenario
    if task.ways is problem.ways:
        task = replace(task, ways=problem.fine_ways)
    places, at = np.unique(views.positions, axis=0, return_inverse=True)
    views = views.only(np.flatnonzero(task.ways.reached(task.position, places)[at.ravel()]))
    found = len(views.positions)
    views = views.only(shortlist(views.sees, task.areas))
    work = {"effort": task.effort, "seed": scenario.seed, "progress": part_of(progress, 0.0, 0.6)}
    cover = fewest_views(views.sees, task.areas, task.goal, **work)
    arranger = Arranger(task, views, part_of(progress, 0.6, 1.0))
    best = arranger.arranged(views.only(cover.chosen[: scenario.inspect.most_views]))
    if best.drawn.plan.views and best.tour.end > scenario.duration:
        best = in_short_time(arranger, best)
    result = best.drawn.plan
    if task.drifting is not None:
        result = task.drawn_up(best.views, best.tour, task.drifting).plan
    counts = {"candidates": found, "short_list": len(views.positions), "fewest_views": cover.fewest}
    return replace(result, **counts, greedy_views=cover.greedy)


_LED = 0.17
"""Metres by which views that are pulled keep more than the stand-off: so much that the law leads to the very place."""
_SHARES = (1.0, 0.6, 0.3)
"""Of the way to the line between the neighbours, by which a view is pulled: the first that does."""
_LEAST = 0.1
"""Metres that a pull must spare."""
_SWEEPS = 2
"""Along the tour."""
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
_SETTLES = (0.0, 5.0, 15.0, 40.0)
"""Seconds added to every leg where its time is the price: a near view that shows little is not free."""
_BEHIND = 0.01
"""Share of what is wanted by which an order may be behind the first."""
_LONGER = 1.2
"""Of the time left, for how long an order is made: flown faster than expected, more of it is reached."""
_AT_ONCE = 1e-3
"""Metres or seconds: the least price of a leg."""


@dataclass(frozen=True, eq=False)
class Arranged:
    """Views with the ways between them, in order.

    Attributes:
        views: rows in no order.
        between: the ways between the start and the views, in the order of rows.
        tour: their order.
        drawn: the plan and its legs.

    """

    views: Views
    between: Between
    tour: Tour
    drawn: DrawnUp


class Arranger:
    """Orders views, leaves out those that frames on the way make needless, and pulls the rest towards the way."""

    def __init__(self, task: Task, candidates: Views, progress: Progress) -> None:
        self.task, self.candidates, self.progress = task, candidates, progress

    def arranged(self, views: Views) -> Arranged:
        """Give the best found of views, starting from an order from nearest to nearest."""
        best = self._fewer(self._mended(self._ordered(views, self.task.between(views), None)))
        settled = self._mended(self._ordered(best.views, best.between, best.tour.order))
        if self._enough(settled, best) and self._cost(settled) < self._cost(best):
            best = settled
        # A place that a view is pulled to is not known to be safe to rest at.
        for _ in range(0 if self.task.scenario.inspect.passive_safety > 0.0 else _PULLS):
            views = _Line(self.task, best).pulled()
            nearer = self._ordered(views, self.task.between(views), best.tour.order)
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
        between = self.task.between(views)
        tour = self.task.flown(views, between)
        return Arranged(views, between, tour, self.task.drawn_up(views, tour))

    def _ordered(
        self, views: Views, between: Between, begin: Int[np.ndarray, " k"] | None, *, shaken: bool = True
    ) -> Arranged:
        inspect, seed = self.task.scenario.inspect, self.task.scenario.seed
        legs = self.task.legs(views, between)
        tour = best_tour(legs, inspect.objective, worth=inspect.delta_v_worth, seed=seed, begin=begin, shaken=shaken)
        drawn = self.task.drawn_up(views, tour)
        self.progress(0.5, f"{len(drawn.plan.views)} views, {drawn.plan.way_length:.0f} m")
        return Arranged(views, between, tour, drawn)

    def _mended(self, one: Arranged) -> Arranged:
        """Add candidates that see what is missing: frames on the way show other things in another order."""
        task, most = self.task, self.task.scenario.inspect.most_views
        for _ in range(_MENDS):
            missing, number = task.goal - self._seen(one), len(one.views.positions)
            if missing <= 0.0 or number >= most:
                break
            left = task.areas * ~one.drawn.plan.covered
            asked = missing + _ASIDE * (float(task.areas.sum()) - task.goal)
            extra = greedy_cover(self.candidates.sees, left, min(asked, float(left.sum())))
            if len(extra) == 0:
                break
            views = one.views.and_those(self.candidates.only(extra[: most - number]))
            order = np.concatenate([one.tour.order, np.arange(number, len(views.positions)) + 1])
            one = self._ordered(views, task.between(views), order, shaken=False)
        return one

    def _fewer(self, best: Arranged) -> Arranged:
        """Leave views out as long as the rest see enough."""
        task, goal, missed = self.task, min(self.task.goal, self._seen(best)), 0
        while missed < _MISSED:
            keep = _Line(task, best).needed(goal)
            if keep.all():
                break
            rows, number = np.flatnonzero(keep), np.cumsum(keep)
            both = np.concatenate([[0], rows + 1])
            between = best.between[0][np.ix_(both, both)], best.between[1][np.ix_(both, both)]
            order = np.array([number[row - 1] for row in best.tour.order if keep[row - 1]], dtype=np.int64)
            # Hardly another order: what frames on the way saw stays.
            fewer = self._mended(self._ordered(best.views.only(rows), between, order, shaken=False))
            if self._enough(fewer, best) and len(fewer.tour.order) < len(best.tour.order):
                left_out = len(best.tour.order) - len(fewer.tour.order)
                best = fewer
                if left_out < _FEW * len(best.tour.order):
                    break
            else:
                # Frames on the way see other things in another order: leave out less.
                goal += _SLACK * (float(task.areas.sum()) - task.goal)
                missed += 1
        return best

    def _seen(self, one: Arranged) -> float:
        return float(self.task.areas[one.drawn.plan.covered].sum())

    def _enough(self, one: Arranged, like: Arranged) -> bool:
        return self._seen(one) >= min(self.task.goal, self._seen(like)) * (1.0 - 1e-12)

    def _cost(self, one: Arranged) -> float:
        inspect = self.task.scenario.inspect
        return one.tour.cost(inspect.objective, inspect.delta_v_worth) - self.task.time


class _Line:
    """A tour of which views are left out or pulled: stops, the start first, and the legs that end at stops 1, 2 and on.

    The light must not change. What views and legs see together stays at least the task's goal, or what it was.
    """

    def __init__(self, task: Task, one: Arranged) -> None:
        rows, lights = one.tour.order - 1, task.lit.at(task.time)
        self.task, self.views, self.order = task, one.views, one.tour.order
        self.places: list[Point] = [task.position, *one.views.positions[rows]]
        self.boresights: list[Point] = [task.boresight, *one.views.boresights[rows]]
        self.courses, self.passing = list(one.drawn.courses), list(one.drawn.passing)
        self.shown = [(units := one.views.units(row))[lights[units]] for row in rows]
        self.times = np.zeros(len(task.areas), dtype=np.int64)
        for units in (*self.shown, *self.passing):
            self.times[units] += 1
        self.goal = min(task.goal, self._seen(self.times))

    def needed(self, goal: float) -> Bool[np.ndarray, " v"]:
        """Say which views are needed, given what other legs than the two that would change with a view see."""
        times, count = self.times, len(self.order)

        def lost(n: int) -> float:
            return float(self.task.areas[(times > 0) & (self._without(times, n) <= 0)].sum())

        seen, keep, touched = self._seen(times), np.ones(count, dtype=bool), np.zeros(count + 2, dtype=bool)
        for n in np.argsort([lost(n) for n in range(count)]).tolist():
            less = lost(n)
            if touched[n : n + 3].any() or seen - less < goal or keep.sum() <= 1:
                continue
            times, seen, keep[n] = self._without(times, n), seen - less, False
            touched[n + 1] = True
        answer = np.ones(count, dtype=bool)
        answer[self.order[~keep] - 1] = False
        return answer

    def _without(self, times: Int[np.ndarray, " units"], n: int) -> Int[np.ndarray, " units"]:
        """Give how often units are seen without a view, the first is 0, and the legs beside it."""
        less = times.copy()
        for units in (self.shown[n], *self.passing[n : n + 2]):
            less[units] -= 1
        return less

    def pulled(self) -> Views:
        """Move views towards the way; rows stay as they were."""
        for _ in range(_SWEEPS):
            for n in range(1, len(self.places)):
                self._pull(n)
        rows = np.empty(len(self.order), dtype=np.int64)
        rows[self.order - 1] = np.arange(len(self.order))
        sees = table_of([self.shown[row] for row in rows], len(self.times))
        places, boresights = np.array(self.places)[1:][rows], np.array(self.boresights)[1:][rows]
        return Views(places, boresights, sees, self.views.places)

    def _seen(self, times: Int[np.ndarray, " units"]) -> float:
        return float(self.task.areas[times > 0].sum())

    def _pull(self, n: int) -> None:
        """Pull the view at stop n, if it can be."""
        before, here = self.courses[n - 1][-2], self.places[n]
        last = n == len(self.places) - 1
        after = before if last else self.courses[n][1]
        along = after - before
        foot = before + float(np.clip((here - before) @ along / max(float(along @ along), 1e-12), 0.0, 1.0)) * along
        spared = math.dist(before, here) + math.dist(here, after) - (math.dist(before, foot) + math.dist(foot, after))
        if spared < _LEAST:
            return
        less = self._without(self.times, n - 1)
        alone = self.shown[n - 1][less[self.shown[n - 1]] <= 0]
        spare = self._seen(self.times) - self.goal
        corners = self.task.problem.patches.corners_of(alone)
        for share in _SHARES:
            if share * spared < _LEAST:
                return
            place = here + share * (foot - here)
            if not self._may_be(place, before, after):
                continue
            boresight = aim(place, corners, self.boresights[n], self.task.rules.half_angle)
            shown = self.task.shown(place, boresight)
            shown = shown[self.task.lit.lit[0][shown]]
            if float(self.task.areas[np.setdiff1d(alone, shown)].sum()) > spare + 1e-9:
                continue
            if self._moved(n, place, boresight, shown, less):
                return

    def _may_be(self, place: Point, before: Point, after: Point) -> bool:
        """Whether the chaser may be there and comes there straight: then it is room that is joined to the rest."""
        inside = self.task.scenario.inspect.stand_off + _LED
        if float(self.task.problem.room.free.distance(place[None])[0]) < inside:
            return False
        return bool(self.task.ways.clear(np.stack([before, place]), np.stack([place, after])).all())

    def _moved(self, n: int, place: Point, boresight: Point, shown: Units, less: Int[np.ndarray, " units"]) -> bool:
        """Move a view if then enough is seen; say whether."""
        courses = [np.concatenate([self.courses[n - 1][:-1], place[None]])]
        directions = [self.boresights[n - 1], boresight]
        if n < len(self.places) - 1:
            courses.append(np.concatenate([place[None], self.courses[n][1:]]))
            directions.append(self.boresights[n + 1])
        boresights = np.array(directions)
        ways, turns = np.array(list(map(way_length, courses))), self.task.turns(boresights[:-1], boresights[1:])
        lasts = np.maximum(ways / self.task.scenario.chaser.speed_limit, np.diag(turns))
        passing = self.task.passing(courses, boresights, np.concatenate([[0.0], np.cumsum(lasts)]))
        times = less.copy()
        for units in (shown, *passing):
            np.add.at(times, units, 1)
        if self._seen(times) < self.goal - 1e-9:
            return False
        self.places[n], self.boresights[n], self.shown[n - 1], self.times = place, boresight, shown, times
        self.courses[n - 1 : n - 1 + len(courses)] = courses
        self.passing[n - 1 : n - 1 + len(passing)] = passing
        return True


def in_short_time(arranger: Arranger, best: Arranged) -> Arranged:
    """Give the order that sees most by the mission's end.

    The order that is shortest as a whole leaves much for late. So orders are made by greed, each with another price of
    a leg: the view next is the one that newly shows most for that price. The first of them counts the way alone. Of the
    rest one is taken only where, after no quarter of its way, it has seen less than the first has after as many metres.

    Args:
        arranger: with the candidates, and the ways between them.
        best: the order that is best where there is time for all of it.

    """
    end, areas = arranger.task.scenario.duration, arranger.task.areas

    def seen(one: Arranged) -> float:
        return float(areas[one.drawn.plan.seen_by(end)].sum())

    first = arranger.in_order(_greedy(arranger))
    others = [arranger.in_order(_greedy(arranger, settle)) for settle in _SETTLES]
    fair = [one for one in (best, *others) if _keeps_up(one.drawn.plan, first.drawn.plan, areas, end)]
    return max([first, *fair], key=seen)


def _keeps_up(one: InspectionPlan, first: InspectionPlan, areas: Areas, end: float) -> bool:
    """Whether a plan is nowhere behind another at a quarter of its way."""
    mine, seen = _over_way(one, areas, end)
    theirs, seen_by_them = _over_way(first, areas, end)
    quarters = mine[-1] * np.arange(1, 5) / 4.0
    after = seen[np.searchsorted(mine, quarters + _AT_ONCE, side="right") - 1]
    asked = seen_by_them[np.searchsorted(theirs, quarters + _AT_ONCE, side="right") - 1]
    return bool(np.all(after >= asked - _BEHIND * areas.sum()))


def _over_way(
    plan: InspectionPlan, areas: Areas, end: float
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Give the ways flown by the mission's end after each view, m, and the areas seen by then, m²; 0 and 0 at first."""
    ways, shares, left = [0.0], [0.0], areas.copy()
    for view in plan.views:
        if view.at > end:
            break
        left[view.units] = left[view.on_the_way] = 0.0
        ways.append(ways[-1] + view.way)
        shares.append(float(areas.sum() - left.sum()))
    return np.array(ways), np.array(shares)


def _greedy(arranger: Arranger, settle: float | None = None) -> Int[np.ndarray, " k"]:
    """Give rows of the candidates: always that which newly shows most for the price of the leg to it.

    That is its way, m, or with `settle` (s) the time that it takes, and as much more.
    """
    views, task, scenario = arranger.candidates, arranger.task, arranger.task.scenario
    lengths, left, looking, here, now = task.nearly(views), task.areas * task.lit.lit[0], task.boresight, -1, task.time
    until = task.time + _LONGER * (scenario.duration - task.time)
    whole, order = float(left.sum()), list[int]()
    while whole - float(left.sum()) < task.goal and len(order) < scenario.inspect.most_views:
        way = lengths(here)
        turns = task.turns(looking[None], views.boresights)[0]
        taken = np.maximum(way / scenario.chaser.speed_limit, turns) + scenario.inspect.dwell
        price = np.maximum(way if settle is None else taken + settle, _AT_ONCE)
        rates = np.where(np.isfinite(way), (views.sees @ left) / price, 0.0)
        here = int(np.argmax(rates))
        if rates[here] <= 0.0 or (order and now > until):
            break
        order.append(here)
        left[views.units(here)] = 0.0
        looking, now = views.boresights[here], now + float(taken[here])
    return np.array(order, dtype=np.int64)
