"""The field interface: all that control and flight know about a shape; and a field on many NumPy points."""

import abc
import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from keepout.core.compiled.kept_executables import kept_jit

Points = Float[Array, "*batch 3"]
Values = Float[Array, "*batch"]
Hessians = Float[Array, "*batch 3 3"]
PIECE = 4096
"""Rows that a field is evaluated on at once from NumPy: pieces of one size, so that it is compiled once."""

_FARTHEST = 1e150
"""Beyond this along an axis (m) a point counts as if it were here: its square is still a number."""


def within_numbers(points: Points) -> Points:
    """Give the nearest points (m) whose distances float64 can hold: nearer to all of a target, or the points."""
    return jnp.clip(points, -_FARTHEST, _FARTHEST)


def of_places(points: Points, value: Values) -> Values:
    """Give the value (m), and −∞ where the point is none: a component that is infinite or not a number."""
    return jnp.where(jnp.all(jnp.isfinite(points), axis=-1), value, -jnp.inf)


class Field(eqx.Module):
    """A signed distance to the target, positive outside, in metres, twice continuously differentiable in its domain.

    Points are in the target's body frame, in metres, float64, of any batch shape. All answers are float64. Outside its
    domain a field continues with a distance that it never over-states, which is a finite number for every finite point.
    At a point with a component that is infinite or not a number the value is −∞, so that nothing is free there; the
    derivatives mean nothing.
    """

    def at_time(self, time: Array) -> "Field":
        """Give the field as it is from a time on; most are the same at any.

        Args:
            time: s since the orbit's epoch.

        """
        return self

    @abc.abstractmethod
    def value(self, points: Points) -> Values:
        """Signed distance in metres.

        Args:
            points: (…, 3) m, body frame.

        """

    def value_and_gradient(self, points: Points) -> tuple[Values, Points]:
        """Signed distance in metres and its gradient (dimensionless, not normalised).

        Args:
            points: (…, 3) m, body frame.

        """
        value, gradient, _ = self.value_gradient_hessian(points)
        return value, gradient

    @abc.abstractmethod
    def value_gradient_hessian(self, points: Points) -> tuple[Values, Points, Hessians]:
        """Signed distance in metres, gradient, and Hessian in 1/m.

        Args:
            points: (…, 3) m, body frame.

        """


@kept_jit
def _value(field: Field, points):
    return field.value(points)


@kept_jit
def _value_and_gradient(field: Field, points):
    return field.value_and_gradient(points)


@kept_jit
def _value_gradient_hessian(field: Field, points):
    return field.value_gradient_hessian(points)


def in_pieces(function: Callable[[Any], Any], points: Float[np.ndarray, "n 3"], size: int = PIECE) -> Any:
    """Apply a function of `size` rows to any number of them; every array it returns keeps the rows first."""
    answers = []
    for start in range(0, max(len(points), 1), size):
        piece = points[start : start + size]
        padded = np.zeros((size, 3), points.dtype)
        padded[: len(piece)] = piece
        answers.append(jax.tree.map(np.asarray, function(jax.device_put(padded))))
    joined = jax.tree.map(lambda *parts: np.concatenate(parts), *answers)
    return jax.tree.map(lambda a: a[: len(points)], joined)


def values(field: Field, points: Float[np.ndarray, "n 3"], size: int = PIECE) -> Float[np.ndarray, "n"]:
    """Signed distances in metres, computed for `size` points at a time."""
    return in_pieces(functools.partial(_value, field), points, size)


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
