"""Which view comes next: ends that are said, views that are not repeated, and goals that explorations connect."""

import math

import explore_views
import numpy as np
import pytest

from keepout.exploring import Ended, NextView, Tried, choose, reachable
from keepout.exploring.sight import UP
from keepout.mapping import KnownFreeMap, Pinhole, SensorBounds, View
from keepout.sensing.depth import DepthCamera, axes_towards

CAMERA = Pinhole(80, 60, math.radians(60.0))
KEEP = 0.5
OUTSIDE = np.array([2.8, 0.0, 0.0])


def begun(radius=1.5, **bounds):
    return KnownFreeMap.begin(np.zeros(3), radius, bounds=SensorBounds(**bounds), name="test")


def next_of(known, goal=None, tried=None, position=OUTSIDE, **options):
    return choose(known, position, goal, CAMERA, tried or Tried.nothing(known), keep=KEEP, **options)


def test_a_goal_in_known_free_room_is_flown_to():
    answer = next_of(begun(), np.array([-2.6, 0.0, 0.0]))
    assert isinstance(answer, NextView)
    assert answer.is_goal
    assert np.array_equal(answer.position, [-2.6, 0.0, 0.0])


def test_the_first_view_looks_at_the_ball_from_room_that_keeps_the_distance_and_is_the_same_again():
    known = begun(4.0)
    for goal in (None, np.zeros(3)):
        answer = next_of(known, goal, position=np.array([5.3, 0.0, 0.0]))
        assert isinstance(answer, NextView)
        assert reachable(known, np.array([5.3, 0.0, 0.0]), KEEP).way_length(answer.position) < math.inf
        assert np.linalg.norm(answer.position) > 4.0 + KEEP - 0.1
        assert answer.direction @ answer.position < 0.0
        assert answer.gain > 0.0
        again = next_of(known, goal, position=np.array([5.3, 0.0, 0.0]))
        assert isinstance(again, NextView)
        assert np.array_equal(answer.position, again.position)
        assert np.array_equal(answer.direction, again.direction)


def test_a_chaser_that_is_too_near_to_unknown_room_is_told_so():
    answer = next_of(begun(), position=np.zeros(3))
    assert isinstance(answer, Ended)
    assert answer.outcome == "no way known"
    assert "0.50 m" in answer.why


def test_a_goal_too_near_to_the_seen_surface_ends_at_once_and_one_farther_does_not():
    run = explore_views.Jumping(explore_views.solid("ball"), "ball", DepthCamera(), KEEP, 0)
    run.look()
    seen = run.position / np.linalg.norm(run.position)
    answer = run.step(2.05 * seen)
    assert isinstance(answer, Ended)
    assert "seen surface" in answer.why
    assert len(answer.unknown) > 0
    assert isinstance(run.step(3.0 * seen), NextView)


@pytest.mark.parametrize("goal", [None, np.zeros(3)])
def test_views_that_open_nothing_are_not_taken_again_and_come_to_an_end(goal):
    known = begun(1.0)
    tried = Tried.nothing(known)
    position, before = np.array([2.0, 0.0, 0.0]), []
    blind = np.full(CAMERA.shape, np.nan)
    for count in range(60):
        answer = next_of(known, goal, tried, position, seed=count)
        if isinstance(answer, Ended):
            break
        for place, direction in before:
            assert np.linalg.norm(answer.position - place) >= 0.3 or answer.direction @ direction < math.cos(
                math.radians(10)
            )
        position = answer.position
        before.append((position, answer.direction))
        view = View(CAMERA, position, axes_towards(answer.direction, UP), blind, 0.0)
        assert known.see(view).opened == 0
        tried.note(known, view)
    assert isinstance(answer, Ended)
    assert answer.outcome == ("everything reachable seen" if goal is None else "no way known")
    assert "stayed closed in 3 views" in answer.why
    assert len(answer.unknown) > 0


@pytest.mark.long
@pytest.mark.parametrize("name", ["ball", "plates", "pocket"])
def test_exploring_all_round_connects_goals_that_flying_around_does_not(name):
    mesh = explore_views.solid(name)
    goals = explore_views.goals_near(mesh, 60, 5)
    run = explore_views.Jumping(mesh, name, DepthCamera(), KEEP, 1)
    row = explore_views.all_round(run, goals, 40)
    assert row["connected"]["40"] >= 0.97
    assert row["outcome"] in ("everything reachable seen", None)
    # Every cube called free is outside the body: the nearest surface is farther than half a cube from its middle.
    exact = explore_views.ExactDistance(np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.faces))
    centres = run.known.origin + run.known.spacing * (np.argwhere(run.known.free) + 0.5)
    inner = centres[np.linalg.norm(centres, axis=1) < run.radius]
    assert exact.distance(inner).min() > 0.5 * run.known.spacing


@pytest.mark.long
def test_a_goal_at_the_bottom_of_a_pocket_is_reached_and_one_inside_its_wall_is_not():
    mesh = explore_views.solid("pocket")
    run = explore_views.Jumping(mesh, "pocket", DepthCamera(), KEEP, 2)
    for _ in range(30):
        run.look()
        answer = run.step(np.array([0.0, 0.0, -1.2]))
        if isinstance(answer, Ended) or answer.is_goal:
            break
    assert isinstance(answer, NextView)
    assert answer.is_goal
    for _ in range(30):
        answer = run.step(np.array([1.8, 0.0, 0.0]))
        if isinstance(answer, Ended):
            break
        run.look()
    assert isinstance(answer, Ended)
    assert answer.outcome == "no way known"


@pytest.mark.long
def test_without_sure_empty_range_less_connects_and_it_is_said_what_is_missing():
    mesh = explore_views.solid("ball")
    goals = explore_views.goals_near(mesh, 60, 5)
    camera = DepthCamera(bounds=SensorBounds(sure_empty_range=0.0))
    row = explore_views.all_round(explore_views.Jumping(mesh, "ball", camera, KEEP, 1), goals, 30)
    assert row["connected"]["30"] < 0.6
