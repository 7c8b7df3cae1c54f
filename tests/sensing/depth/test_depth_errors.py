"""Errors of images: never beyond their bounds, and adversarial ones at them."""

import math

import numpy as np
import pytest

from keepout.mapping import SensorBounds
from keepout.sensing.depth import ErrorDraw, axes_towards
from keepout.sensing.depth.errors import rotation_by

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


def check_poses(size, count):
    generator, draw = np.random.default_rng(1), ErrorDraw(size)
    for _ in range(count):
        offset, rotation = draw.pose_error(generator, AXES, BOUNDS)
        length, angle = math.hypot(*offset), angle_of(rotation)
        assert length <= BOUNDS.position_error + 1e-15
        assert angle <= BOUNDS.attitude_error + 1e-15
        if size == "adversarial":
            assert abs(length - BOUNDS.position_error) < 1e-9
            assert abs(angle - BOUNDS.attitude_error) < 1e-9
            # Never backwards: what is seen is never taken to be nearer than it is.
            assert offset @ AXES[:, 2] > -1e-15


@pytest.mark.parametrize("size", ["random", "adversarial"])
def test_pose_errors_are_within_their_bounds(size):
    check_poses(size, 3000)


@pytest.mark.slow
@pytest.mark.parametrize("size", ["random", "adversarial"])
def test_many_pose_errors_are_within_their_bounds(size):
    check_poses(size, 100_000)


def test_random_places_fill_their_ball_evenly():
    generator, draw = np.random.default_rng(2), ErrorDraw()
    offsets = np.array([draw.pose_error(generator, AXES, BOUNDS)[0] for _ in range(5000)]) / BOUNDS.position_error
    lengths = np.linalg.norm(offsets, axis=1)
    # The share within r is r cubed; five standard deviations.
    for r in (0.3, 0.5, 0.8, 0.95):
        assert abs((lengths < r).mean() - r**3) < 5.0 * math.sqrt(r**3 * (1.0 - r**3) / 5000)
    assert np.abs(offsets.mean(axis=0)).max() < 5.0 / math.sqrt(5.0 * 5000)


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


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-3, 1.0, math.pi])
def test_rotations_are_rotations_of_their_angle(angle):
    axis = np.array([2.0, -1.0, 2.0]) / 3.0
    rotation = rotation_by(angle * axis)
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(rotation @ axis, axis, atol=1e-15)
    assert abs(angle_of(rotation) - angle) < 1e-14
    across = np.cross(axis, [0.0, 0.0, 1.0])
    turned = math.cos(angle) * across + math.sin(angle) * np.cross(axis, across)
    np.testing.assert_allclose(rotation @ across, turned, atol=1e-15)
