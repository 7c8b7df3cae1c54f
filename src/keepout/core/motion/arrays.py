"""Numbers as users give them, turned into float64 arrays; and their length, which can be differentiated everywhere."""

from collections.abc import Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

T = TypeVar("T")
NumbersLike = ArrayLike | Sequence[Any]
"""Anything that `jnp.asarray` turns into numbers: an array, a number, nested lists of numbers."""
Scalar = Float[Array, ""]
Vector = Float[Array, "3"]
Flag = Bool[Array, ""]


def as_float64(value: NumbersLike) -> Array:
    """Give a number, an array or nested lists of numbers as a float64 array of the same shape."""
    if any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(value)):
        return jnp.asarray(value, dtype=jnp.float64)
    # `jnp.asarray` would compile a program for each shape of numbers that are not JAX's yet.
    return jax.device_put(np.asarray(value, dtype=np.float64))


def numbers_as_arrays(tree: T) -> T:
    """Give a tree with arrays for its floating-point numbers, which a compiled program would otherwise be made for."""
    return jax.tree.map(lambda leaf: as_float64(leaf) if isinstance(leaf, float) else leaf, tree)


def norm(vector: Float[Array, "n"]) -> Scalar:
    """Give the Euclidean norm, with a derivative of zero at zero, where `jnp.linalg.norm` has none."""
    square = jnp.sum(vector * vector)
    still = square == 0.0  # false for what is not a number, which stays one
    return jnp.where(still, 0.0, jnp.sqrt(jnp.where(still, 1.0, square)))
