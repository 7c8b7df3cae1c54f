"""Views in an order as a plan: their legs, their light, what each shows first, and what frames between them see."""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse

from keepout.inspecting.drifting import Drifting
from keepout.inspecting.equipment import boresight_of
from keepout.inspecting.lit_times import LitTimes
from keepout.inspecting.passing import seen_in_passing
from keepout.inspecting.plan import InspectionPlan, PlannedView
from keepout.inspecting.problem import Problem
from keepout.inspecting.safe_tour import kept_safe
from keepout.inspecting.tour import Legs, Tour, turning_time
from keepout.inspecting.viewpoints import Look, Views
from keepout.inspecting.ways import Ways, way_length
from keepout.seeing.rules import SeeingRules

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


def drawn_up(
    problem: Problem,
    views: Views,
    lit: LitTimes,
    tour: Tour,
    ways: Ways,
    start: Start,
    look: Look,
    areas: Float[np.ndarray, " units"],
) -> tuple[InspectionPlan, list[Int[np.ndarray, " _"]], Tour]:
    """Give the plan of a tour, what is seen on each of its legs, and the tour that was left of it.

    Where passive safety is asked for, legs that need it are slower, and views to which none is safe are left out.
    """
    scenario = problem.scenario
    looking = np.concatenate([start.looking(problem)[None], views.boresights])

    def course(a: int, b: int) -> Float[np.ndarray, "corners 3"]:
        begin = start.position if a == 0 else views.positions[a - 1]
        found = ways.path(begin, views.positions[b - 1])
        return np.stack([begin, views.positions[b - 1]]) if found is None else found

    def turn(a: int, b: int) -> float:
        camera = scenario.camera
        return float(turning_time(looking[[a]], looking[[b]], camera.turn_rate, camera.turn_acceleration)[0, 0])

    tour, courses, speeds, drifts = kept_safe(
        Drifting.of(scenario, problem.target.distance.distance), tour, course, turn, start.time, scenario.inspect.dwell
    )
    rows, moved = tour.order - 1, float(sum(map(way_length, courses)))
    covered = np.zeros(len(areas), dtype=bool)
    planned = []
    for row, at, speed in zip(rows, tour.times, speeds, strict=True):
        units = views.sees.indices[views.sees.indptr[row] : views.sees.indptr[row + 1]]
        units = np.sort(units[lit.at(float(at))[units] & ~covered[units]]).astype(np.int64)
        covered[units] = True
        window = (
            next((w for w in lit.windows(units) if w[0] <= at <= w[1]), (at, at)) if lit.changes else (0.0, math.inf)
        )
        planned.append(
            PlannedView(views.positions[row], views.boresights[row], units, window, scenario.inspect.dwell, speed)
        )
    passing = seen_in_passing(
        courses,
        looking[np.concatenate([[0], tour.order])],
        np.concatenate([[start.time], tour.times]),
        look=look,
        lit=lit,
        half_angle=tighter_rules(problem.rules, problem.patches.size).half_angle,
        rate=scenario.camera.turn_rate,
        period=scenario.camera.period,
    )
    for units in passing:
        covered[units] = True
    plan = InspectionPlan(tuple(planned), covered, moved, tour.end - start.time, 0, 0, 0, drifts)
    return plan, passing, tour
