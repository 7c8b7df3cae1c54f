"""The bounds of random networks over random elements against samples in them, in float64 and in float32."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from keepout.fields import mlp
from keepout.proof import bounds
from truths.elements import points_in, random_elements
from truths.networks import random_layers

BETA = 100.0


@functools.partial(jax.jit, static_argnames="wide")
def value(layers, x, wide):
    layers = jax.tree.map(lambda a: a.astype(jnp.float64), layers) if wide else layers
    return mlp.value(layers, BETA, x if wide else x.astype(jnp.float32))


def check_random_networks_are_never_above_their_bound(kind, networks=50):
    """No sample's value is above the element's bound, nor its float32 error above the bound of that."""
    rng = np.random.default_rng(0)
    gaps = []
    for seed in range(networks):
        layers = random_layers(seed, (3, 32, 32, 32, 1), jnp.float32)
        network = bounds.Network.of(layers, BETA)
        elements = random_elements(kind, rng, 64, 10 ** rng.uniform(-3.0, -0.5))
        answer = bounds.upper_bounds(network, elements)
        points = points_in(elements, rng, 64)
        exact = np.asarray(value(layers, points.reshape(-1, 3), True)).reshape(64, -1)
        rough = np.asarray(value(layers, points.reshape(-1, 3), False), np.float64).reshape(64, -1)
        assert (answer.upper - exact.max(axis=0)).min() >= 0.0
        assert (answer.evaluation_error - np.abs(rough - exact).max(axis=0)).min() >= 0.0
        gaps.append(np.median(answer.upper - exact.max(axis=0)))
    assert min(gaps) < 0.01  # small elements are bounded tightly, so the bound says something
