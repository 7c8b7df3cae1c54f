"""The nearest-view tour, a baseline: always the view next that is soonest reached and shows enough that is new."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from keepout.apps.inspection.cover import shortlist
from keepout.apps.inspection.drifting import Drifting
from keepout.apps.inspection.itinerary import Start, drawn_up, first_seen, legs_of
from keepout.apps.inspection.lit_times import LitTimes
from keepout.apps.inspection.plan import InspectionPlan
from keepout.apps.inspection.problem import Problem
from keepout.apps.inspection.tour import flown, turning_time
from keepout.apps.inspection.viewpoints import Views
from keepout.apps.inspection.ways import Ways

_ENOUGH = 0.2
"""Of what the best view shows that is new, the share that makes a view worth going to."""


def nearest_views(
    problem: Problem,
    views: Views,
    lit: LitTimes,
    areas: Float[np.ndarray, " units"],
    goal: float,
    ways: Ways,
    start: Start,
) -> InspectionPlan:
    """Go to the view that is soonest reached of those that show at least a fifth of what the best one would, and on.

    Nothing is looked ahead and nothing proved: the plan's least number of views is 0.

    Args:
        problem: as of `plan`.
        views: candidates.
        lit: when.
        areas: (units,) m², 0 for what is not wanted.
        goal: m² to be seen.
        ways: between places.
        start: of the tour.

    """
    scenario, found = problem.scenario, len(views.positions)
    views = views.only(shortlist(views.sees, areas))
    camera, speed = scenario.camera, scenario.chaser.speed_limit
    left, chosen, now = areas.copy(), [], start.time
    place, direction = start.position, start.looking(problem)
    away = np.zeros(len(views.positions), dtype=bool)
    while areas.sum() - left.sum() < goal and len(chosen) < scenario.inspect.most_views and now <= scenario.duration:
        gains: Float[np.ndarray, " v"] = np.where(away, 0.0, views.sees @ (left * lit.at(now)))
        if not gains.any():
            later = lit.times[lit.times > now]
            if not lit.changes or len(later) == 0:
                break
            now = float(later[0])
            continue
        worth = np.flatnonzero(gains >= _ENOUGH * gains.max())
        turn = turning_time(direction[None], views.boresights[worth], camera.turn_rate, camera.turn_acceleration)[0]
        cost = np.maximum(ways.nearly(place, views.positions[worth]) / speed, turn)
        best = worth[int(np.argmin(cost))]
        if not np.isfinite(cost.min()):
            away[worth] = True
            continue
        now += float(cost.min())
        units = views.sees.indices[views.sees.indptr[best] : views.sees.indptr[best + 1]]
        left[units[lit.at(now)[units]]] = 0.0
        place, direction = views.positions[best], views.boresights[best]
        away[best] = not lit.changes
        chosen.append(best)
    kept = views.only(np.array(chosen, dtype=np.int64))
    between = ways.lengths(np.concatenate([start.position[None], kept.positions]))
    needs = first_seen(kept.sees, np.arange(len(chosen)), areas)
    tour = flown(legs_of(problem, kept, needs, lit, start, between), np.arange(1, len(chosen) + 1))
    drifting = Drifting.of(problem.scenario, problem.target.distance.distance)
    plan = drawn_up(problem, kept, lit, tour, ways, start, areas, drifting=drifting).plan
    return replace(plan, candidates=found, short_list=len(views.positions), greedy_views=len(chosen))
