"""Lengths of vectors that can be differentiated everywhere."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def norm(vector: Float[Array, "n"]) -> Float[Array, ""]:
    """Give the Euclidean norm, with a derivative of zero at zero, where `jnp.linalg.norm` has none."""
    square = jnp.sum(vector * vector)
    still = square == 0.0  # false for what is not a number, which stays one
    return jnp.where(still, 0.0, jnp.sqrt(jnp.where(still, 1.0, square)))
