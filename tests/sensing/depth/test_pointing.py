"""The boresight: axes for a direction, and turns that pass neither their limits nor their goal."""

import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from keepout.sensing.depth import Boresight, axes_towards

directions = st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda v: math.hypot(*v) > 0.1).map(np.array)


@given(directions, directions)
@example(np.array([-0.7734375, 1.0, -0.7734375]), np.array([-0.771484375, 1.0, -0.7734375]))  # nearly one line
def test_axes_are_a_rotation_with_the_image_upright(direction, up):
    axes = axes_towards(direction, up)
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-14)
    assert np.linalg.det(axes) > 0.0
    np.testing.assert_allclose(axes[:, 2], direction / np.linalg.norm(direction), atol=1e-15)
    if np.linalg.norm(np.cross(direction, up)) > 1e-6:
        assert abs(axes[:, 0] @ up) < 1e-8  # x is level
        assert axes[:, 1] @ up < 0.0  # y is down


def test_axes_exist_where_the_boresight_is_along_up():
    for sign in (1.0, -1.0):
        axes = axes_towards(np.array([0.0, 0.0, sign]), np.array([0.0, 0.0, 2.0]))
        np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-15)
        np.testing.assert_array_equal(axes[:, 2], [0.0, 0.0, sign])


@pytest.mark.long
@settings(max_examples=50)
@given(
    directions,
    st.floats(1e-6, math.pi),
    st.floats(0.0, 2.0 * math.pi),
    st.floats(0.02, 0.5),
    st.floats(0.001, 0.2),
    st.sampled_from([0.5, 1.0, 3.0]),
)
def test_from_rest_it_arrives_in_time_and_never_passes(start, angle, around, rate, acceleration, period):
    axes = axes_towards(start, np.array([0.0, 0.0, 1.0]))
    side = math.cos(around) * axes[:, 0] + math.sin(around) * axes[:, 1]
    wanted = math.cos(angle) * axes[:, 2] + math.sin(angle) * side
    boresight = Boresight.at_rest(start, greatest_rate=rate, greatest_acceleration=acceleration)
    angle = boresight.off(wanted)
    ramp = angle >= rate**2 / acceleration
    least_time = angle / rate + rate / acceleration if ramp else 2.0 * math.sqrt(angle / acceleration)
    way = -np.inf
    for _ in range(math.ceil(least_time / period) + 4):
        before = boresight
        boresight = boresight.step(wanted, period)
        assert np.linalg.norm(boresight.turning) <= rate * (1.0 + 1e-12)
        assert np.linalg.norm(boresight.turning - before.turning) <= acceleration * period * (1.0 + 1e-12)
        # Along the great circle, from the start to the goal and not beyond.
        if angle < 3.0:
            now = math.atan2(boresight.direction @ side, boresight.direction @ axes[:, 2])
            assert way - 1e-12 <= now <= angle + 1e-9
            way = now
        assert boresight.off(wanted) <= before.off(wanted) + 1e-9
    assert boresight.off(wanted) < 1e-7
    assert np.linalg.norm(boresight.turning) < 1e-7


@pytest.mark.long
@settings(max_examples=20)
@given(st.lists(directions, min_size=1, max_size=8), st.floats(0.02, 0.5), st.floats(0.002, 0.2))
def test_the_limits_hold_whatever_is_wanted_and_it_settles_in_the_end(wanted, rate, acceleration):
    boresight = Boresight.at_rest(np.array([1.0, 0.0, 0.0]), greatest_rate=rate, greatest_acceleration=acceleration)
    for goal in [
        *np.repeat(wanted, 7, axis=0),
        *[wanted[-1]] * math.ceil(60.0 + 4.0 * math.pi / rate + 8.0 * rate / acceleration),
    ]:
        before = boresight
        boresight = boresight.step(goal, 1.0)
        assert np.linalg.norm(boresight.turning) <= rate * (1.0 + 1e-12)
        assert np.linalg.norm(boresight.turning - before.turning) <= acceleration * (1.0 + 1e-12)
        assert abs(np.linalg.norm(boresight.direction) - 1.0) < 1e-14
        assert abs(boresight.turning @ boresight.direction) < 1e-14
        # The direction moves by what the rate says, and no further.
        assert boresight.off(before.direction) <= np.linalg.norm(boresight.turning) + 1e-9
    assert boresight.off(wanted[-1]) < 1e-3


def test_a_step_makes_a_new_value_and_keeps_the_old():
    start = Boresight.at_rest(np.array([1.0, 0.0, 0.0]), greatest_rate=0.1, greatest_acceleration=0.01)
    after = start.step(np.array([0.0, 1.0, 0.0]), 1.0)
    np.testing.assert_array_equal(start.direction, [1.0, 0.0, 0.0])
    np.testing.assert_array_equal(start.turning, np.zeros(3))
    np.testing.assert_allclose(after.turning, [0.0, 0.0, 0.01])


@pytest.mark.parametrize("turning", [np.zeros(3), np.array([0.0, 0.05, 0.0])])
def test_straight_behind_it_turns_as_it_does_already_or_any_way(turning):
    boresight = Boresight(np.array([1.0, 0.0, 0.0]), turning, 0.1, 0.01)
    for _ in range(60):
        boresight = boresight.step(np.array([-1.0, 0.0, 0.0]), 1.0)
    assert boresight.off(np.array([-1.0, 0.0, 0.0])) < 1e-9
    if turning.any():
        assert abs(boresight.direction[1]) < 1e-9  # never left the plane that it turned in
