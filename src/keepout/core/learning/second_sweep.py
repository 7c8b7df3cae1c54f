"""A network's value and gradient with their reverse derivative written out, for training.

With s_l = σ'(z_l), z̄_l = ∂f/∂z_l and a loss that depends on f and ∇f, let ẋ = ∂loss/∂(∇f). The loss's derivative with
respect to the weights is that of (∂loss/∂f) f + ẋ·∇f with ẋ held, and ẋ·∇f is the derivative of f along ẋ: one sweep of
tangents forward, and one back. JAX's own reverse of the reverse does as many products of matrices, and goes over the
activations more often.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from keepout.core.fields.mlp import Kept, Layers, sweeps, times


def value_and_gradient(
    layers: Layers, beta: float, x: Float[Array, "n 3"]
) -> tuple[Float[Array, "n"], Float[Array, "n 3"]]:
    """`mlp.value_and_gradient`, whose own derivative is with respect to the layers, not to x."""
    return _value_and_gradient(layers, beta, x)


@functools.partial(jax.custom_vjp, nondiff_argnums=(1,))
def _value_and_gradient(layers: Layers, beta: float, x: Float[Array, "n 3"]) -> Any:
    return sweeps(layers, beta, x)[0]


def _forward(layers: Layers, beta: float, x: Float[Array, "n 3"]) -> tuple[tuple[Array, Array], tuple[Layers, Kept]]:
    answer, kept = sweeps(layers, beta, x)
    return answer, (layers, kept)


def _reverse(beta: float, forward: tuple[Layers, Kept], seeds: tuple[Array, Array]) -> tuple[Layers, None]:
    layers, (activations, slopes, z_bars) = forward
    seed, along = seeds
    tangents, moved = [along], []
    for W, slope in zip(layers.weights[:-1], slopes):
        moved.append(times(tangents[-1], W.T))
        tangents.append(slope * moved[-1])
    weights = [(times(seed[None], activations[-1]) + jnp.sum(tangents[-1], axis=0))]
    biases = [jnp.sum(seed)[None]]
    a_bar = seed[:, None] * layers.weights[-1]
    for depth in range(len(slopes) - 1, -1, -1):
        slope, z_bar = slopes[depth], z_bars[depth]
        # σ'' = β s (1 - s).
        whole = a_bar * slope + beta * (1.0 - slope) * z_bar * moved[depth]
        weights.append(times(whole.T, activations[depth]) + times(z_bar.T, tangents[depth]))
        biases.append(jnp.sum(whole, axis=0))
        a_bar = times(whole, layers.weights[depth])
    return Layers(tuple(reversed(weights)), tuple(reversed(biases))), None


_value_and_gradient.defvjp(_forward, _reverse)
