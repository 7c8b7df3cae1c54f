"""Views of a tour pulled towards the line between their neighbours, as long as enough is seen.

A candidate is a place that shows much, wherever that is. In a tour a view has to show only what nothing else shows,
and that may be seen from nearer the way, too. So each view is moved, and looks at the middle of what it alone shows.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse

from keepout.apps.inspection.aiming import aim
from keepout.apps.inspection.itinerary import DrawnUp, Start, frame_of, tighter_rules
from keepout.apps.inspection.lit_times import LitTimes
from keepout.apps.inspection.passing import Shown, seen_in_passing
from keepout.apps.inspection.problem import Problem
from keepout.apps.inspection.tour import Tour, turning_time
from keepout.apps.inspection.viewpoints import Views
from keepout.apps.inspection.ways import Ways

_SHARES = (1.0, 0.6, 0.3)
"""Of the way to the line between the neighbours, by which a view is pulled: the first that does."""
_LEAST = 0.1
"""Metres that a pull must spare."""
_SWEEPS = 2
"""Along the tour."""

Point = Float[np.ndarray, "3"]
Some = Int[np.ndarray, " _"]


def pulled(
    problem: Problem,
    views: Views,
    tour: Tour,
    drawn: DrawnUp,
    lit: LitTimes,
    ways: Ways,
    start: Start,
    areas: Float[np.ndarray, " units"],
    goal: float,
    *,
    inside: float,
) -> Views:
    """Move views towards the way; what views and legs see together stays at least `goal` (m²), or what it was.

    Args:
        problem: as of `plan`.
        views: of the tour.
        tour: the order in which they are flown.
        drawn: its legs.
        lit: when: the light must not change.
        ways: between places.
        start: of the tour.
        areas: (units,) m², 0 for what is not wanted.
        goal: m² to be seen.
        inside: distance from the mesh that places keep, m.

    Returns:
        The views, rows as before.

    """
    line = _Line.of(problem, views, tour, drawn, lit, ways, start, areas, goal, inside)
    for _ in range(_SWEEPS):
        for n in range(1, len(line.places)):
            line.pull(n)
    rows = np.empty(len(tour.order), dtype=np.int64)
    rows[tour.order - 1] = np.arange(len(tour.order))
    shown = [line.shown[row] for row in rows]
    starts = np.concatenate([[0], np.cumsum([len(units) for units in shown])]).astype(np.int64)
    index = np.concatenate(shown) if shown else np.zeros(0, dtype=np.int64)
    sees = sparse.csr_array((np.ones(len(index)), index, starts), shape=views.sees.shape)
    return Views(np.array(line.places)[1:][rows], np.array(line.boresights)[1:][rows], sees, views.places)


@dataclass(eq=False)
class _Line:
    """A tour as it is pulled: stops, the start first, and the legs that end at stops 1, 2 and so on."""

    problem: Problem
    ways: Ways
    frame: Shown
    lit: LitTimes
    areas: Float[np.ndarray, " units"]
    goal: float
    inside: float
    places: list[Point]
    boresights: list[Point]
    courses: list[Float[np.ndarray, "_ 3"]]
    shown: list[Some]
    passing: list[Some]
    times: Int[np.ndarray, " units"]

    @classmethod
    def of(
        cls,
        problem: Problem,
        views: Views,
        tour: Tour,
        drawn: DrawnUp,
        lit: LitTimes,
        ways: Ways,
        start: Start,
        areas: Float[np.ndarray, " units"],
        goal: float,
        inside: float,
    ) -> "_Line":
        rows = tour.order - 1
        lights = lit.at(start.time)
        shown = [views.sees.indices[views.sees.indptr[row] : views.sees.indptr[row + 1]] for row in rows]
        shown = [units[lights[units]] for units in shown]
        times = np.zeros(len(areas), dtype=np.int64)
        for units in (*shown, *drawn.passing):
            times[units] += 1
        line = cls(
            problem,
            ways,
            frame_of(problem, areas > 0.0),
            lit,
            areas,
            goal,
            inside,
            [start.position, *views.positions[rows]],
            [start.looking(problem), *views.boresights[rows]],
            list(drawn.courses),
            shown,
            list(drawn.passing),
            times,
        )
        line.goal = min(goal, line.seen)
        return line

    @property
    def seen(self) -> float:
        """What is seen, m²."""
        return float(self.areas[self.times > 0].sum())

    def pull(self, n: int) -> None:
        """Pull the view at stop n, if it can be."""
        before, here = self.courses[n - 1][-2], self.places[n]
        last = n == len(self.places) - 1
        after = before if last else self.courses[n][1]
        foot = _foot(here, before, after)
        spared = _length(before, here, after) - _length(before, foot, after)
        if spared < _LEAST:
            return
        legs = range(n - 1, n if last else n + 1)
        less = self.times.copy()
        for units in (self.shown[n - 1], *(self.passing[leg] for leg in legs)):
            less[units] -= 1
        alone = self.shown[n - 1][less[self.shown[n - 1]] <= 0]
        spare = self.seen - self.goal
        for share in _SHARES:
            if share * spared < _LEAST:
                return
            place = here + share * (foot - here)
            if not self._may_be(place, before, after):
                continue
            boresight = self._aimed(place, alone, self.boresights[n])
            shown = self._shown(place, boresight)
            if float(self.areas[np.setdiff1d(alone, shown)].sum()) > spare + 1e-9:
                continue
            if self._moved(n, place, boresight, shown, less):
                return

    def _may_be(self, place: Point, before: Point, after: Point) -> bool:
        """Whether the chaser may be there and comes there straight: then it is room that is joined to the rest."""
        if float(self.problem.target.distance.distance(place[None])[0]) < self.inside:
            return False
        return bool(self.ways.clear(np.stack([before, place]), np.stack([place, after])).all())

    def _aimed(self, place: Point, units: Some, planned: Point) -> Point:
        patches = self.problem.patches
        half_angle = tighter_rules(self.problem.rules, patches.size).half_angle
        return aim(place, patches.corners_of(units), planned, half_angle)

    def _shown(self, place: Point, boresight: Point) -> Some:
        units = self.frame(place, boresight)
        return units[self.lit.lit[0][units]]

    def _moved(self, n: int, place: Point, boresight: Point, shown: Some, less: Int[np.ndarray, " units"]) -> bool:
        """Move a view if then enough is seen; say whether."""
        courses = [np.concatenate([self.courses[n - 1][:-1], place[None]])]
        stops = [n - 1, n]
        if n < len(self.places) - 1:
            courses.append(np.concatenate([place[None], self.courses[n][1:]]))
            stops.append(n + 1)
        boresights = np.array([boresight if stop == n else self.boresights[stop] for stop in stops])
        passing = self._passed(courses, boresights)
        times = less
        for units in (shown, *passing):
            np.add.at(times, units, 1)
        if float(self.areas[times > 0].sum()) < self.goal - 1e-9:
            for units in (shown, *passing):
                np.subtract.at(times, units, 1)
            return False
        self.places[n], self.boresights[n], self.shown[n - 1], self.times = place, boresight, shown, times
        self.courses[n - 1 : n - 1 + len(courses)] = courses
        self.passing[n - 1 : n - 1 + len(passing)] = passing
        return True

    def _passed(self, courses: list[Float[np.ndarray, "_ 3"]], boresights: Float[np.ndarray, "stops 3"]) -> list[Some]:
        scenario = self.problem.scenario
        camera = scenario.camera
        turns = np.diag(turning_time(boresights[:-1], boresights[1:], camera.turn_rate, camera.turn_acceleration))
        ways = [float(np.linalg.norm(np.diff(course, axis=0), axis=1).sum()) for course in courses]
        lasts = np.maximum(np.array(ways) / scenario.chaser.speed_limit, turns)
        return seen_in_passing(
            courses,
            boresights,
            np.concatenate([[0.0], np.cumsum(lasts)]),
            shown=self.frame,
            lit=self.lit,
            rate=camera.turn_rate,
            period=camera.period,
        )


def _foot(place: Point, before: Point, after: Point) -> Point:
    along = after - before
    share = float(np.clip((place - before) @ along / max(float(along @ along), 1e-12), 0.0, 1.0))
    return before + share * along


def _length(a: Point, b: Point, c: Point) -> float:
    return math.dist(a, b) + math.dist(b, c)
