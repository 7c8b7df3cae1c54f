"""Bounds attacked: no sample, no ascent and no float32 evaluation may beat them."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from truths.networks import in_numpy, random_layers

from keepout.core.fields import neural
from keepout.core.proof import bounds

BETA = 100.0
KINDS = pytest.mark.parametrize("kind", ["triangle", "box"])
SIZES, SHARPNESS = (3, 24, 24, 24, 1), (100.0, 5.0, 400.0)
ELEMENTS, EACH = 64, 64


@functools.partial(jax.jit, static_argnames="beta")
def evaluated(layers, beta, x):
    """The network as it is flown: in its own float type."""
    return neural.value(layers, beta, x.astype(layers.weights[0].dtype))


def random_network(seed):
    """Sharpness 5 to 400, and weights 0.3 to 2 times the usual size."""
    layers, size = random_layers(seed, SIZES, jnp.float32), np.random.default_rng(seed).uniform(0.3, 2.0)
    weights = tuple(jnp.asarray(np.asarray(W) * np.float32(size)) for W in layers.weights)
    return neural.Layers(weights, layers.biases), SHARPNESS[seed % len(SHARPNESS)]


def random_elements(kind, rng, count, size):
    if kind == "triangle":
        return bounds.triangles(rng.uniform(-0.7, 0.7, (count, 1, 3)) + size * rng.normal(size=(count, 3, 3)))
    elements = bounds.boxes(rng.uniform(-0.7, 0.7, (count, 3)), size * rng.uniform(0.2, 1.0, (count, 3)))
    elements[1:, ::2] += 0.3 * size * rng.normal(size=elements[1:, ::2].shape)  # and every other one slanted
    return elements


def random_places(elements, rng, each):
    """Random places of each element (each, m, 3), by the weights of its columns; corners among them."""
    m = elements.shape[1]
    if len(elements) == 3:
        places = rng.dirichlet(np.full(3, 0.5), size=(each, m))
        places[:3] = np.eye(3)[:, None, :]
        return places
    places = rng.uniform(-1.0, 1.0, size=(each, m, 3))
    places[: each // 4] = np.sign(places[: each // 4])
    return places


def points_at(elements, places):
    if len(elements) == 3:
        return np.einsum("emk,kmi->emi", places, elements)
    return elements[0] + np.einsum("emk,kmi->emi", places, elements[1:])


def climbed(layers, beta, elements, places):
    """Largest value that gradient ascent inside each element finds from the places."""
    shape, best = places.shape[:2], np.full(places.shape[1], -np.inf)
    for step in np.geomspace(1.0, 0.02, 20):
        found, gradient = in_numpy(layers, beta, points_at(elements, places).reshape(-1, 3))
        best = np.maximum(best, found.reshape(shape).max(axis=0))
        gradient = gradient.reshape(*shape, 3)
        if len(elements) == 3:  # exponentiated gradient keeps the weights of the corners on the simplex
            rise = np.einsum("emi,kmi->emk", gradient, elements)
            rise -= rise.max(axis=2, keepdims=True)
            places = places * np.exp(10.0 * step * rise / np.maximum(np.abs(rise).max(axis=2, keepdims=True), 1e-12))
            places /= places.sum(axis=2, keepdims=True)
        else:
            rise = np.einsum("emi,kmi->emk", gradient, elements[1:])
            places = np.clip(places + step * np.sign(rise), -1.0, 1.0)
    return best


def check_random_networks_are_never_above_their_bound(kind, networks=range(16), rounds=1, starts=8):
    """No sample and no ascent beats an element's bound, nor the error of float32 the bound of that."""
    gaps = []
    for seed in networks:
        rng = np.random.default_rng(1000 + seed)
        layers, beta = random_network(seed)
        elements = random_elements(kind, rng, ELEMENTS, 10 ** rng.uniform(-3.0, -0.4))
        answer = bounds.upper_bounds(bounds.Network.of(layers, beta), elements)
        best = climbed(layers, beta, elements, random_places(elements, rng, starts))
        for _ in range(rounds):
            x = points_at(elements, random_places(elements, rng, EACH)).reshape(-1, 3)
            exact, _ = in_numpy(layers, beta, x)
            best = np.maximum(best, exact.reshape(EACH, -1).max(axis=0))
            off = np.abs(np.asarray(evaluated(layers, beta, x), np.float64) - exact).reshape(EACH, -1).max(axis=0)
            assert (answer.evaluation_error - off).min() >= 0.0
        assert (answer.upper - best).min() >= 0.0
        gaps.append(np.median(answer.upper - best))
    assert min(gaps) < 0.01  # small elements are bounded tightly, so the bound says something


@pytest.mark.long
@KINDS
def test_random_networks_are_never_above_their_bound(kind):
    check_random_networks_are_never_above_their_bound(kind)


@pytest.mark.slow
@KINDS
def test_many_random_networks_are_never_above_their_bound(kind):
    check_random_networks_are_never_above_their_bound(kind, range(60), rounds=100, starts=200)


@pytest.mark.long
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_a_point_is_bounded_to_rounding_and_the_evaluation_error_covers_each_type(dtype):
    """Against the same numbers in long doubles."""
    layers = random_layers(5, dtype=dtype)
    x = np.random.default_rng(2).uniform(-0.5, 0.5, (4096, 3)).astype(np.float32).astype(np.float64)
    answer = bounds.upper_bounds(bounds.Network.of(layers, BETA), bounds.boxes(x, np.zeros_like(x)))
    exact, _ = in_numpy(layers, BETA, x, np.longdouble)
    gap, off = answer.upper - exact, np.abs(np.asarray(evaluated(layers, BETA, x)) - exact)
    assert 0.0 <= gap.min() <= gap.max() < 1e-8
    assert (off <= answer.evaluation_error).all()
    assert off.max() > 1e-3 * answer.evaluation_error.max()
    assert answer.evaluation_error.max() < (1e-9 if dtype == jnp.float64 else 1e-2)


@pytest.mark.long
def test_float32_exponential_and_logarithm_are_as_exact_as_assumed():
    t = np.concatenate([np.linspace(0.0, 100.0, 500_001), np.geomspace(1e-30, 1.0, 100_001)]).astype(np.float32)
    e = np.exp(-t.astype(np.float64))
    normal = e > 2.0**-125
    got = np.asarray(jax.jit(lambda x: jnp.exp(-x))(t), np.float64)
    assert (np.abs(got - e)[normal] / e[normal]).max() < 0.5 * bounds.ELEMENTARY * 2.0**-23
    every = np.arange(2**23 + 1, dtype=np.uint32) + np.float32(1.0).view(np.uint32)  # all numbers from 1 to 2
    argument = every.view(np.float32)
    log = np.log(argument.astype(np.float64))
    got = np.asarray(jax.jit(jnp.log)(argument), np.float64)
    assert (np.abs(got - log) <= 0.5 * bounds.ELEMENTARY * 2.0**-23 * log).all()


@pytest.mark.parametrize("function", [neural.softplus, lambda z, beta: neural.softplus_and_slope(z, beta)[0]])
def test_float32_softplus_keeps_its_allowance(function):
    z = np.concatenate([np.linspace(-1.5, 1.5, 500_001), np.geomspace(1e-30, 1.0, 100_001)]).astype(np.float32)
    got = np.asarray(jax.jit(lambda z: function(z, BETA))(z), np.float64)
    exact = np.logaddexp(0.0, BETA * z.astype(np.float64)) / BETA
    allowed = bounds.ELEMENTARY * bounds.UNIT32 * (exact + 2.0 / BETA)
    off = BETA * z < -bounds.SATURATED
    allowed[off] = np.minimum(allowed[off], bounds.TAIL / BETA)
    assert (np.abs(got - exact) <= allowed).all()


def test_float64_softplus_of_the_bounds_is_as_exact_as_assumed():
    t = np.concatenate([np.linspace(-700.0, 700.0, 40_001), np.geomspace(1e-30, 1.0, 10_001)])
    value, slope = (np.array(column) for column in zip(*(bounds.softplus(one) for one in t)))
    wide = t.astype(np.longdouble)
    e = np.exp(-np.abs(wide))
    units = bounds.ELEMENTARY * 2.0**-53
    assert (np.abs(value - (np.maximum(wide, 0.0) + np.log1p(e))) <= units * (np.abs(wide) + np.log1p(e))).all()
    assert (np.abs(slope - np.where(wide > 0.0, 1.0, e) / (1.0 + e)) <= units * slope).all()
    # Beyond saturation it is its limit to the tail.
    beyond = np.abs(t) >= bounds.SATURATED
    assert np.abs(value - np.maximum(t, 0.0))[beyond].max() < bounds.TAIL
    assert np.abs(slope - (t > 0.0))[beyond].max() < bounds.TAIL


def test_numbers_that_overflow_leave_a_bound_of_infinity():
    layers = random_layers(6, (3, 16, 16, 16, 1), jnp.float32)
    huge = layers._replace(weights=tuple(np.asarray(W) * np.float32(1e20) for W in layers.weights))
    answer = bounds.upper_bounds(
        bounds.Network.of(huge, BETA), random_elements("box", np.random.default_rng(4), 10, 0.1)
    )
    assert (answer.upper == np.inf).all()
    assert (answer.evaluation_error == np.inf).all()
