"""The tour that goes to the nearest view with much that is new: a baseline beside the plan of an inspection."""

import dataclasses

import numpy as np

from keepout.apps.inspection.candidates import candidates
from keepout.apps.inspection.cover import shortlist
from keepout.apps.inspection.light import LitTimes
from keepout.apps.inspection.plan import InspectionPlan, Task
from keepout.apps.inspection.problem import Problem, boresight_of

ENOUGH = 0.2
"""Of what the best view shows that is new, the share that makes a view worth going to."""


def nearest_views(problem: Problem, wanted: np.ndarray, share: float) -> InspectionPlan:
    """Go to the view that is soonest reached of those that show at least a fifth of what the best one would, and on.

    Nothing is looked ahead and nothing proved: the plan's least number of views is 0. The light must not change.

    Args:
        problem: what there is to be seen, and from where; the tour begins as its mission does.
        wanted: (units,) to be seen.
        share: of their area that is wanted.

    """
    scenario, wanted = problem.scenario, wanted & problem.patches.counted
    areas = problem.patches.unit_areas() * wanted
    lit = LitTimes.of(problem.camera, wanted, 0.0, scenario.duration, scenario.camera.period)
    assert not lit.changes
    views, _ = candidates(problem, wanted & lit.lit[0], 0.0)
    found, views = len(views.positions), views.only(shortlist(views.sees, areas))
    place, direction = np.asarray(scenario.start.position, float), boresight_of(scenario, problem.target).direction
    goal, ways = share * float(areas.sum()), problem.ways_from(place)
    task = Task(problem, lit, areas, goal, ways, place, direction, 0.0)
    left, chosen, now, away = areas * lit.lit[0], [], 0.0, np.zeros(len(views.positions), dtype=bool)
    whole, most = float(left.sum()), scenario.inspect.most_views
    while whole - left.sum() < goal and len(chosen) < most and now <= scenario.duration:
        gains = np.where(away, 0.0, views.sees @ left)
        if not gains.any():
            break
        worth = np.flatnonzero(gains >= ENOUGH * gains.max())
        way = ways.nearly(place, views.positions[worth])
        cost = np.maximum(way / scenario.chaser.speed_limit, task.turns(direction[None], views.boresights[worth])[0])
        if not np.isfinite(cost.min()):
            away[worth] = True
            continue
        best = worth[int(np.argmin(cost))]
        now += float(cost.min())
        left[views.units(best)] = 0.0
        place, direction, away[best] = views.positions[best], views.boresights[best], True
        chosen.append(best)
    kept = views.only(np.array(chosen, dtype=np.int64))
    result = task.drawn_up(kept, task.flown(kept, task.between(kept))).plan
    counts = {"candidates": found, "short_list": len(views.positions), "greedy_views": len(chosen)}
    return dataclasses.replace(result, **counts)
