"""An inspection's plan: views in the order in which they are flown, their legs, their light, and what each shows first.

Frames taken on the way from one view to the next come free. Passive safety may ask for slower legs, and leave out views
to which no leg is safe.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from keepout.apps.inspection.candidates import Views, tighter_rules
from keepout.apps.inspection.light import LitTimes
from keepout.apps.inspection.passive import Course, Drifting, DriftsPlanned
from keepout.apps.inspection.problem import Problem
from keepout.apps.inspection.seeing.patches import Areas, Marks, Units
from keepout.apps.inspection.seeing.visible import SeeingRules, in_frame
from keepout.apps.inspection.tour import Legs, Tour, flown, turning_time
from keepout.apps.inspection.ways import Pairs, Ways, way_length
from keepout.apps.led.camera import angle_between
from keepout.core.cores import available_cores
from keepout.core.geometry.distance import Point, Points
from keepout.core.mission.scenario import Scenario

Between = tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "n n 3"]]
"""Lengths of the ways between a start, row 0, and views, m, and the unit vectors in which they set out."""
_NODES = 60_000
"""Of the grid on which the lengths of ways are compared: one march for each place that any tour passes."""
_SURELY = 2
"""Frames of a leg that must show a unit before it is counted on: the flight's are at other moments."""
_FRAMES = 20_000
"""On a whole tour, at most: of more, every second one and so on is looked at."""
_SAME = 0.01
"""Seconds by which a leg may last longer and is still the same leg."""


@dataclass(frozen=True, eq=False)
class PlannedView:
    """A place and a direction from which a frame is to be taken.

    Attributes:
        position: (3,) of the camera, m, body frame.
        boresight: (3,) unit vector.
        units: those that this view is counted on to see, and no view before it.
        window: (from, to) s: when the light is right; (0, inf) where light does not matter.
        dwell: how long to stay, s.
        speed: at which it is flown to at most, m/s: below the chaser's limit where passive safety asks for it.
        at: when it is expected to be worth what it shows, s.
        way: from the view before it, m.
        on_the_way: units that frames on that way are counted on to show.

    """

    position: Point
    boresight: Point
    units: Units
    window: tuple[float, float] = (0.0, float("inf"))
    dwell: float = 0.0
    speed: float = float("inf")
    at: float = 0.0
    way: float = 0.0
    on_the_way: Units = field(default_factory=lambda: np.zeros(0, np.int64))


@dataclass(frozen=True, eq=False)
class InspectionPlan:
    """Views in order, what they cover, and bounds.

    Attributes:
        views: in the order in which they are flown.
        covered: (2 n,) units that the plan sees.
        way_length: from the start through all views by ways that keep the stand-off, m.
        duration: expected, s.
        candidates: views that were found.
        fewest_views: proved: no fewer of the short list see as much by themselves; frames on the way may
            spare some.
        greedy_views: how many the greedy choice needed.
        drifts: what passive safety made of it; None where it is not asked for.
        short_list: how many of the candidates the views were chosen from; the bound is about these.
        begin: when it begins, s.

    """

    views: tuple[PlannedView, ...]
    covered: Marks
    way_length: float
    duration: float
    candidates: int
    fewest_views: int
    greedy_views: int
    drifts: DriftsPlanned | None = None
    short_list: int = 0
    begin: float = 0.0

    def seen_by(self, time: float) -> Marks:
        """Give the units that the plan sees by a time, s: those of the views reached by then, and of the ways there."""
        if self.begin + self.duration <= time:
            return self.covered.copy()
        seen = np.zeros_like(self.covered)
        for view in self.views:
            if view.at <= time:
                seen[view.units] = seen[view.on_the_way] = True
        return seen


def turned(first: Point, last: Point, angle: float) -> Point:
    """Turn a unit vector towards another by an angle (rad), and no farther than there."""
    if angle >= angle_between(first, last):
        return last
    across = last - (first @ last) * first
    size = float(np.linalg.norm(across))
    if size < 1e-9:
        across = np.cross(first, np.eye(3)[np.argmin(np.abs(first))])
        size = float(np.linalg.norm(across))
    return math.cos(angle) * first + math.sin(angle) * across / size


def kept_safe(
    drifting: Drifting | None,
    tour: Tour,
    course: Callable[[int, int], Course],
    turn: Callable[[int, int], float],
    begin: float,
    dwell: float,
) -> tuple[Tour, list[Course], list[float], DriftsPlanned | None]:
    """Give what is left of a tour, the courses of its legs, their greatest speeds (m/s), and what became of it.

    A view to which the leg is not safe at any speed is left out, and the next is flown to from where the chaser is.
    Times are moved on where a leg is slower; the end by as much as the last view's.

    Args:
        drifting: judges legs; None: none is judged, and the tour stays as it is.
        tour: rows of views from 1 on; 0 is the start.
        course: of the leg from a row to another, m.
        turn: of the boresight from a row to another, s.
        begin: time at the start, s.
        dwell: at every view, s.

    """
    kept = [0, *tour.order.tolist()]
    if drifting is None:
        return tour, [course(*leg) for leg in pairwise(kept)], [math.inf] * len(tour.order), None
    at = dict(zip(kept, [begin, *tour.times.tolist()], strict=True))
    chaser = drifting.scenario.chaser
    limit, settle = chaser.speed_limit, chaser.speed_limit * chaser.mass / chaser.force_limit
    courses: dict[tuple[int, int], Course] = {}
    speeds: dict[tuple[int, int], float] = {}
    while fresh := [leg for leg in pairwise(kept) if leg not in speeds]:
        courses |= {leg: course(*leg) for leg in fresh}
        times = np.array([(at[a], at[b]) for a, b in fresh])
        speeds |= dict(zip(fresh, drifting.speeds([courses[leg] for leg in fresh], times).tolist(), strict=True))
        left = kept[:1]
        for row in kept[1:]:
            # What comes after the end of an unsafe leg is not known yet, and stays.
            if speeds.get((left[-1], row), math.inf) > 0.0:
                left.append(row)
        kept = left
    legs, moved_on, behind = list(pairwise(kept)), [], 0.0
    for a, b in legs:
        way, slew = way_length(courses[a, b]), turn(a, b)
        quickest, lasts = max(way / limit, slew), at[b] - at[a]
        spare = max(lasts - quickest - (dwell + settle), 0.0)
        behind = max(behind + max(way / speeds[a, b], slew) - quickest - spare, 0.0)
        moved_on.append(at[b] + behind)
    times = np.array(moved_on)
    planned, slowed = len(tour.order), sum(speeds[leg] < limit for leg in legs)
    told = DriftsPlanned(planned, len(legs), slowed, views_left_out=planned - len(legs))
    late = float(times[-1]) - at[kept[-1]] if legs else 0.0
    safe = dataclasses.replace(tour, order=np.array(kept[1:], dtype=np.int64), times=times, end=tour.end + late)
    return safe, [courses[leg] for leg in legs], [speeds[leg] for leg in legs], told


class DrawnUp(NamedTuple):
    """A tour as a plan, and its legs.

    Attributes:
        plan: without its bounds.
        courses: of the legs, the corners of each, m.
        passing: units seen on each leg between its ends.

    """

    plan: InspectionPlan
    courses: list[Course]
    passing: list[Units]


@dataclass(frozen=True, eq=False)
class Task:
    """What one plan is made for, and what was found of legs: most of them stay while an order changes.

    Attributes:
        problem: what there is to be seen, and from where.
        lit: when it is lit.
        areas: (units,) m², 0 for what is not wanted.
        goal: m² to be seen.
        ways: between places.
        position: (3,) where the chaser is, m, body frame.
        boresight: (3,) where the camera looks.
        time: s.
        effort: of the usual counted work for the choice of views, how much is spent.

    """

    problem: Problem
    lit: LitTimes
    areas: Areas
    goal: float
    ways: Ways
    position: Point
    boresight: Point
    time: float
    effort: float = 1.0
    _lengths: Pairs = field(init=False, default_factory=dict)
    _courses: dict[tuple[bytes, bytes], Course] = field(init=False, default_factory=dict)
    _passing: dict[tuple[bytes, ...], Units] = field(init=False, default_factory=dict)

    @property
    def scenario(self) -> Scenario:
        """Of the mission."""
        return self.problem.scenario

    @functools.cached_property
    def rules(self) -> SeeingRules:
        """The camera's, with room for a flight's errors."""
        return tighter_rules(self.problem.rules, self.problem.patches.size)

    @property
    def drifting(self) -> Drifting | None:
        """What judges legs by passive safety; None where that is not asked for."""
        return Drifting.of(self.scenario, self.problem.target.distance.distance)

    def shown(self, place: Point, boresight: Point) -> Units:
        """Give the units wanted that a frame shows, in any light."""
        return in_frame(self.problem.sight, self.rules, place, boresight, among=self.areas > 0.0)

    def turns(self, first: Points, second: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "n m"]:
        """Give the times that the boresight takes from some directions to others, s."""
        return turning_time(first, second, self.scenario.camera.turn_rate, self.scenario.camera.turn_acceleration)

    def between(self, views: Views) -> Between:
        """Give lengths and directions of the ways between the start and views."""
        return self.ways.lengths(np.concatenate([self.position[None], views.positions]), self._lengths)

    def nearly(self, views: Views) -> Callable[[int], Float[np.ndarray, " v"]]:
        """Give what says the lengths (m) of ways from a view, by its row, or from the start, -1, to all views.

        They are those of a coarse grid, each found once; infinite where no way leads.
        """
        ways = self.ways
        upper = ways.origin + ways.spacing * (np.array(ways.open.shape) - 1)
        coarse = Ways.build(ways.distance, ways.stand_off, ways.origin, upper, most_nodes=_NODES)

        @functools.cache
        def from_place(place: tuple[float, ...]) -> Float[np.ndarray, " v"]:
            return coarse.nearly(np.array(place), views.positions)

        return lambda row: from_place(tuple((self.position if row < 0 else views.positions[row]).tolist()))

    def legs(self, views: Views, between: Between) -> Legs:
        """Give what lies between the start and views."""
        chaser, looking = self.scenario.chaser, np.concatenate([self.boresight[None], views.boresights])
        pace = chaser.speed_limit, chaser.force_limit / chaser.mass, self.scenario.inspect.dwell
        return Legs(*between, self.turns(looking, looking), *pace, self.time)

    def flown(self, views: Views, between: Between) -> Tour:
        """Give the tour of views in the order of their rows."""
        return flown(self.legs(views, between), np.arange(1, len(views.positions) + 1))

    def passing(
        self,
        courses: list[Course],
        boresights: Float[np.ndarray, "stops 3"],
        times: Float[np.ndarray, " stops"],
        *,
        kept: bool = False,
    ) -> list[Units]:
        """Say which units are seen between the views, leg by leg; neither of a leg's ends counts.

        On a leg the chaser goes at one speed, and the boresight turns at its rate from one view's direction straight to
        the next's as soon as the leg begins.

        Args:
            courses: corners of the way of each leg, m.
            boresights: at the start and at each view.
            times: at the start and at each view, s.
            kept: whether legs are looked up, and kept: where the light does not change, they are not looked at again.

        """
        camera, known = self.scenario.camera, self._passing if kept and not self.lit.changes else {}
        every = max(1, math.ceil((times[-1] - times[0]) / camera.period / _FRAMES))

        def leg(n: int) -> Units:
            seen = [np.zeros(0, dtype=np.int64)]
            begin, end = times[n], times[n + 1]
            lasts = round((end - begin) / _SAME)
            ends = boresights[n].tobytes(), boresights[n + 1].tobytes()
            key = (courses[n].tobytes(), *ends, b"%d %d" % (lasts, every))
            if key in known:
                return known[key]
            along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(courses[n], axis=0), axis=1))])
            for after in np.arange(every * camera.period, end - begin, every * camera.period):
                at = along[-1] * after / (end - begin)
                place = np.array([np.interp(at, along, courses[n][:, axis]) for axis in range(3)])
                units = self.shown(place, turned(boresights[n], boresights[n + 1], camera.turn_rate * after))
                seen.append(units[self.lit.at(float(begin + after))[units]])
            units, frames = np.unique(np.concatenate(seen), return_counts=True)
            known[key] = units[frames >= _SURELY]
            return known[key]

        with ThreadPoolExecutor(available_cores()) as pool:
            return list(pool.map(leg, range(len(courses))))

    def _course(self, begin: Point, end: Point) -> Course:
        """Give the corners of a way; straight ones where none leads."""
        key = (begin.tobytes(), end.tobytes())
        if key not in self._courses:
            path = self.ways.path(begin, end)
            self._courses[key] = np.stack([begin, end]) if path is None else path
        return self._courses[key]

    def drawn_up(self, views: Views, tour: Tour, drifting: Drifting | None = None) -> DrawnUp:
        """Give the plan of a tour, and what is seen on each of its legs.

        Where legs are judged (`drifting`), those that need it are slower, and views to which none is safe are left out.
        """
        dwell, lit = self.scenario.inspect.dwell, self.lit
        looking = np.concatenate([self.boresight[None], views.boresights])
        places = np.concatenate([self.position[None], views.positions])
        tour, courses, speeds, drifts = kept_safe(
            drifting,
            tour,
            lambda a, b: self._course(places[a], places[b]),
            lambda a, b: float(self.turns(looking[[a]], looking[[b]])[0, 0]),
            self.time,
            dwell,
        )
        covered, planned = np.zeros(len(self.areas), dtype=bool), []
        stops = looking[np.concatenate([[0], tour.order])]
        passing = self.passing(courses, stops, np.concatenate([[self.time], tour.times]), kept=True)
        for row, at, speed, course, under_way in zip(
            tour.order - 1, tour.times.tolist(), speeds, courses, passing, strict=True
        ):
            units = views.units(row)
            units = np.sort(units[lit.at(at)[units] & ~covered[units]]).astype(np.int64)
            covered[units] = True
            window = (0.0, math.inf)
            if lit.changes:
                window = next((w for w in lit.windows(units) if w[0] <= at <= w[1]), (at, at))
            place, boresight, way = views.positions[row], views.boresights[row], way_length(course)
            planned.append(PlannedView(place, boresight, units, window, dwell, speed, at, way, under_way))
        for units in passing:
            covered[units] = True
        moved, lasts = float(sum(map(way_length, courses))), tour.end - self.time
        plan = InspectionPlan(tuple(planned), covered, moved, lasts, 0, 0, 0, drifts, begin=self.time)
        return DrawnUp(plan, courses, passing)
