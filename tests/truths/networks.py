"""Random networks, neural fields of them, and the same networks in NumPy."""

import itertools

import jax.numpy as jnp
import numpy as np

from keepout.core.fields import neural
from keepout.core.fields.continuation import RadialContinuation
from keepout.core.fields.neural import NeuralField

SIZES = (3, 24, 24, 1)


def random_layers(seed, sizes=SIZES, dtype=jnp.float64):
    rng = np.random.default_rng(seed)
    weights = [rng.normal(size=(n_out, n_in)) * np.sqrt(2.0 / n_in) for n_in, n_out in itertools.pairwise(sizes)]
    biases = [0.3 * rng.normal(size=n) for n in sizes[1:]]
    return neural.Layers(*(tuple(jnp.asarray(a.astype(dtype)) for a in arrays) for arrays in (weights, biases)))


def numbers(*values):
    return tuple(jnp.asarray(v, jnp.float64) for v in values)


def random_field(seed, beta=20.0, dtype=jnp.float64):
    continuation = RadialContinuation(jnp.array([0.1, 0.2, -0.3]), *numbers(9.0, 11.0, 13.0, 0.2))
    return NeuralField(random_layers(seed, dtype=dtype), jnp.asarray(12.0), continuation, beta)


def in_numpy(layers, beta, x, kind=np.float64):
    """Value (n,) and gradient (n, 3) of a network at each row of x."""
    weights, biases = ([np.asarray(a).astype(kind) for a in arrays] for arrays in layers)
    a, tangents = x.astype(kind), [np.broadcast_to(e, x.shape) for e in np.eye(3, dtype=kind)]
    for W, b in zip(weights[:-1], biases[:-1]):
        t = beta * (a @ W.T + b)
        slope = 0.5 * (1.0 + np.tanh(0.5 * t))
        a, tangents = np.logaddexp(0.0, t) / beta, [slope * (tangent @ W.T) for tangent in tangents]
    return a @ weights[-1][0] + biases[-1][0], np.stack([tangent @ weights[-1][0] for tangent in tangents], axis=1)
