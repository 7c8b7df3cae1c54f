"""Rivals of `benchmarks/rivals.py`: envelopes and splines against closed forms."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.interpolate
from hypothesis import given
from hypothesis import strategies as st
from rivals_laws.envelope_fields import CapsuleField, EllipsoidField
from rivals_laws.field_spline import FieldSpline
from rivals_laws.round_bodies import small_capsule, smallest_ball, to_segment

CLOUDS = st.tuples(st.integers(0, 2**32 - 1), st.integers(5, 60), st.floats(0.01, 100.0))


def closest_on_ellipsoid(point, semi_axes):
    """Brute force: the nearest of many surface points, then again in a patch round it."""
    centre, width = np.array([0.5 * np.pi, 0.0]), np.array([0.5 * np.pi, np.pi])
    for _ in range(12):
        theta, phi = np.meshgrid(*(c + w * np.linspace(-1.0, 1.0, 41) for c, w in zip(centre, width)), indexing="ij")
        unit = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
        distance = np.linalg.norm(unit * semi_axes - point, axis=-1)
        best = np.unravel_index(distance.argmin(), distance.shape)
        centre, width = np.array([theta[best], phi[best]]), 0.2 * width
    return distance.min()


@pytest.mark.long
def test_the_ellipsoid_fields_distance_is_the_distance():
    semi_axes = np.array([5.0, 2.0, 0.7])
    field = EllipsoidField(jnp.zeros(3), jnp.eye(3), jnp.asarray(semi_axes))
    directions = np.random.default_rng(0).normal(size=(40, 3))
    points = 1.2 * directions / np.linalg.norm(directions / semi_axes, axis=1, keepdims=True)
    value, gradient, hessian = field.value_gradient_hessian(jnp.asarray(points))
    np.testing.assert_allclose(value, [closest_on_ellipsoid(p, semi_axes) for p in points], atol=1e-6)
    # A distance: unit gradients, and nothing changes along them.
    np.testing.assert_allclose(np.linalg.norm(gradient, axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(np.einsum("nij,nj->ni", hessian, gradient), 0.0, atol=1e-9)


def test_the_capsule_fields_distance_is_the_distance():
    field = CapsuleField(jnp.array([-1.0, 0.0, 0.0]), jnp.array([1.0, 0.0, 0.0]), jnp.asarray(0.5))
    points = jnp.array([[0.3, 2.0, 0.0], [4.0, 0.0, 0.0], [-1.0, 0.0, 0.2]])
    np.testing.assert_allclose(field.value(points), [1.5, 2.5, -0.3], atol=1e-12)


def test_the_spline_is_the_cubic_that_it_interpolates_on_axes_of_unlike_lengths():
    def cubic(p):
        return 0.1 * p[:, 0] ** 3 - p[:, 1] * p[:, 2] ** 2 + p[:, 0] * p[:, 1] - 2.0

    lower, upper = np.array([-1.0, -2.0, -3.0]), np.array([4.0, 2.5, 3.0])
    spline = FieldSpline.interpolating(cubic, lower, upper, 0.7)
    assert len(set(spline.coefficients.shape)) == 3
    points = np.random.default_rng(0).uniform(lower, upper, (200, 3))
    found = scipy.interpolate.NdBSpline(spline.knots, spline.coefficients, 3)(points)
    np.testing.assert_allclose(found, cubic(points), atol=1e-10)


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
