"""Bodies round a cloud of points - ball, capsule, ellipsoid, hull - against closed forms and the points within."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from keepout.core.errors import MeshError
from keepout.core.geometry import shape
from keepout.core.geometry.envelopes import small_capsule, smallest_ball, to_segment

CLOUDS = st.tuples(st.integers(0, 2**32 - 1), st.integers(5, 60), st.floats(0.01, 100.0))


def cloud(drawn):
    seed, count, scale = drawn
    generator = np.random.default_rng(seed)
    return scale * (generator.normal(size=(count, 3)) * generator.uniform(0.05, 1.0, 3) + generator.normal(size=3))


@given(CLOUDS)
def test_the_ball_encloses_every_point_and_is_the_smallest(drawn):
    # The optimality condition: the centre is a convex mean of points on the ball, so no shift takes it closer to all.
    points = cloud(drawn)
    ball = smallest_ball(points)
    away = np.linalg.norm(points - ball.centre, axis=1)
    assert away.max() <= ball.radius + 1e-12 * np.abs(points).max()
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
    points = np.concatenate([sphere + ends[0], sphere + ends[1]])
    found = small_capsule(points)
    assert to_segment(points, found.start, found.end).max() <= found.radius + 1e-12
    assert found.radius == pytest.approx(1.0, rel=0.02)
    assert np.linalg.norm(found.end - found.start) == pytest.approx(4.0, rel=0.02)


def test_smallest_ellipsoid_of_an_affine_simplex():
    # The smallest ellipsoid of an affine image is the affine image of the smallest: a regular simplex gives the sphere.
    simplex = np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)], dtype=float)
    stretch = np.array([[2.0, 0.3, 0.0], [0.0, 1.0, -0.4], [0.1, 0.0, 0.7]])
    found = shape.smallest_ellipsoid(simplex @ stretch.T)
    assert found.volume == pytest.approx(4.0 / 3.0 * np.pi * 3.0**1.5 * np.linalg.det(stretch), rel=1e-6)


@pytest.mark.parametrize("body", [shape.smallest_ellipsoid, smallest_ball])
def test_flat_points_are_refused(body):
    with pytest.raises(MeshError, match="span no volume"):
        body(np.zeros((10, 3)))
