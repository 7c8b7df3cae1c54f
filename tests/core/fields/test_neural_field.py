"""The one-forward, one-reverse formula and the continuation against nested autodiff and closed forms."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from truths.box_unions import box_union
from truths.networks import numbers, random_field

from keepout.core.fields.continuation import RadialContinuation
from keepout.core.fields.field import values, values_and_gradients, values_gradients_hessians
from keepout.core.fields.own import SphereField


@pytest.mark.long
def test_derivatives_equal_nested_autodiff_inside_and_beyond_the_domain():
    field = random_field(0)

    @jax.jit
    def nested(points):
        return field.value(points), jax.vmap(jax.grad(field.value))(points), jax.vmap(jax.hessian(field.value))(points)

    points = 9.0 * np.random.default_rng(0).normal(size=(200, 3))
    value, gradient, hessian = values_gradients_hessians(field, points)
    radius = np.linalg.norm(points - np.asarray(field.continuation.centre), axis=-1)
    assert min((radius < 11).sum(), ((radius > 11) & (radius < 13)).sum(), (radius > 13).sum()) > 10
    true_value, true_gradient, true_hessian = nested(jnp.asarray(points))
    np.testing.assert_allclose(value, true_value, atol=1e-12)
    np.testing.assert_allclose(gradient, true_gradient, atol=1e-10)
    np.testing.assert_allclose(values_and_gradients(field, points)[1], gradient, atol=1e-12)
    np.testing.assert_allclose(hessian, true_hessian, atol=1e-10)
    assert abs(hessian).max() > 0.01


@pytest.mark.long
@pytest.mark.parametrize("batch", [(), (2, 3)])
def test_any_batch_shape_gives_the_single_point_answers(batch):
    field = random_field(0, dtype=jnp.float32)
    points = 5.0 * np.random.default_rng(1).normal(size=(*batch, 3))
    value, gradient, hessian = eqx.filter_jit(field.value_gradient_hessian)(points)
    assert (value.shape, gradient.shape, hessian.shape) == (batch, (*batch, 3), (*batch, 3, 3))
    assert value.dtype == gradient.dtype == hessian.dtype == jnp.float64
    many = values_gradients_hessians(field, points.reshape(-1, 3))
    for answer, one, tolerance in zip((value, gradient, hessian), many, (1e-5, 1e-5, 1e-3)):
        np.testing.assert_allclose(np.asarray(answer).reshape(one.shape), one, atol=tolerance)


def test_continuation_never_rises_faster_than_the_distance_to_anything_in_the_ball():
    # Any point set in the ball has a distance; continue that distance itself and compare it with the truth.
    rng = np.random.default_rng(0)
    cloud = rng.normal(size=(40, 3))
    cloud *= 3.0 / np.linalg.norm(cloud, axis=1, keepdims=True)
    continuation = RadialContinuation(jnp.zeros(3), *numbers(3.0, 4.0, 5.0, 0.0))
    points = rng.normal(size=(20_000, 3))
    points *= np.exp(rng.uniform(np.log(4.0), np.log(60.0), (20_000, 1))) / np.linalg.norm(
        points, axis=1, keepdims=True
    )

    def truth(p):
        return np.linalg.norm(p[:, None] - cloud, axis=-1).min(axis=1)

    asked = np.asarray(eqx.filter_jit(continuation.into_domain)(points))
    assert np.linalg.norm(asked, axis=1).max() <= 4.5 + 1e-12
    excess = np.asarray(eqx.filter_jit(continuation.value)(points, truth(asked))) - truth(points)
    assert excess.max() <= 1e-9
    assert excess.min() < -0.1


def test_sphere_is_exact_and_box_union_never_overstates():
    points = np.random.default_rng(1).uniform(-4.0, 4.0, (500, 3))
    points[0] = centre = np.array([0.5, 0.0, 0.0])
    value, gradient, hessian = values_gradients_hessians(SphereField(jnp.asarray(centre), jnp.asarray(1.0)), points)
    assert np.isfinite(gradient).all()
    value, gradient, hessian, away = value[1:], gradient[1:], hessian[1:], points[1:] - centre
    radius = np.linalg.norm(away, axis=1, keepdims=True)
    np.testing.assert_allclose(value, radius[:, 0] - 1.0, atol=1e-12)
    np.testing.assert_allclose(gradient, away / radius, atol=1e-12)
    across = np.eye(3) - gradient[:, :, None] * gradient[:, None, :]
    np.testing.assert_allclose(hessian, across / radius[..., None], atol=1e-9)

    lower, upper = np.array([[-1.0, -1, -1], [1.0, -0.2, -0.2]]), np.array([[1.0, 1, 1], [3.0, 0.2, 0.2]])
    boxes = box_union(jnp.asarray(lower), jnp.asarray(upper), jnp.asarray(0.02))
    points[0] = [0.0, 0.0, 2.0]  # beside a face
    outside = np.maximum(np.maximum(lower - points[:, None], points[:, None] - upper), 0.0)
    exact = np.linalg.norm(outside, axis=-1).min(axis=1)
    value = values(boxes, points)
    assert (value - exact)[exact > 0].max() <= 1e-9
    assert value[0] == pytest.approx(1.0, abs=0.02 * (np.log(6) + np.log(2)))
