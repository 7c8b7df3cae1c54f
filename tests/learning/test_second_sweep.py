"""The derivative of training, written out, against JAX's own reverse of the reverse."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from truths.networks import random_layers

from keepout.fields import mlp
from keepout.learning import second_sweep

BETA = 30.0


@pytest.mark.long
@pytest.mark.parametrize(
    "shape", [(3, 8, 1), (3, 16, 8, 1), pytest.param((3, 32, 16, 24, 16, 1), marks=pytest.mark.slow)]
)
def test_it_is_the_derivative_that_jax_finds(shape):
    layers = random_layers(1, shape, jnp.float64)
    rng = np.random.default_rng(0)
    x, target = jnp.asarray(rng.normal(size=(40, 3))), jnp.asarray(rng.normal(size=(40, 3)))

    def loss(layers, function):
        value, gradient = function(layers, BETA, x)
        return jnp.sum(jnp.sin(value) ** 2 + value * gradient[:, 1] + jnp.sum((gradient - target) ** 2, axis=1))

    derivative = jax.jit(jax.value_and_grad(loss), static_argnums=1)
    ours, ours_gradient = derivative(layers, second_sweep.value_and_gradient)
    truth, truth_gradient = derivative(layers, mlp.value_and_gradient)
    assert float(ours) == pytest.approx(float(truth), rel=1e-13)
    for a, b in zip(jax.tree.leaves(ours_gradient), jax.tree.leaves(truth_gradient), strict=True):
        assert a.shape == b.shape
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-12 * float(jnp.abs(b).max()))


@pytest.mark.long
@pytest.mark.parametrize("part", [0, 1])
def test_losses_of_the_value_alone_or_the_gradient_alone(part):
    layers = random_layers(2, (3, 16, 16, 1), jnp.float64)
    x = jnp.asarray(np.random.default_rng(1).normal(size=(7, 3)))
    ours = jax.jit(jax.grad(lambda p: jnp.sum(second_sweep.value_and_gradient(p, BETA, x)[part] ** 2)))(layers)
    truth = jax.jit(jax.grad(lambda p: jnp.sum(mlp.value_and_gradient(p, BETA, x)[part] ** 2)))(layers)
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(truth), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-12 * float(jnp.abs(b).max()))
