"""Balls and capsules against closed forms, and against the points that they must enclose."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from keepout.errors import MeshError
from keepout.geometry.envelopes import small_capsule, smallest_ball, to_segment
from keepout.geometry.target import Target


def clouds():
    return st.tuples(st.integers(0, 2**32 - 1), st.integers(5, 60), st.floats(0.01, 100.0))


def cloud(drawn):
    seed, count, scale = drawn
    generator = np.random.default_rng(seed)
    return scale * (generator.normal(size=(count, 3)) * generator.uniform(0.05, 1.0, 3) + generator.normal(size=3))


@pytest.mark.long
@settings(max_examples=6, deadline=None)
@given(clouds())
def test_ball_and_capsule_enclose_every_point(drawn):
    points = cloud(drawn)
    ball, capsule = smallest_ball(points), small_capsule(points)
    size = np.abs(points).max()
    assert np.linalg.norm(points - ball.centre, axis=1).max() <= ball.radius + 1e-12 * size
    assert to_segment(points, capsule.start, capsule.end).max() <= capsule.radius + 1e-12 * size


@settings(max_examples=50, deadline=None)
@given(clouds())
def test_the_ball_is_the_smallest(drawn):
    # The optimality condition: the centre is a convex mean of points on the ball, so no shift takes it closer to all.
    points = cloud(drawn)
    ball = smallest_ball(points)
    away = np.linalg.norm(points - ball.centre, axis=1)
    touching = (points - ball.centre)[away > ball.radius * (1.0 - 1e-7)] / ball.radius
    directions = np.random.default_rng(0).normal(size=(2000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    assert (touching @ directions.T).min(axis=0).max() <= 1e-5


def test_the_capsule_of_a_capsules_points_is_that_capsule():
    generator = np.random.default_rng(1)
    sphere = generator.normal(size=(400, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    turn = np.linalg.qr(generator.normal(size=(3, 3)))[0]
    ends = np.array([[2.0, 0.0, 0.0], [-2.0, 0.0, 0.0]]) @ turn + 5.0
    found = small_capsule(np.concatenate([sphere + ends[0], sphere + ends[1]]))
    assert found.radius == pytest.approx(1.0, rel=0.02)
    assert np.linalg.norm(found.end - found.start) == pytest.approx(4.0, rel=0.02)


def test_a_target_lies_in_a_capsule_no_larger_than_its_ball():
    points = Target.load("intelsat30").vertices
    ball, capsule = smallest_ball(points), small_capsule(points)
    assert to_segment(points, capsule.start, capsule.end).max() <= capsule.radius + 1e-12
    assert capsule.volume < 0.5 * ball.volume


def test_flat_points_are_refused():
    with pytest.raises(MeshError, match="span no volume"):
        smallest_ball(np.zeros((10, 3)))
