"""Weights of a cubic B-spline in one cell, and sums with them over the coefficients of many cells at once."""

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Weights = tuple[Float[Array, "n"], ...]
"""Of the four coefficients along one axis."""


def cubic_weights(t: Float[Array, "n"]) -> tuple[Weights, Weights, Weights]:
    """Give the four weights at places t in [0, 1] of the middle cell, and their first and second derivatives.

    No weight is below 0, in floating point neither: 4 − 6t² + 3t³ is at least 1.
    """
    s = 1.0 - t
    value = (
        s**3 / 6.0,
        (4.0 - 6.0 * t**2 + 3.0 * t**3) / 6.0,
        (4.0 - 6.0 * s**2 + 3.0 * s**3) / 6.0,
        t**3 / 6.0,
    )
    slope = (-0.5 * s**2, 1.5 * t**2 - 2.0 * t, 2.0 * s - 1.5 * s**2, 0.5 * t**2)
    return value, slope, (s, 3.0 * t - 2.0, 3.0 * s - 2.0, t)


def contracted(blocks: Float[Array, "4 *rest n"], weights: Sequence[Float[Array, "n"]]) -> Float[Array, "*rest n"]:
    """Sum over the first axis with one weight a cell, cells last.

    The barrier keeps XLA from writing the sums of several axes into one expression of 64 terms, which takes minutes to
    compile.
    """
    terms = [weight * block for weight, block in zip(weights, blocks, strict=True)]
    return jax.lax.optimization_barrier(functools.reduce(jnp.add, terms))
