"""Plans round small targets: what they count on is seen by the rules, from room allowed, in the light; bounds hold."""

import itertools
import math
import time
from dataclasses import replace

import numpy as np
import pytest

from keepout.geometry import Target
from keepout.inspecting import arranging
from keepout.inspecting.equipment import patch_size, rules_of
from keepout.inspecting.itinerary import Start, frame_of, legs_of
from keepout.inspecting.lit_times import LitTimes
from keepout.inspecting.passing import seen_in_passing, turned
from keepout.inspecting.passive import drift, states_at_times
from keepout.inspecting.planning import candidates, plan
from keepout.inspecting.problem import Problem
from keepout.inspecting.tour import flown
from keepout.mission.environment import relative_motion
from keepout.mission.light import Light
from keepout.mission.scenario import Scenario
from keepout.seeing.cut import cut
from keepout.seeing.room import Room
from keepout.seeing.seeable import Seeable, Verdict
from keepout.seeing.sightlines import Sightlines
from keepout.seeing.visible import in_view, lit_units, visible


def problem_of(name="box", *, light=None, **inspect):
    """Give a problem in which no unit has a witness: the drawn places are all there is."""
    tree = {
        "target": {"source": name},
        "start": {"position": [0.0, 8.0, 3.0]},
        "duration": 6000.0,
        "inspect": {"candidates": 160, "patch_size": 0.5, "stand_off": 1.2, **inspect},
    }
    if light is not None:
        tree["light"] = light
    scenario = Scenario.parse(tree)
    target = Target.load(name)
    patches = cut(target, patch_size(scenario, target))
    nothing = np.zeros(patches.units, dtype=np.int8)
    return Problem(
        scenario,
        target,
        patches,
        rules_of(scenario),
        Sightlines(target.vertices, target.faces, patches),
        Room(target.distance, scenario.inspect.stand_off),
        Seeable(patches, nothing, nothing, np.full((patches.units, 3), np.nan)),
        Light.of(scenario),
    )


def planned(problem, **others):
    start = np.array(problem.scenario.start.position)
    others = {"wanted": problem.patches.counted, "time": 0.0, **others}
    return plan(problem, position=start, **others)


def require_true(problem, result):
    """Check all that a plan says of its views against the rules."""
    told = np.zeros(problem.patches.units, dtype=bool)
    assert problem.target.distance.distance(np.array([v.position for v in result.views])).min() >= 1.2
    for view in result.views:
        seen = visible(problem.sight, problem.rules, view.position)
        assert set(view.units) <= set(seen.units[in_view(seen, view.boresight, problem.rules.half_angle)])
        assert not told[view.units].any()
        told[view.units] = True
    assert not (told & ~result.covered).any()
    assert not (result.covered & ~problem.patches.counted).any()


@pytest.fixture(scope="module")
def box():
    return problem_of()


@pytest.fixture(scope="module")
def whole(box):
    return planned(box, share=1.0)


def test_a_plan_sees_the_whole_box(box, whole):
    require_true(box, whole)
    assert box.patches.coverage(whole.covered) == pytest.approx(1.0)
    # A side of a box faces away from every place that sees the one opposite: at least two views.
    assert 2 <= whole.fewest_views <= whole.greedy_views
    assert len(whole.views) <= whole.greedy_views


def test_the_way_is_at_least_that_from_view_to_view(box, whole):
    stops = np.array([box.scenario.start.position, *(view.position for view in whole.views)])
    straight = float(np.linalg.norm(np.diff(stops, axis=0), axis=1).sum())
    assert straight - 1e-9 <= whole.way_length <= 2.0 * straight
    assert whole.duration >= whole.way_length / box.scenario.chaser.speed_limit


def test_less_is_asked_for_with_fewer_views(box, whole):
    result = planned(box, share=0.7)
    require_true(box, result)
    assert box.patches.coverage(result.covered) >= 0.7
    assert len(result.views) < len(whole.views)


def test_views_pulled_towards_the_way_see_as_much_in_less_time(box, monkeypatch):
    monkeypatch.setattr(arranging, "_PULLS", 0)
    as_drawn = planned(box, share=0.95)
    monkeypatch.undo()
    result = planned(box, share=0.95)
    require_true(box, result)
    assert box.patches.coverage(result.covered) >= 0.95
    assert result.duration < 0.98 * as_drawn.duration
    candidate = candidates(box, box.patches.counted, 0.0)[0].positions
    apart = np.array([np.abs(candidate - view.position).sum(axis=1).min() for view in result.views])
    assert (apart > 1e-6).any()


def test_legs_looked_at_before_are_not_looked_at_again_and_show_the_same(box):
    shown = frame_of(box, box.patches.counted)
    stops = [np.array(place) for place in ([0.0, 8.0, 3.0], [0.0, 5.0, 0.0], [4.0, 3.0, 0.0], [6.0, -2.0, 1.0])]
    courses = [np.stack(pair) for pair in itertools.pairwise(stops)]
    boresights = np.array([-place / np.linalg.norm(place) for place in stops])
    lit = LitTimes.of(box.light, box.sight, box.rules, box.patches.counted, 0.0, 400.0, 5.0)
    asked, known = [], {}

    def counted(place, boresight):
        asked.append(place)
        return shown(place, boresight)

    def seen(times):
        with_ = {"shown": counted, "lit": lit, "rate": math.radians(1.0), "period": 5.0, "known": known}
        return seen_in_passing(courses, boresights, np.array(times), **with_)

    first = seen([0.0, 60.0, 110.0, 180.0])
    number = len(asked)
    assert number > 30
    again = seen([7.0, 67.0, 127.0, 197.0])
    # Of the second leg alone, which lasts ten seconds longer, frames are looked at.
    assert len(asked) - number == 11
    assert [units.tolist() for units in first[::2]] == [units.tolist() for units in again[::2]]
    assert all(len(units) for units in first)


def test_only_what_is_wanted_is_planned_for(box):
    wanted = box.patches.counted & (box.patches.unit_normals()[:, 2] > 0.9)
    result = planned(box, share=1.0, wanted=wanted)
    assert len(result.views) >= 1
    assert (result.covered == wanted).all()
    assert not planned(box, wanted=np.zeros_like(wanted)).views


def test_the_plan_is_the_same_however_fast_the_clock_runs(box, whole, monkeypatch):
    begun = time.perf_counter()
    monkeypatch.setattr(time, "perf_counter", lambda: 1e4 * (begun + next(ticks)))
    ticks = itertools.count()
    again = planned(box, share=1.0)
    assert (again.way_length, again.duration, again.fewest_views) == (
        whole.way_length,
        whole.duration,
        whole.fewest_views,
    )
    assert all(np.array_equal(a.position, b.position) for a, b in zip(again.views, whole.views, strict=True))


def test_the_nearest_view_tour_sees_as_much_and_proves_nothing(box, whole):
    scenario = box.scenario.model_copy(update={"inspect": box.scenario.inspect.model_copy(update={"tour": "nearest"})})
    nearest = planned(replace(box, scenario=scenario), share=0.95)
    require_true(box, nearest)
    assert box.patches.coverage(nearest.covered) >= 0.95
    assert nearest.fewest_views == 0


def greedy_over_way(problem, wanted, share, until):
    """Always the view next that newly shows most a metre of way: metres and area seen after each, by a time."""
    views, _ = candidates(problem, wanted, 0.0)
    start = Start(np.array(problem.scenario.start.position), 0.0, None)
    left, here, rows = problem.patches.unit_areas() * wanted, start.position, []
    goal = (1.0 - share) * left.sum()
    while left.sum() > goal:
        way = problem.fine_ways.nearly(here, views.positions)
        rates = np.where(np.isfinite(way), (views.sees @ left) / np.maximum(way, 1e-3), 0.0)
        rows.append(int(np.argmax(rates)))
        if rates[rows[-1]] == 0.0:
            break
        here = views.positions[rows[-1]]
        left[views.sees.indices[views.sees.indptr[rows[-1]] : views.sees.indptr[rows[-1] + 1]]] = 0.0
    chosen, areas = views.only(np.array(rows)), problem.patches.unit_areas() * wanted
    lit = LitTimes.of(problem.light, problem.sight, problem.rules, wanted, 0.0, until, 5.0)
    between = problem.fine_ways.lengths(np.concatenate([start.position[None], chosen.positions]))
    needs = [np.zeros(0, dtype=int)] * len(rows)
    order = np.arange(1, len(rows) + 1)
    times = flown(legs_of(problem, chosen, needs, lit, start, between), order).times
    metres, seen = [0.0], [0.0]
    for place, at in enumerate(times):
        if at > until:
            break
        areas[chosen.sees.indices[chosen.sees.indptr[place] : chosen.sees.indptr[place + 1]]] = 0.0
        metres.append(metres[-1] + between[0][place, place + 1])
        seen.append(float((problem.patches.unit_areas() * wanted).sum() - areas.sum()))
    return np.array(metres), np.array(seen)


@pytest.mark.long
def test_in_short_time_a_plan_is_nowhere_behind_greed_and_sees_more_than_the_order_for_all(box, whole):
    short = replace(box, scenario=box.scenario.replace(duration=0.4 * whole.duration))
    end, areas = short.scenario.duration, box.patches.unit_areas()
    result = planned(short, share=1.0)
    assert result.duration > end
    metres, seen = [0.0], [0.0]
    told = np.zeros(box.patches.units, dtype=bool)
    for view in result.views:
        if view.at > end:
            break
        told[view.units] = told[view.on_the_way] = True
        metres.append(metres[-1] + view.way)
        seen.append(float(areas[told].sum()))
    assert (told == result.seen_by(end)).all()
    ways, by_greed = greedy_over_way(box, box.patches.counted, 1.0, end)
    for quarter in metres[-1] * np.arange(1, 5) / 4.0:
        mine = seen[np.searchsorted(metres, quarter + 1e-3, side="right") - 1]
        assert mine >= by_greed[np.searchsorted(ways, quarter + 1e-3, side="right") - 1] - 0.02 * areas.sum()
    assert seen[-1] >= by_greed[-1] - 1e-9
    assert seen[-1] >= float(areas[whole.seen_by(end)].sum()) - 1e-9


def test_views_are_as_many_as_asked_for_at_most(box):
    scenario = box.scenario.model_copy(update={"inspect": box.scenario.inspect.model_copy(update={"most_views": 3})})
    assert len(planned(replace(box, scenario=scenario)).views) <= 3


def test_what_no_place_shows_gives_a_plan_without_views(box):
    short = replace(box, rules=replace(box.rules, greatest_range=1.21))
    result = planned(short, share=1.0)
    assert (result.views, result.way_length, result.fewest_views) == ((), 0.0, 0)
    assert not result.covered.any()


class Everywhere(Room):
    """A room that wrongly allows the hollow inside of a box."""

    def allowed(self, points):
        return np.ones(len(points), dtype=bool)


def test_views_to_which_no_way_leads_are_left_out():
    problem = problem_of(stand_off=0.6)
    patches = replace(problem.patches, counted=np.ones(problem.patches.units, dtype=bool))
    hollow = replace(
        problem,
        patches=patches,
        sight=Sightlines(problem.target.vertices, problem.target.faces, patches),
        room=Everywhere(problem.target.distance, 0.6),
    )
    result = planned(hollow, wanted=patches.counted, share=1.0)
    assert result.views
    half = np.array([2.0, 1.5, 1.0])
    assert all((np.abs(view.position) > half).any() for view in result.views)


def test_a_plan_of_what_can_be_seen_by_the_scenario_alone():
    scenario = Scenario.parse(
        {
            "target": {"source": "box"},
            "start": {"position": [0.0, 8.0, 3.0]},
            "inspect": {"patch_size": 1.0, "candidates": 80},
        }
    )
    problem = Problem.of(scenario, Target.load("box"))
    wanted = problem.seeable.verdict == Verdict.SEEABLE
    result = planned(problem, wanted=wanted)
    assert wanted.any()
    assert (result.covered == wanted).all()


def test_with_a_fixed_light_only_what_it_falls_on_is_planned_for():
    problem = problem_of("pocket", light={"kind": "fixed", "direction": [1.0, 0.4, 0.2]})
    sun = problem.light.sun(0.0)
    assert sun is not None
    lit = lit_units(problem.sight, problem.rules, sun)
    result = planned(problem, share=0.9)
    require_true(problem, result)
    assert result.covered.any()
    assert not (result.covered & ~lit).any()
    assert all(view.window == (0.0, math.inf) for view in result.views)


class Circling(Light):
    """A light that goes round the z axis once in 4000 s, and is hidden for the last quarter."""

    @property
    def matters(self):
        return True

    def suns(self, times):
        turn = 2.0 * np.pi * np.asarray(times) / 4000.0
        suns = np.stack([np.cos(turn), np.sin(turn), 0.2 * np.ones_like(turn)], axis=1) / math.sqrt(1.04)
        suns[np.asarray(times) % 4000.0 > 3000.0] = np.nan
        return suns


def test_in_a_light_that_goes_round_each_view_is_flown_in_its_window():
    problem = replace(problem_of(), light=(light := Circling(Scenario())))
    result = planned(problem, share=0.9)
    require_true(problem, result)
    assert result.covered.any()
    last = 0.0
    for view in result.views:
        begin, end = view.window
        assert last - 1e-9 <= end
        last = max(last, begin)
        for now in np.linspace(begin, end, 4):
            assert lit_units(problem.sight, problem.rules, light.suns([now])[0])[view.units].all()


class LowOrbit(Light):
    """The sun over a target in low orbit: round the y axis once in 5677 s, and hidden from 20° below the horizon on."""

    @property
    def matters(self):
        return True

    def suns(self, times):
        turn = 2.0 * np.pi * np.asarray(times) / 5677.0
        suns = np.stack([-np.sin(turn), 0.0 * turn, -np.cos(turn)], axis=1)
        suns[suns[:, 2] > math.sin(math.radians(20.0))] = np.nan
        return suns


def test_in_low_orbit_all_that_is_ever_lit_is_planned_for_that_which_is_lit_for_minutes_too():
    problem = replace(problem_of(), light=(light := LowOrbit(Scenario())))
    ever = np.zeros(problem.patches.units, dtype=bool)
    for sun in light.suns(np.arange(0.0, 6000.0, 60.0)):
        if np.isfinite(sun[0]):
            ever |= lit_units(problem.sight, problem.rules, sun)
    below = problem.patches.unit_normals()[:, 2] > 0.9
    assert (ever & below).any()
    result = planned(problem, wanted=ever, share=1.0)
    require_true(problem, result)
    areas = problem.patches.unit_areas()
    assert float(areas[result.covered].sum()) >= 0.99 * float(areas[ever].sum())
    assert float(areas[result.covered & below].sum()) >= 0.99 * float(areas[ever & below].sum())
    assert result.duration <= problem.scenario.duration
    assert 1 <= result.fewest_views <= len(result.views)


def test_windows_are_the_times_in_which_all_is_lit():
    lit = np.array([[1, 1], [1, 0], [1, 1], [1, 1], [0, 1]], dtype=bool)
    times = LitTimes(np.arange(5) * 10.0, lit, True)
    assert times.windows(np.array([0])) == [(0.0, 30.0)]
    assert times.windows(np.array([0, 1])) == [(0.0, 0.0), (20.0, 30.0)]
    assert times.at(25.0).tolist() == [True, True]
    assert times.at(15.0).tolist() == [True, False]
    assert times.at(41.0).tolist() == [False, False]


def test_a_boresight_turns_on_the_great_circle_and_stops_there():
    first, last = np.array([1.0, 0, 0]), np.array([0, 1.0, 0])
    assert turned(first, last, math.radians(30.0)) == pytest.approx([math.cos(math.pi / 6), 0.5, 0.0])
    assert turned(first, last, 2.0) == pytest.approx(last)
    back = turned(first, -first, math.radians(90.0))
    assert back @ first == pytest.approx(0.0, abs=1e-12)
    assert np.linalg.norm(back) == pytest.approx(1.0)


def test_a_plan_counts_its_legs_and_keeps_to_places_where_rest_is_safe():
    """In a low orbit a drift of half an hour leads from many places back to the box."""
    problem = problem_of(passive_safety=1500.0)
    low = problem.scenario.replace(orbit={"semi_major_axis": 6_878_000.0}, disturbance={"kind": "none"})

    problem = replace(problem, scenario=low)
    result = planned(problem, share=0.9)
    drifts = result.drifts
    assert drifts is not None
    assert drifts.safe == len(result.views)
    assert drifts.legs == drifts.safe + drifts.views_left_out
    assert drifts.candidates_left_out > 0
    places = np.array([view.position for view in result.views])
    begun = states_at_times(low, np.zeros(len(places)), places, np.zeros_like(places))
    path, _ = drift(relative_motion(low), begun, 2.0, 750)
    apart = problem.target.distance.distance(path.reshape(-1, 3)).reshape(path.shape[:2])
    assert np.all(apart.min(axis=1) > low.chaser.radius)
    assert all(0.0 < view.speed <= low.chaser.speed_limit for view in result.views)
    plain = planned(problem_of())
    assert plain.drifts is None
    assert all(np.isinf(view.speed) for view in plain.views)
