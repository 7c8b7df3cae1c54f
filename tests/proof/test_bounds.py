"""Bounds attacked: no sample, no ascent and no float32 evaluation may beat them, and a planted violation must show."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from truths.bound_attacks import BETA, check_random_networks_are_never_above_their_bound
from truths.elements import points_in, random_elements
from truths.networks import random_layers

from keepout.fields import mlp
from keepout.proof import bounds, relaxation


@jax.jit
def exact(layers, x):
    wide = jax.tree.map(lambda a: a.astype(jnp.float64), layers)
    return mlp.value(wide, BETA, x)


@pytest.mark.parametrize("kind", ["triangle", "box"])
def test_fifty_random_networks_are_never_above_their_bound(kind):
    check_random_networks_are_never_above_their_bound(kind)


def test_gradient_ascent_from_many_starts_never_beats_the_bound():
    layers = random_layers(3, (3, 32, 32, 32, 1), jnp.float32)
    rng = np.random.default_rng(1)
    elements = random_elements("box", rng, 100, 0.05)
    answer = bounds.upper_bounds(bounds.Network.of(layers, BETA), elements)
    wide = jax.tree.map(lambda a: a.astype(jnp.float64), layers)
    climb = jax.jit(lambda x: mlp.value_and_gradient(wide, BETA, x))
    x = points_in(elements, rng, 100)
    low = elements.columns[0] - np.abs(elements.columns[1:]).sum(axis=0)
    high = elements.columns[0] + np.abs(elements.columns[1:]).sum(axis=0)
    for step in np.geomspace(0.3, 0.01, 20):
        _, gradient = climb(x.reshape(-1, 3))
        direction = np.asarray(gradient).reshape(x.shape)
        x = np.clip(x + step * (high - low) * np.sign(direction), low, high)
    best = np.asarray(climb(x.reshape(-1, 3))[0]).reshape(100, -1).max(axis=0)
    assert (answer.upper - best).min() >= 0.0


def test_a_point_is_bounded_to_rounding():
    layers = random_layers(5, (3, 32, 32, 1), jnp.float32)
    x = np.random.default_rng(2).uniform(-0.5, 0.5, (50, 3))
    elements = bounds.boxes(x, np.zeros_like(x))
    upper = bounds.upper_bounds(bounds.Network.of(layers, BETA), elements).upper
    gap = upper - np.asarray(exact(layers, x))
    assert gap.min() >= 0.0
    assert gap.max() < 1e-8


def test_float32_exponential_and_logarithm_are_as_exact_as_assumed():
    t = np.concatenate([np.linspace(0.0, 100.0, 2_000_001), np.geomspace(1e-30, 1.0, 200_001)]).astype(np.float32)
    e = np.exp(-t.astype(np.float64))
    normal = e > 2.0**-125
    got = np.asarray(jax.jit(lambda x: jnp.exp(-x))(t), np.float64)
    assert (np.abs(got - e)[normal] / e[normal]).max() < 0.5 * relaxation.ELEMENTARY * 2.0**-23
    every = np.arange(2**23 + 1, dtype=np.uint32) + np.float32(1.0).view(np.uint32)  # all numbers from 1 to 2
    argument = every.view(np.float32)
    log = np.log(argument.astype(np.float64))
    got = np.asarray(jax.jit(jnp.log)(argument), np.float64)
    assert (np.abs(got - log) <= 0.5 * relaxation.ELEMENTARY * 2.0**-23 * log).all()


@pytest.mark.parametrize("function", [mlp.softplus, lambda z, beta: mlp.softplus_and_slope(z, beta)[0]])
def test_float32_softplus_keeps_its_allowance(function):
    z = np.concatenate([np.linspace(-1.5, 1.5, 2_000_001), np.geomspace(1e-30, 1.0, 100_001)]).astype(np.float32)
    got = np.asarray(jax.jit(lambda z: function(z, BETA))(z), np.float64)
    exact = np.logaddexp(0.0, BETA * z.astype(np.float64)) / BETA
    allowed = relaxation.ELEMENTARY * relaxation.UNIT32 * (exact + 2.0 / BETA)
    off = BETA * z < -relaxation.SATURATED
    allowed[off] = np.minimum(allowed[off], relaxation.TAIL / BETA)
    assert (np.abs(got - exact) <= allowed).all()


def test_float64_softplus_of_the_bounds_is_as_exact_as_assumed():
    t = np.concatenate([np.linspace(-700.0, 700.0, 200_001), np.geomspace(1e-30, 1.0, 20_001)])
    value, slope = (np.array(column) for column in zip(*(relaxation.softplus(one) for one in t)))
    wide = t.astype(np.longdouble)
    e = np.exp(-np.abs(wide))
    units = relaxation.ELEMENTARY * 2.0**-53
    assert (np.abs(value - (np.maximum(wide, 0.0) + np.log1p(e))) <= units * (np.abs(wide) + np.log1p(e))).all()
    assert (np.abs(slope - np.where(wide > 0.0, 1.0, e) / (1.0 + e)) <= units * slope).all()


def test_beyond_saturation_the_softplus_is_its_limit_to_the_tail():
    t = np.linspace(relaxation.SATURATED, 50.0, 1001)
    for sign in (1.0, -1.0):
        value, slope = (np.array(column) for column in zip(*(relaxation.softplus(one) for one in sign * t)))
        assert np.abs(value - np.maximum(sign * t, 0.0)).max() < relaxation.TAIL
        assert np.abs(slope - (sign > 0.0)).max() < relaxation.TAIL


@pytest.mark.parametrize("kind", ["triangle", "box"])
def test_elements_are_bounded_alike_in_any_company(kind):
    """Each alone, or among others, of which it takes the rounding only."""
    layers = random_layers(4, (3, 32, 32, 32, 1), jnp.float32)
    network, rng = bounds.Network.of(layers, BETA), np.random.default_rng(3)
    elements = random_elements(kind, rng, 2 * bounds.CHUNK + 3, 0.01)
    together = bounds.upper_bounds(network, elements)
    for i in (0, bounds.CHUNK - 1, bounds.CHUNK, 2 * bounds.CHUNK + 2):
        alone = bounds.upper_bounds(network, elements._replace(columns=elements.columns[:, i : i + 1]))
        assert alone.upper[0] == pytest.approx(together.upper[i], abs=1e-10)
        assert alone.slope[0] == pytest.approx(together.slope[i], abs=1e-10)
        assert alone.evaluation_error[0] == pytest.approx(together.evaluation_error[i], rel=1e-5)


def test_numbers_that_overflow_leave_a_bound_of_infinity():
    layers = random_layers(6, (3, 16, 16, 16, 1), jnp.float32)
    huge = mlp.Layers(tuple(W * np.float32(1e20) for W in layers.weights), layers.biases)
    elements = random_elements("box", np.random.default_rng(4), 10, 0.1)
    answer = bounds.upper_bounds(bounds.Network.of(huge, BETA), elements)
    assert (answer.upper == np.inf).all()
    assert (answer.evaluation_error == np.inf).all()
