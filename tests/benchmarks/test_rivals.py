"""Rivals of `benchmarks/rivals.py`: envelopes and splines against closed forms."""

import jax.numpy as jnp
import numpy as np
import pytest
from rivals_laws.envelope_fields import EllipsoidField


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
