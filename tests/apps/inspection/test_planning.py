"""Plans round small targets: what they count on is seen by the rules, from room allowed, in the light; bounds hold."""

import itertools
import math
import time
from dataclasses import replace

import numpy as np
import pytest
from truths.box_problems import problem_of
from truths.boxes import HALF
from truths.lights import Round

from keepout.apps.inspection.passive import drift, states_at_times
from keepout.apps.inspection.plan import turned
from keepout.apps.inspection.planning import plan
from keepout.apps.inspection.seeing.room import Room
from keepout.apps.inspection.seeing.sightlines import Sightlines
from keepout.apps.inspection.seeing.visible import in_view, lit_units, visible
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings

pytestmark = pytest.mark.long


def asked(**inspect):
    """Give the problem of the box for a mission that asks for this."""
    options = {"candidates": 100, "patch_size": 0.5, "stand_off": 1.2, **inspect}
    start = {"position": (0.0, 8.0, 3.0)}
    return problem_of(Scenario().replace(target={"source": "box"}, start=start, duration=6000.0, inspect=options))


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
    return asked()


@pytest.fixture(scope="module")
def whole(box):
    return planned(box, share=1.0)


def test_a_plan_sees_the_whole_box(box, whole):
    require_true(box, whole)
    assert box.patches.coverage(whole.covered) == pytest.approx(1.0)
    # A side of a box faces away from every place that sees the one opposite: at least two views.
    assert 2 <= whole.fewest_views <= whole.greedy_views
    assert len(whole.views) <= whole.greedy_views
    stops = np.array([box.scenario.start.position, *(view.position for view in whole.views)])
    straight = float(np.linalg.norm(np.diff(stops, axis=0), axis=1).sum())
    assert straight - 1e-9 <= whole.way_length <= 2.0 * straight
    assert whole.duration >= whole.way_length / box.scenario.chaser.speed_limit


@pytest.mark.slow
def test_the_plan_is_the_same_however_fast_the_clock_runs(box, whole, monkeypatch):
    begun, ticks = time.perf_counter(), itertools.count()
    monkeypatch.setattr(time, "perf_counter", lambda: 1e4 * (begun + next(ticks)))
    again = planned(box, share=1.0)
    for name in ("way_length", "duration", "fewest_views"):
        assert getattr(again, name) == getattr(whole, name)
    assert all(np.array_equal(a.position, b.position) for a, b in zip(again.views, whole.views, strict=True))


def test_views_are_as_many_as_asked_for_at_most_and_none_where_no_place_shows_anything(box):
    few = replace(box, scenario=box.scenario.replace(inspect={"most_views": 3}))
    assert len(planned(few).views) <= 3
    result = planned(replace(box, rules=replace(box.rules, greatest_range=1.21)), share=1.0)
    assert (result.views, result.way_length, result.fewest_views) == ((), 0.0, 0)
    assert not result.covered.any()


class Everywhere(Room):
    """A room that wrongly allows the hollow inside of a box."""

    def allowed(self, points):
        return np.ones(len(points), dtype=bool)


def test_views_to_which_no_way_leads_are_left_out():
    problem = asked(stand_off=0.6)
    patches = replace(problem.patches, counted=np.ones(problem.patches.units, dtype=bool))
    hollow = replace(
        problem,
        patches=patches,
        sight=Sightlines(problem.target.vertices, problem.target.faces, patches),
        room=Everywhere(problem.target.distance, 0.6),
    )
    result = planned(hollow, wanted=patches.counted, share=1.0)
    assert result.views
    assert all((np.abs(view.position) > HALF).any() for view in result.views)


@pytest.mark.slow  # tours in a moving light are in test_light_tour
def test_in_low_orbit_all_that_is_ever_lit_is_planned_for_that_which_is_lit_for_minutes_too():
    """The sun goes round once in 5677 s, and is hidden from 20° below the horizon on."""
    light = Round(Scenario(), (0, 0, -1), (-1, 0, 0), 5677.0, lambda suns: suns[:, 2] > math.sin(math.radians(20.0)))
    problem = replace(asked(), light=light)
    ever = np.zeros(problem.patches.units, dtype=bool)
    for sun in light.suns(np.arange(0.0, 6000.0, 60.0)):
        if np.isfinite(sun[0]):
            ever |= lit_units(problem.sight, problem.rules, sun)
    below = problem.patches.unit_normals()[:, 2] > 0.9
    assert (ever & below).any()
    result = planned(problem, wanted=ever, share=1.0)
    require_true(problem, result)
    areas = problem.patches.unit_areas()
    for of in (ever, ever & below):
        assert float(areas[result.covered & of].sum()) >= 0.99 * float(areas[of].sum())
    assert result.duration <= problem.scenario.duration
    assert 1 <= result.fewest_views <= len(result.views)


def test_a_boresight_turns_on_the_great_circle_and_stops_there():
    first, last = np.array([1.0, 0, 0]), np.array([0, 1.0, 0])
    assert turned(first, last, math.radians(30.0)) == pytest.approx([math.cos(math.pi / 6), 0.5, 0.0])
    assert turned(first, last, 2.0) == pytest.approx(last)
    back = turned(first, -first, math.radians(90.0))
    assert back @ first == pytest.approx(0.0, abs=1e-12)
    assert np.linalg.norm(back) == pytest.approx(1.0)


@pytest.mark.slow  # what a drift touches is in tests/apps/inspection/test_passive.py and test_drifting.py
def test_a_plan_counts_its_legs_and_keeps_to_places_where_rest_is_safe(whole):
    """In a low orbit a drift of half an hour leads from many places back to the box."""
    problem = asked(passive_safety=1500.0)
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
    path, _ = drift(Surroundings(low).motion, begun, 2.0, 750)
    apart = problem.target.distance.distance(path.reshape(-1, 3)).reshape(path.shape[:2])
    assert np.all(apart.min(axis=1) > low.chaser.radius)
    assert all(0.0 < view.speed <= low.chaser.speed_limit for view in result.views)
    assert whole.drifts is None
    assert all(np.isinf(view.speed) for view in whole.views)
