"""Views in an order as a plan: their legs, their light, what each shows first, and what frames between them see."""

import math
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse

from keepout.apps.inspection.drifting import Drifting
from keepout.apps.inspection.equipment import boresight_of
from keepout.apps.inspection.lit_times import LitTimes
from keepout.apps.inspection.passing import Passing, Shown, seen_in_passing
from keepout.apps.inspection.plan import InspectionPlan, PlannedView
from keepout.apps.inspection.problem import Problem
from keepout.apps.inspection.safe_tour import kept_safe
from keepout.apps.inspection.seeing.rules import SeeingRules
from keepout.apps.inspection.seeing.visible import in_frame
from keepout.apps.inspection.tour import Legs, Tour, turning_time
from keepout.apps.inspection.viewpoints import Views
from keepout.apps.inspection.ways import Pairs, Ways, way_length

_ROOM_TO_FLY = 0.15
"""Metres off its place at which a view is still to show what it was planned for: ranges are planned so much within."""
_TILT = math.radians(1.5)
"""The same for the angles of incidence and of the cone, rad."""


@dataclass(frozen=True, eq=False)
class Start:
    """Where a plan begins.

    Attributes:
        position: (3,) m.
        time: s.
        boresight: (3,); None: as at the start of the mission.

    """

    position: Float[np.ndarray, "3"]
    time: float
    boresight: Float[np.ndarray, "3"] | None

    def looking(self, problem: Problem) -> Float[np.ndarray, "3"]:
        """Give the boresight at the start."""
        return boresight_of(problem.scenario, problem.target).direction if self.boresight is None else self.boresight


def tighter_rules(rules: SeeingRules, patch: float) -> SeeingRules:
    """Give rules that what a flight does to a view does not break, where that leaves room."""
    greatest = rules.greatest_range - _ROOM_TO_FLY
    least = rules.least_range + _ROOM_TO_FLY
    return replace(
        rules,
        field_of_view=max(rules.field_of_view - 2.0 * _TILT, 0.8 * rules.field_of_view),
        greatest_incidence=max(rules.greatest_incidence - _TILT, 0.8 * rules.greatest_incidence),
        least_range=least if least + patch < greatest else rules.least_range,
        greatest_range=greatest if least + patch < greatest else rules.greatest_range,
    )


def legs_of(
    problem: Problem,
    views: Views,
    needs: list[Int[np.ndarray, " _"]],
    lit: LitTimes,
    start: Start,
    ways: tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "n n 3"]],
) -> Legs:
    """Give what lies between the start and views, each of which must be lit for what it needs to show."""
    scenario = problem.scenario
    looking = np.concatenate([start.looking(problem)[None], views.boresights])
    windows = [[(-math.inf, math.inf)], *(lit.windows(need) for need in needs)]
    table = np.full((len(windows), max(1, *(len(several) for several in windows)), 2), np.nan)
    for row, several in enumerate(windows):
        for n, window in enumerate(several):
            table[row, n] = window
    return Legs(
        lengths=ways[0],
        leave=ways[1],
        turns=turning_time(looking, looking, scenario.camera.turn_rate, scenario.camera.turn_acceleration),
        speed=scenario.chaser.speed_limit,
        acceleration=scenario.chaser.force_limit / scenario.chaser.mass,
        dwell=scenario.inspect.dwell,
        begin=start.time,
        windows=table,
    )


def first_seen(
    sees: sparse.csr_array, order: Int[np.ndarray, " k"], areas: Float[np.ndarray, " units"]
) -> list[Int[np.ndarray, " _"]]:
    """Give for each row of an order what it sees and none before does."""
    seen, result = areas <= 0.0, []
    for row in order:
        units = sees.indices[sees.indptr[row] : sees.indptr[row + 1]]
        result.append(np.sort(units[~seen[units]]).astype(np.int64))
        seen[units] = True
    return result


@dataclass(frozen=True, eq=False)
class DrawnUp:
    """A tour as a plan, and its legs.

    Attributes:
        plan: without its bounds.
        courses: of the legs, the corners of each, m.
        passing: units seen on each leg between its ends.

    """

    plan: InspectionPlan
    courses: list[Float[np.ndarray, "_ 3"]]
    passing: list[Int[np.ndarray, " _"]]


@dataclass(frozen=True, eq=False)
class LegsKnown:
    """Ways between neighbours, and courses of legs and what is seen on them: most stay while an order changes."""

    courses: dict[tuple[bytes, bytes], Float[np.ndarray, "_ 3"]] = field(default_factory=dict)
    passing: Passing = field(default_factory=dict)
    lengths: Pairs = field(default_factory=dict)

    def course(self, ways: Ways, begin: Float[np.ndarray, "3"], end: Float[np.ndarray, "3"]) -> np.ndarray:
        """Give the corners of a way; straight ones where none leads."""
        key = (begin.tobytes(), end.tobytes())
        if key not in self.courses:
            path = ways.path(begin, end)
            self.courses[key] = np.stack([begin, end]) if path is None else path
        return self.courses[key]


def frame_of(problem: Problem, wanted: Bool[np.ndarray, " units"]) -> Shown:
    """Give what says which of the units wanted a frame shows, with room for a flight's errors."""
    rules = tighter_rules(problem.rules, problem.patches.size)

    def shown(place: Float[np.ndarray, "3"], boresight: Float[np.ndarray, "3"]) -> Int[np.ndarray, " _"]:
        return in_frame(problem.sight, rules, place, boresight, among=wanted)

    return shown


def drawn_up(
    problem: Problem,
    views: Views,
    lit: LitTimes,
    tour: Tour,
    ways: Ways,
    start: Start,
    areas: Float[np.ndarray, " units"],
    known: LegsKnown | None = None,
    drifting: Drifting | None = None,
) -> DrawnUp:
    """Give the plan of a tour, what is seen on each of its legs, and the tour that was left of it.

    Where legs are judged (`drifting`), those that need it are slower, and views to which none is safe are left out.
    """
    scenario, camera = problem.scenario, problem.scenario.camera
    known = LegsKnown() if known is None else known
    looking = np.concatenate([start.looking(problem)[None], views.boresights])
    places = np.concatenate([start.position[None], views.positions])

    def turn(a: int, b: int) -> float:
        return float(turning_time(looking[[a]], looking[[b]], camera.turn_rate, camera.turn_acceleration)[0, 0])

    tour, courses, speeds, drifts = kept_safe(
        drifting,
        tour,
        lambda a, b: known.course(ways, places[a], places[b]),
        turn,
        start.time,
        scenario.inspect.dwell,
    )
    rows, moved = tour.order - 1, float(sum(map(way_length, courses)))
    covered = np.zeros(len(areas), dtype=bool)
    passing = seen_in_passing(
        courses,
        looking[np.concatenate([[0], tour.order])],
        np.concatenate([[start.time], tour.times]),
        shown=frame_of(problem, areas > 0.0),
        lit=lit,
        rate=scenario.camera.turn_rate,
        period=scenario.camera.period,
        known=known.passing,
    )
    planned = []
    for row, at, speed, course, under_way in zip(rows, tour.times, speeds, courses, passing, strict=True):
        units = views.sees.indices[views.sees.indptr[row] : views.sees.indptr[row + 1]]
        units = np.sort(units[lit.at(float(at))[units] & ~covered[units]]).astype(np.int64)
        covered[units] = True
        window = (
            next((w for w in lit.windows(units) if w[0] <= at <= w[1]), (at, at)) if lit.changes else (0.0, math.inf)
        )
        planned.append(
            PlannedView(
                views.positions[row],
                views.boresights[row],
                units,
                window,
                scenario.inspect.dwell,
                speed,
                at=float(at),
                way=way_length(course),
                on_the_way=under_way,
            )
        )
    for units in passing:
        covered[units] = True
    plan = InspectionPlan(tuple(planned), covered, moved, tour.end - start.time, 0, 0, 0, drifts, begin=start.time)
    return DrawnUp(plan, courses, passing)
