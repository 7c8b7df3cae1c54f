"""A plan of an inspection: few views that see enough, in a good order; and the nearest-view tour beside it.

The number of views is made least first, then what the objective says: their order, by time, Δv or both. Frames on the
way see more than the views were chosen for; views that become needless by that are left out.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from keepout.apps.inspection.arranging import Arranger, in_short_time
from keepout.apps.inspection.candidates import Views, candidates
from keepout.apps.inspection.cover import fewest_views, shortlist
from keepout.apps.inspection.light import LitTimes
from keepout.apps.inspection.light_tour import plan_in_light
from keepout.apps.inspection.plan import InspectionPlan, Task
from keepout.apps.inspection.problem import Problem, boresight_of
from keepout.core.progress import Progress, part_of, silent

_AMONG = 4000
"""Views that the fewest are chosen from."""
_ENOUGH = 0.2
"""Of what the best view shows that is new, the share that makes a view of the nearest-view tour worth going to."""

Point = Float[np.ndarray, "3"]


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
    position = np.asarray(position, dtype=np.float64)
    boresight = boresight_of(scenario, problem.target).direction if boresight is None else boresight
    ways, goal = problem.ways_from(position), share * float(areas.sum())
    task, rest = Task(problem, lit, areas, goal, ways, position, boresight, time, effort), part_of(progress, 0.5, 1.0)
    if scenario.inspect.tour == "nearest":
        result = _nearest_views(task, views)
    elif lit.changes:
        result = plan_in_light(task, views, rest)
    else:
        result = _fewest_in_order(task, views, rest)
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
    views = views.only(shortlist(views.sees, task.areas, _AMONG))
    work = {"effort": task.effort, "seed": scenario.seed, "progress": part_of(progress, 0.0, 0.6)}
    cover = fewest_views(views.sees, task.areas, task.goal, **work)
    arranger = Arranger(task, views, part_of(progress, 0.6, 1.0))
    best = arranger.arranged(views.only(cover.chosen[: scenario.inspect.most_views]))
    if best.drawn.plan.views and best.tour.end > scenario.duration:
        best = in_short_time(arranger, best)
    result = best.drawn.plan
    if task.drifting is not None:
        result = task.drawn_up(best.views, best.tour, task.drifting).plan
    return replace(
        result,
        candidates=found,
        short_list=len(views.positions),
        fewest_views=cover.fewest,
        greedy_views=cover.greedy,
    )


def _nearest_views(task: Task, views: Views) -> InspectionPlan:
    """Go to the view that is soonest reached of those that show at least a fifth of what the best one would, and on.

    It is a baseline: nothing is looked ahead and nothing proved, and the plan's least number of views is 0.
    """
    scenario, lit, areas, found = task.scenario, task.lit, task.areas, len(views.positions)
    views = views.only(shortlist(views.sees, areas))
    left, chosen, now, place, direction = areas.copy(), [], task.time, task.position, task.boresight
    away, most = np.zeros(len(views.positions), dtype=bool), scenario.inspect.most_views
    while areas.sum() - left.sum() < task.goal and len(chosen) < most and now <= scenario.duration:
        gains: Float[np.ndarray, " v"] = np.where(away, 0.0, views.sees @ (left * lit.at(now)))
        if not gains.any():
            later = lit.times[lit.times > now]
            if not lit.changes or len(later) == 0:
                break
            now = float(later[0])
            continue
        worth = np.flatnonzero(gains >= _ENOUGH * gains.max())
        way = task.ways.nearly(place, views.positions[worth])
        turn = task.turns(direction[None], views.boresights[worth])[0]
        cost = np.maximum(way / scenario.chaser.speed_limit, turn)
        best = worth[int(np.argmin(cost))]
        if not np.isfinite(cost.min()):
            away[worth] = True
            continue
        now += float(cost.min())
        units = views.units(best)
        left[units[lit.at(now)[units]]] = 0.0
        place, direction = views.positions[best], views.boresights[best]
        away[best] = not lit.changes
        chosen.append(best)
    kept = views.only(np.array(chosen, dtype=np.int64))
    tour = task.flown(kept, task.between(kept))
    result = task.drawn_up(kept, tour, task.drifting).plan
    return replace(result, candidates=found, short_list=len(views.positions), greedy_views=len(chosen))
