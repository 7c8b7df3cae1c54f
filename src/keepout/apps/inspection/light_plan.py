"""A plan in a light that moves: a tour made for the light, drawn up as views with windows and bounds."""

import functools
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from keepout.apps.inspection.cover import fewest_views, shortlist
from keepout.apps.inspection.drifting import Drifting
from keepout.apps.inspection.itinerary import Start, drawn_up
from keepout.apps.inspection.light_cost import Cost
from keepout.apps.inspection.light_tour import Lengths, Pace, tour_in_light
from keepout.apps.inspection.lit_times import LitTimes
from keepout.apps.inspection.plan import InspectionPlan
from keepout.apps.inspection.problem import Problem
from keepout.apps.inspection.tour import Tour
from keepout.apps.inspection.viewpoints import Views
from keepout.apps.inspection.ways import Ways
from keepout.core.progress import Progress

_AMONG = 1500
"""Views that a tour is made from, about."""
_NODES = 60_000
"""Of the grid on which the lengths of ways are compared: one march for each place that any tour passes."""
_BOUND = 0.1
"""Share of the usual work that goes into the bound on the number of views."""
_TRIES = 1500
"""Tours made again, at most, and usually."""
_TAKEN = 0.9
"""Share of the speed limit at which a tour is made: a law slows down for corners and near the target."""


def plan_in_light(
    problem: Problem,
    views: Views,
    lit: LitTimes,
    areas: Float[np.ndarray, " units"],
    goal: float,
    ways: Ways,
    start: Start,
    effort: float,
    progress: Progress,
) -> InspectionPlan:
    """Plan views together with their times; the bound on their number is that of the same views in any light.

    Args:
        problem: as of `plan`.
        views: candidates.
        lit: when.
        areas: (units,) m², 0 for what is not wanted.
        goal: m² to be seen.
        ways: between places.
        start: of the tour.
        effort: counted work for the tour and the bound, against the usual.
        progress: told of the tour.

    """
    scenario = problem.scenario
    found = len(views.positions)
    views = views.only(shortlist(views.sees, areas, _AMONG))
    pace = Pace(
        _TAKEN * scenario.chaser.speed_limit,
        scenario.chaser.force_limit / scenario.chaser.mass,
        scenario.camera.turn_rate,
        scenario.camera.turn_acceleration,
        scenario.inspect.dwell,
    )
    made = tour_in_light(
        views,
        lit,
        areas,
        goal,
        nearly(views, ways, start.position),
        start.looking(problem),
        pace,
        start.time,
        start=start.position,
        cost=Cost.of(scenario.inspect.objective, scenario.inspect.delta_v_worth),
        most_views=scenario.inspect.most_views,
        tries=round(effort * _TRIES),
        seed=scenario.seed,
    )
    progress(0.6, f"{len(made.rows)} views show {made.area:.1f} m2 in time")
    bound = fewest_views(views.sees, areas, min(goal, made.area), effort=_BOUND * effort, seed=scenario.seed)
    kept = views.only(made.rows)
    order = np.arange(1, len(made.rows) + 1)
    # Its length is that of the courses, which are drawn up now.
    tour = Tour(order, made.times, 0.0, made.end, made.delta_v)
    drifting = Drifting.of(scenario, problem.target.distance.distance)
    result = drawn_up(problem, kept, lit, tour, ways, start, areas, drifting=drifting).plan
    return replace(
        result,
        candidates=found,
        short_list=len(views.positions),
        fewest_views=min(bound.fewest, len(made.rows)),
        greedy_views=bound.greedy,
    )


def nearly(views: Views, ways: Ways, start: Float[np.ndarray, "3"]) -> Lengths:
    """Give the lengths of ways from a view or the start to all views, on a coarse grid, each found once."""
    coarse = Ways.build(
        ways.distance,
        ways.stand_off,
        ways.origin,
        ways.origin + ways.spacing * (np.array(ways.open.shape) - 1),
        most_nodes=_NODES,
    )

    @functools.cache
    def from_place(place: tuple[float, ...]) -> Float[np.ndarray, " v"]:
        return coarse.nearly(np.array(place), views.positions)

    def lengths(row: int) -> Float[np.ndarray, " v"]:
        return from_place(tuple((start if row < 0 else views.positions[row]).tolist()))

    return lengths
