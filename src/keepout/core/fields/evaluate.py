"""A field on many NumPy points, in pieces of one size, so that it is compiled once."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from keepout.core.compiled.kept_executables import kept_jit
from keepout.core.fields.field import Field

PIECE = 4096


@kept_jit
def _value(field: Field, points):
    return field.value(points)


@kept_jit
def _value_and_gradient(field: Field, points):
    return field.value_and_gradient(points)


@kept_jit
def _value_gradient_hessian(field: Field, points):
    return field.value_gradient_hessian(points)


def in_pieces(function: Callable[[Any], Any], points: Float[np.ndarray, "n 3"]) -> Any:
    """Apply a function of `PIECE` rows to any number of them; every array it returns keeps the rows first."""
    answers = []
    for start in range(0, max(len(points), 1), PIECE):
        piece = points[start : start + PIECE]
        padded = np.zeros((PIECE, 3), points.dtype)
        padded[: len(piece)] = piece
        answers.append(jax.tree.map(np.asarray, function(jax.device_put(padded))))
    joined = jax.tree.map(lambda *parts: np.concatenate(parts), *answers)
    return jax.tree.map(lambda a: a[: len(points)], joined)


def values(field: Field, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """Signed distances in metres."""
    return in_pieces(functools.partial(_value, field), points)


def values_and_gradients(
    field: Field, points: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n 3"]]:
    """Signed distances in metres and gradients."""
    return in_pieces(functools.partial(_value_and_gradient, field), points)


def values_gradients_hessians(
    field: Field, points: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 3"]]:
    """Signed distances in metres, gradients, and Hessians in 1/m."""
    return in_pieces(functools.partial(_value_gradient_hessian, field), points)
