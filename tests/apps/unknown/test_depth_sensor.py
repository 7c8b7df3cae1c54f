"""The depth sensor: its settings, errors within their bounds and at them, and where it points."""

import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from keepout.apps.led.camera import Boresight, Pinhole, axes_towards
from keepout.apps.unknown.depth_sensor import DepthCamera, ErrorDraw
from keepout.apps.unknown.view import SensorBounds
from keepout.core.errors import KeepoutError

AHEAD = np.array([1.0, 0.0, 0.0])


def at_rest(rate, acceleration):
    return Boresight.at_rest(AHEAD, greatest_rate=rate, greatest_acceleration=acceleration)


NARROW = SensorBounds(surely_returned_width=0.01, rays_across=3, least_range=0.3)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: DepthCamera(Pinhole(20, 20, 2.0), NARROW), r"surely_returned_width.* 0\.01.*0\.0963"),
        (lambda: DepthCamera(dropout=1.5), "dropout.* 1.5"),
        (lambda: DepthCamera(grazing_angle=2.0), "grazing_angle.* 2"),
        (lambda: DepthCamera(period=0.0), "period.* 0 s"),
        (lambda: DepthCamera(latency=-1.0), "latency.* -1 s"),
        (lambda: DepthCamera(mounting=(math.inf, 0.0, 0.0)), "mounting.*inf"),
        (lambda: ErrorDraw("gaussian"), "size.* 'gaussian'"),
        (lambda: ErrorDraw("random", "everything"), "broken.* 'everything'"),
        (lambda: at_rest(0.0, 1.0), "greatest_rate.* 0 rad/s"),
        (lambda: at_rest(1.0, math.nan), "greatest_acceleration.* nan"),
        (lambda: axes_towards(np.zeros(3), AHEAD), "direction.* not zero"),
        (lambda: at_rest(1.0, 1.0).step(AHEAD, 0.0), "period.* 0 s"),
    ],
)
def test_bad_settings_are_refused_in_one_line_with_their_numbers(make, said):
    with pytest.raises(KeepoutError, match=rf"\A[^\n]*{said}[^\n]*\Z"):
        make()


def test_the_sensor_sits_where_it_is_mounted():
    sensor = DepthCamera(mounting=(0.1, 0.2, 0.3))
    axes = axes_towards(AHEAD, np.array([0.0, 0.0, 1.0]))
    # x of the image is to the right, -y of the map; y is down, -z of the map; z is ahead, x of the map.
    np.testing.assert_allclose(sensor.sensor_position(np.array([5.0, 0.0, 0.0]), axes), [5.3, -0.1, -0.2])


BOUNDS = SensorBounds(range_error=0.03, position_error=0.05, attitude_error=0.005)
AXES = axes_towards(np.array([0.3, -0.5, 0.2]), np.array([0.0, 0.0, 1.0]))


def angle_of(rotation):
    """Angle of a rotation matrix: its antisymmetric part is sine times axis, its trace 1 + 2 cosine."""
    sine = 0.5 * np.linalg.norm(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    return math.atan2(sine, 0.5 * (np.trace(rotation) - 1.0))


@pytest.mark.parametrize("size", ["random", "adversarial"])
def test_a_million_range_errors_are_within_the_bound(size):
    generator, draw = np.random.default_rng(0), ErrorDraw(size)
    errors = np.stack([draw.range_errors(generator, (100, 100), BOUNDS) for _ in range(100)])
    assert np.abs(errors).max() <= BOUNDS.range_error
    if size == "adversarial":
        np.testing.assert_allclose(np.abs(errors), BOUNDS.range_error, atol=1e-9)
        long = (errors > 0.0).all(axis=(1, 2))
        assert 20 < long.sum() < 80
        assert abs(errors[~long].mean()) < 1e-3
    else:
        assert abs(errors.mean()) < 1e-4
        assert abs(errors.std() - BOUNDS.range_error / math.sqrt(3.0)) < 1e-4


@pytest.mark.parametrize("size", ["random", "adversarial"])
def test_pose_errors_are_within_their_bounds(size):
    generator, draw = np.random.default_rng(1), ErrorDraw(size)
    for _ in range(3000):
        offset, rotation = draw.pose_error(generator, AXES, BOUNDS)
        length, angle = math.hypot(*offset), angle_of(rotation)
        assert length <= BOUNDS.position_error + 1e-15
        assert angle <= BOUNDS.attitude_error + 1e-15
        if size == "adversarial":
            assert abs(length - BOUNDS.position_error) < 1e-9
            assert abs(angle - BOUNDS.attitude_error) < 1e-9
            # Never backwards: what is seen is never taken to be nearer than it is.
            assert offset @ AXES[:, 2] > -1e-15


def test_an_adversarial_turn_moves_what_is_ahead_the_way_the_place_moves():
    """Sideways errors of place and axes add up: what is ahead, told by the wrong pose, is off by their sum."""
    generator, draw = np.random.default_rng(3), ErrorDraw("adversarial")
    sum_reached = 0.0
    for _ in range(200):
        offset, rotation = draw.pose_error(generator, AXES, BOUNDS)
        ahead = 6.0 * AXES[:, 2]
        off = offset + rotation @ ahead - ahead
        sideways = off - (off @ AXES[:, 2]) * AXES[:, 2]
        sum_reached = max(sum_reached, float(np.linalg.norm(sideways)))
    most = BOUNDS.position_error + 6.0 * math.sin(BOUNDS.attitude_error)
    assert 0.999 * most < sum_reached <= most + 1e-12


directions = st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda v: math.hypot(*v) > 0.1).map(np.array)


@given(directions, directions)
@example(np.array([-0.7734375, 1.0, -0.7734375]), np.array([-0.771484375, 1.0, -0.7734375]))  # nearly one line
@example(np.array([0.0, 0.0, -1.0]), np.array([0.0, 0.0, 2.0]))
def test_axes_are_a_rotation_with_the_image_upright(direction, up):
    axes = axes_towards(direction, up)
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-14)
    assert np.linalg.det(axes) > 0.0
    np.testing.assert_allclose(axes[:, 2], direction / np.linalg.norm(direction), atol=1e-15)
    if np.linalg.norm(np.cross(direction, up)) > 1e-6:
        assert abs(axes[:, 0] @ up) < 1e-8  # x is level
        assert axes[:, 1] @ up < 0.0  # y is down


@pytest.mark.long
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
@settings(max_examples=settings().max_examples // 2)  # each flies for minutes
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


@pytest.mark.parametrize("turning", [np.zeros(3), np.array([0.0, 0.05, 0.0])])
def test_straight_behind_it_turns_as_it_does_already_or_any_way(turning):
    boresight = Boresight(np.array([1.0, 0.0, 0.0]), turning, 0.1, 0.01)
    for _ in range(60):
        boresight = boresight.step(np.array([-1.0, 0.0, 0.0]), 1.0)
    assert boresight.off(np.array([-1.0, 0.0, 0.0])) < 1e-9
    if turning.any():
        assert abs(boresight.direction[1]) < 1e-9  # never left the plane that it turned in
