"""A plan of an inspection: few views that see enough, in a good order; and the nearest-view tour beside it.

The number of views is made least first, then what the objective says: their order, by time, Δv or both. Frames on the
way see more than the views were chosen for; views that become needless by that are left out.
"""

import functools
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from keepout.apps.inspection.arranging import INSIDE, Arranger
from keepout.apps.inspection.cover import Cover, fewest_views, shortlist
from keepout.apps.inspection.drifting import Drifting
from keepout.apps.inspection.itinerary import Start, drawn_up, tighter_rules
from keepout.apps.inspection.light_plan import plan_in_light
from keepout.apps.inspection.lit_times import LitTimes
from keepout.apps.inspection.nearest_view import nearest_views
from keepout.apps.inspection.plan import InspectionPlan
from keepout.apps.inspection.problem import Problem
from keepout.apps.inspection.seeing.rules import SeeingRules
from keepout.apps.inspection.seeing.visible import visible
from keepout.apps.inspection.short_time import in_short_time
from keepout.apps.inspection.viewpoints import Views, find_views
from keepout.apps.inspection.ways import Ways
from keepout.core.progress import Progress, part_of, silent

_PLACES_EACH, _FEWEST_PLACES = 4, 64
"""Places drawn for every unit wanted, and at least; `inspect.candidates` at most."""
_AMONG = 4000
"""Views that the fewest are chosen from."""


def plan(
    problem: Problem,
    *,
    position: Float[np.ndarray, "3"],
    time: float,
    wanted: Bool[np.ndarray, " units"],
    share: float | None = None,
    boresight: Float[np.ndarray, "3"] | None = None,
    effort: float = 1.0,
    progress: Progress = silent,
) -> InspectionPlan:
    """Plan views that see a share of the area wanted, few of them, and their order; or the nearest-view tour.

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
    lit = LitTimes.of(
        problem.light, problem.sight, problem.rules, wanted, time, max(scenario.duration, time), scenario.camera.period
    )
    views, unsafe = candidates(problem, wanted & lit.lit.any(axis=0), time, progress=part_of(progress, 0.0, 0.5))
    goal = share * float(areas.sum())
    start = Start(np.asarray(position, dtype=np.float64), time, boresight)
    ways = ways_from(problem, start.position)
    if scenario.inspect.tour == "nearest":
        result = nearest_views(problem, views, lit, areas, goal, ways, start)
    elif lit.changes:
        result = plan_in_light(problem, views, lit, areas, goal, ways, start, effort, part_of(progress, 0.5, 1.0))
    else:
        result = _planned(problem, views, lit, areas, goal, ways, start, effort, part_of(progress, 0.5, 1.0))
    progress(1.0, f"{len(result.views)} views, {result.way_length:.0f} m")
    drifts = None if result.drifts is None else replace(result.drifts, candidates_left_out=unsafe)
    return replace(result, drifts=drifts)


def _planned(
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
    """Choose the fewest views, and then their order."""
    ways = ways if ways is not problem.ways else problem.fine_ways
    places, at = np.unique(views.positions, axis=0, return_inverse=True)
    views = views.only(np.flatnonzero(ways.reached(start.position, places)[at.ravel()]))
    found = len(views.positions)
    views = views.only(shortlist(views.sees, areas, _AMONG))
    chosen = _fewest(problem, views, areas, goal, effort, part_of(progress, 0.0, 0.6))
    arranger = Arranger(problem, views, lit, areas, goal, ways, start, part_of(progress, 0.6, 1.0))
    best = arranger.arranged(views.only(chosen.chosen))
    if best.drawn.plan.views and best.tour.end > problem.scenario.duration:
        best = in_short_time(arranger, best)
    result, drifting = best.drawn.plan, Drifting.of(problem.scenario, problem.target.distance.distance)
    if drifting is not None:
        known = arranger.known
        result = drawn_up(problem, best.views, lit, best.tour, ways, start, areas, known, drifting).plan
    return replace(
        result,
        candidates=found,
        short_list=len(views.positions),
        fewest_views=chosen.fewest,
        greedy_views=chosen.greedy,
    )


def candidates(
    problem: Problem,
    wanted: Bool[np.ndarray, " units"],
    time: float,
    *,
    within: SeeingRules | None = None,
    progress: Progress = silent,
) -> tuple[Views, int]:
    """Find views of the units wanted; witnesses' places by the camera's limits themselves.

    Where passive safety is asked for, rest is safe at all of them.

    Args:
        problem: what there is to be seen, and from where.
        wanted: (units,) to be seen.
        time: at which rest is to be safe, s.
        within: limits of what drawn places show; if absent, the camera's with room for a flight's errors.
        progress: told how much is seen.

    Returns:
        The views, and at how many places that were tried rest is not safe.

    """
    rules, scenario = problem.rules, problem.scenario
    level = scenario.inspect.stand_off + INSIDE
    tighter = tighter_rules(rules, problem.patches.size) if within is None else within
    drifting, unsafe = Drifting.of(scenario, problem.target.distance.distance), 0

    def allowed(places: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        answer = problem.target.distance.distance(places) >= level
        answer[answer] = problem.room.allowed(places[answer])
        answer[answer] = safe(places[answer])
        return answer

    def safe(places: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        nonlocal unsafe
        if drifting is None:
            return np.ones(len(places), dtype=bool)
        answer = drifting.at_rest(places, time)
        unsafe += int(np.count_nonzero(~answer))
        return answer

    views = find_views(
        functools.partial(visible, problem.sight, tighter, among=wanted),
        functools.partial(visible, problem.sight, rules, among=wanted),
        allowed,
        problem.patches,
        tighter,
        wanted=wanted,
        witnesses=problem.seeable.witness,
        stand_off=level,
        places=min(scenario.inspect.candidates, max(_FEWEST_PLACES, _PLACES_EACH * int(wanted.sum()))),
        seed=scenario.seed,
        progress=progress,
    )
    # The places of witnesses were not drawn.
    return views if drifting is None else views.only(np.flatnonzero(safe(views.positions))), unsafe


def ways_from(problem: Problem, position: Float[np.ndarray, "3"]) -> Ways:
    """Give the problem's ways, or such as reach farther where the chaser is outside their box."""
    lower, upper = problem.box
    if ((position >= lower) & (position <= upper)).all():
        return problem.ways
    lower, upper = np.minimum(lower, position - 1.0), np.maximum(upper, position + 1.0)
    return Ways.build(problem.target.distance, problem.scenario.inspect.stand_off, lower, upper)


def _fewest(
    problem: Problem,
    views: Views,
    areas: Float[np.ndarray, " units"],
    goal: float,
    effort: float,
    progress: Progress,
) -> Cover:
    """Choose the fewest views, as many as are allowed at most."""
    cover = fewest_views(views.sees, areas, goal, effort=effort, seed=problem.scenario.seed, progress=progress)
    return replace(cover, chosen=cover.chosen[: problem.scenario.inspect.most_views])
