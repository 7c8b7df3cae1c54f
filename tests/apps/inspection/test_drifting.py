"""Speeds of legs that are passively safe, against closed forms and drifts from anywhere on a leg."""

import numpy as np
import pytest

from keepout.apps.inspection.passive import Drifting, drift, states_at_times
from keepout.apps.inspection.plan import kept_safe
from keepout.apps.inspection.tour import Tour
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings

pytestmark = [pytest.mark.long, pytest.mark.as_used]

RADIUS = 5.0
FAR, LOW = 42_164_000.0, 6_878_000.0
"""Semi-major axes, m."""


def ball(points):
    """Distance to a ball of 5 m about the origin."""
    return np.abs(np.linalg.norm(points, axis=-1) - RADIUS)


def judge(seconds, axis=FAR):
    case = Scenario.parse({"orbit": {"semi_major_axis": axis}, "inspect": {"passive_safety": seconds}})
    found = Drifting.of(case, ball)
    assert found is not None
    return found


@pytest.mark.slow
@pytest.mark.parametrize("seconds", [40.0, 300.0])
def test_a_leg_towards_a_ball_is_as_slow_as_the_room_before_it_asks(seconds):
    """From 8 m the drift comes to 8 m − v t: it must keep 5 m, the chaser's 0.5 m and what stands for states between.

    So high and for so short a time gravity moves the chaser by centimetres.
    """
    found = judge(seconds)
    (speed,) = found.speeds([np.array([[15.0, 0.0, 0.0], [8.0, 0.0, 0.0]])], np.zeros((1, 2)))
    room = 8.0 - RADIUS - found.scenario.chaser.radius
    assert 0.6 * (room - 0.25) < speed * seconds < room
    (past,) = found.speeds([np.array([[15.0, 8.0, 0.0], [-15.0, 8.0, 0.0]])], np.zeros((1, 2)))
    assert past == found.scenario.chaser.speed_limit
    none = found.speeds([np.array([[15.0, 0.0, 0.0], [5.55, 0.0, 0.0]])], np.zeros((1, 2)))
    assert none == 0.0


@pytest.mark.slow  # test_passive.py has drifts aimed at the ball
@pytest.mark.parametrize("axis", [FAR, LOW])
def test_no_drift_from_anywhere_on_a_leg_at_its_speed_touches_the_ball(axis):
    generator, seconds = np.random.default_rng(3), 600.0
    found = judge(seconds, axis)
    ends = generator.normal(size=(12, 3, 3))
    courses = list(ends / np.linalg.norm(ends, axis=2, keepdims=True) * generator.uniform(9.0, 16.0, (12, 3, 1)))
    times = np.tile([0.0, 400.0], (12, 1))
    speeds = found.speeds(courses, times)
    assert 0.0 < np.mean(speeds > 0.0) < 1.0 or np.any(speeds < 0.1)
    for course, speed in zip(courses, speeds, strict=True):
        piece = generator.integers(0, 2, 40)
        share = generator.uniform(0.0, 1.0, (40, 1))
        begin, ahead = course[piece], np.diff(course, axis=0)[piece]
        velocity = speed * ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
        begun = states_at_times(found.scenario, np.zeros(40), begin + share * ahead, velocity)
        path, _ = drift(Surroundings(found.scenario).motion, begun, 2.0, 300)
        if speed > 0.0:
            assert np.all(ball(path).min(axis=1) > found.scenario.chaser.radius)


PLACES = np.array([[14.0, 9.0, 0.0], [0.0, 9.0, 0.0], [0.0, 5.6, 0.0], [0.0, 7.5, 0.0], [-14.0, 9.0, 0.0]])


@pytest.mark.slow  # drifts are judged in test_passive
def test_a_tour_is_slowed_where_it_must_be_and_goes_round_what_it_may_not_fly_to():
    """Past the ball, down to it too near, down to it near enough to be slow, and away."""
    found = judge(200.0)
    tour = Tour(np.arange(1, 5), np.array([140.0, 180.0, 200.0, 350.0]), 360.0, 0.0)
    way = (lambda a, b: PLACES[[a, b]]), (lambda a, b: 0.0)
    left, courses, speeds, told = kept_safe(found, tour, *way, begin=0.0, dwell=0.0)
    assert left.order.tolist() == [1, 3, 4]
    assert (told.legs, told.safe, told.slowed, told.views_left_out) == (4, 3, 1, 1)
    assert [course[0].tolist() for course in courses] == [PLACES[row].tolist() for row in (0, 1, 3)]
    limit = found.scenario.chaser.speed_limit
    assert speeds[0] == speeds[2] == limit
    assert speeds[1] * 200.0 < 2.0
    # 1.5 m so slowly take longer than the 60 s planned, and all that comes after is as late.
    late = left.times - tour.times[[0, 2, 3]]
    assert late[0] == 0.0
    assert late[1] == pytest.approx(1.5 / speeds[1] - 15.0, abs=1.5 * 60.0)
    assert late[1] > 0.0
    assert left.end - tour.end == pytest.approx(late[2])
    same, _, fastest, nothing = kept_safe(None, tour, *way, begin=0.0, dwell=0.0)
    assert (same, nothing) == (tour, None)
    assert np.all(np.isinf(fastest))
