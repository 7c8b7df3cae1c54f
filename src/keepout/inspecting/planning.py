"""A plan of an inspection: few views that see enough, in a good order; and the nearest-view tour beside it.

The number of views is made least first, then what the objective says: their order, by time, Δv or both. Frames on the
way see more than the views were chosen for; views that become needless by that are left out.
"""

import functools
import time as clock
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse

from keepout.inspecting.cover import Cover, fewest_views, shortlist
from keepout.inspecting.drifting import Drifting
from keepout.inspecting.itinerary import Start, drawn_up, first_seen, legs_of, tighter_rules
from keepout.inspecting.light_plan import plan_in_light
from keepout.inspecting.lit_times import LitTimes
from keepout.inspecting.nearest_view import nearest_views
from keepout.inspecting.plan import InspectionPlan
from keepout.inspecting.problem import Problem
from keepout.inspecting.tour import Tour, best_tour
from keepout.inspecting.viewpoints import Views, find_views
from keepout.inspecting.ways import Ways
from keepout.progress import Progress, part_of, silent
from keepout.seeing.visible import visible

_COVER_SECONDS, _LEAST_SECONDS, _UNIT_SECONDS = 60.0, 5.0, 0.01
"""For the choice of the fewest views: at most, and by the number of units."""
_PLACES_EACH, _FEWEST_PLACES = 4, 64
"""Places drawn for every unit wanted, and at least; `inspect.candidates` at most."""
_AMONG = 4000
"""Views that the fewest are chosen from."""
_INSIDE = 0.02
"""Metres by which drawn places keep more than the stand-off."""
_TRIES = 3


def plan(
    problem: Problem,
    *,
    position: Float[np.ndarray, "3"],
    time: float,
    wanted: Bool[np.ndarray, " units"],
    share: float | None = None,
    boresight: Float[np.ndarray, "3"] | None = None,
    seconds: float | None = None,
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
        seconds: for the choice of the fewest views; if absent, by how many units are wanted, a minute at most.
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
    seconds = min(_COVER_SECONDS, _LEAST_SECONDS + _UNIT_SECONDS * wanted.sum()) if seconds is None else seconds
    if scenario.inspect.tour == "nearest":
        look = functools.partial(
            visible, problem.sight, tighter_rules(problem.rules, problem.patches.size), among=areas > 0.0
        )
        result = nearest_views(problem, views, lit, areas, goal, ways, start, look)
    elif lit.changes:
        result = plan_in_light(problem, views, lit, areas, goal, ways, start, seconds, part_of(progress, 0.5, 1.0))
    else:
        result = _planned(problem, views, lit, areas, goal, ways, start, seconds, part_of(progress, 0.5, 1.0))
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
    seconds: float,
    progress: Progress,
) -> InspectionPlan:
    """Choose the fewest views, and then their order."""
    views = views.only(shortlist(views.sees, areas, _AMONG))
    chosen, legs = _reached(problem, views, areas, goal, ways, start, seconds, part_of(progress, 0.0, 0.7))
    kept = views.only(chosen.chosen)
    progress(0.8, f"{len(kept.positions)} views: their order")
    result = _ordered(problem, kept, lit, areas, goal, ways, start, legs)
    return replace(result, candidates=len(views.positions), fewest_views=chosen.fewest, greedy_views=chosen.greedy)


def candidates(
    problem: Problem, wanted: Bool[np.ndarray, " units"], time: float, *, progress: Progress = silent
) -> tuple[Views, int]:
    """Find views of the units wanted, with room for a flight's errors; witnesses' places by the rules themselves.

    Where passive safety is asked for, rest at a time (s) is safe at all of them.

    Returns:
        The views, and at how many places that were tried rest is not safe.

    """
    rules, scenario = problem.rules, problem.scenario
    level = scenario.inspect.stand_off + _INSIDE
    tighter = tighter_rules(rules, problem.patches.size)
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


def _reached(
    problem: Problem,
    views: Views,
    areas: Float[np.ndarray, " units"],
    goal: float,
    ways: Ways,
    start: Start,
    seconds: float,
    progress: Progress,
) -> tuple[Cover, tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "n n 3"]]]:
    """Choose the fewest views to which ways lead, and give lengths and directions of these ways, the start first."""
    usable = np.arange(len(views.positions))
    cover, legs = Cover(usable[:0], 0, 0), (np.zeros((1, 1)), np.zeros((1, 1, 3)))
    until = clock.perf_counter() + seconds
    for tried in range(_TRIES):
        left = max(until - clock.perf_counter(), 0.2 * seconds)
        cover = fewest_views(
            views.sees[usable], areas, goal, seconds=left, seed=problem.scenario.seed, progress=progress
        )
        rows = usable[cover.chosen][: problem.scenario.inspect.most_views]
        legs = ways.lengths(np.concatenate([start.position[None], views.positions[rows]]))
        lost = ~np.isfinite(legs[0][0, 1:])
        cover = replace(cover, chosen=rows)
        if not lost.any():
            break
        usable = np.setdiff1d(usable, rows[lost])
        if tried == _TRIES - 1:
            keep = np.concatenate([[0], 1 + np.flatnonzero(~lost)])
            legs = (legs[0][np.ix_(keep, keep)], legs[1][np.ix_(keep, keep)])
            cover = replace(cover, chosen=rows[~lost])
    return cover, legs


def _ordered(
    problem: Problem,
    views: Views,
    lit: LitTimes,
    areas: Float[np.ndarray, " units"],
    goal: float,
    ways: Ways,
    start: Start,
    between: tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "n n 3"]],
) -> InspectionPlan:
    """Order views, and leave out those that frames on the way make needless, while the goal is still seen."""
    inspect = problem.scenario.inspect
    look = functools.partial(
        visible, problem.sight, tighter_rules(problem.rules, problem.patches.size), among=areas > 0.0
    )
    best: InspectionPlan | None = None
    while True:
        needs = first_seen(views.sees, np.arange(len(views.positions)), areas)
        legs = legs_of(problem, views, needs, lit, start, between)
        tour = best_tour(legs, inspect.objective, worth=inspect.delta_v_worth, seed=problem.scenario.seed)
        result, passing, left = drawn_up(problem, views, lit, tour, ways, start, look, areas)
        if best is not None and float(areas[result.covered].sum()) < min(goal, float(areas[best.covered].sum())):
            return best
        best = result
        keep = _needed(views.sees, left, lit, passing, areas, goal)
        if keep.all():
            return best
        views, between = _kept(views, between, np.flatnonzero(keep))


def _kept(
    views: Views, between: tuple[np.ndarray, np.ndarray], rows: Int[np.ndarray, " k"]
) -> tuple[Views, tuple[np.ndarray, np.ndarray]]:
    both = np.concatenate([[0], rows + 1])
    return views.only(rows), (between[0][np.ix_(both, both)], between[1][np.ix_(both, both)])


def _needed(
    sees: sparse.csr_array,
    tour: Tour,
    lit: LitTimes,
    passing: list[Int[np.ndarray, " _"]],
    areas: Float[np.ndarray, " units"],
    goal: float,
) -> Bool[np.ndarray, " v"]:
    """Say which views are needed, given what other legs than the two that would change with a view see."""
    rows = tour.order - 1
    shown = [
        (units := sees.indices[sees.indptr[row] : sees.indptr[row + 1]])[lit.at(float(at))[units]]
        for row, at in zip(rows, tour.times, strict=True)
    ]
    times = np.zeros(len(areas), dtype=np.int64)
    for units in [*shown, *passing]:
        times[units] += 1
    seen = float(areas[times > 0].sum())
    keep = np.ones(len(rows), dtype=bool)
    touched = np.zeros(len(rows) + 2, dtype=bool)
    alone = []
    for n in range(len(rows)):
        less = times.copy()
        for units in (shown[n], *passing[n : n + 2]):
            less[units] -= 1
        alone.append(float(areas[(times > 0) & (less <= 0)].sum()))
    for n in np.argsort(alone):
        less = times.copy()
        for units in (shown[n], *passing[n : n + 2]):
            less[units] -= 1
        lost = float(areas[(times > 0) & (less <= 0)].sum())
        if touched[n : n + 3].any() or seen - lost < goal or keep.sum() <= 1:
            continue
        times, seen, keep[n] = less, seen - lost, False
        touched[n + 1] = True
    answer = np.ones(len(rows), dtype=bool)
    answer[rows[~keep]] = False
    return answer
