"""Random networks, and neural fields of them."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np

from keepout.fields import mlp
from keepout.fields.continuation import RadialContinuation
from keepout.fields.neural import NeuralField


def random_layers(seed, sizes=(3, 24, 24, 24, 1), dtype=jnp.float64):
    keys = jax.random.split(jax.random.key(seed), 2 * len(sizes))
    weights = [
        jax.random.normal(keys[i], (n_out, n_in)) * np.sqrt(2.0 / n_in)
        for i, (n_in, n_out) in enumerate(itertools.pairwise(sizes))
    ]
    biases = [0.3 * jax.random.normal(keys[-1 - i], (n,)) for i, n in enumerate(sizes[1:])]
    return mlp.Layers(tuple(w.astype(dtype) for w in weights), tuple(b.astype(dtype) for b in biases))


def numbers(*values):
    return tuple(jnp.asarray(v, jnp.float64) for v in values)


def random_field(seed, beta=20.0, dtype=jnp.float64):
    continuation = RadialContinuation(jnp.array([0.1, 0.2, -0.3]), *numbers(9.0, 11.0, 13.0, 0.2))
    return NeuralField(random_layers(seed, dtype=dtype), jnp.asarray(12.0), continuation, beta)
