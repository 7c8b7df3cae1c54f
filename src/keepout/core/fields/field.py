"""The field interface: all that control and flight know about a shape."""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

_FARTHEST = 1e150
"""Beyond this along an axis (m) a point counts as if it were here: its square is still a number."""


def within_numbers(points: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
    """Give the nearest points (m) whose distances float64 can hold: nearer to all of a target, or the points."""
    return jnp.clip(points, -_FARTHEST, _FARTHEST)


def of_places(points: Float[Array, "*batch 3"], value: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Give the value (m), and −∞ where the point is none: a component that is infinite or not a number."""
    return jnp.where(jnp.all(jnp.isfinite(points), axis=-1), value, -jnp.inf)


class Field(eqx.Module):
    """A signed distance to the target, positive outside, in metres, twice continuously differentiable in its domain.

    Points are in the target's body frame, in metres, float64, of any batch shape. All answers are float64. Outside its
    domain a field continues with a distance that it never over-states, which is a finite number for every finite point.
    At a point with a component that is infinite or not a number the value is −∞, so that nothing is free there; the
    derivatives mean nothing.
    """

    @abc.abstractmethod
    def value(self, points: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Signed distance in metres."""

    @abc.abstractmethod
    def value_and_gradient(
        self, points: Float[Array, "*batch 3"]
    ) -> tuple[Float[Array, "*batch"], Float[Array, "*batch 3"]]:
        """Signed distance in metres and its gradient (dimensionless, not normalised)."""

    @abc.abstractmethod
    def value_gradient_hessian(
        self, points: Float[Array, "*batch 3"]
    ) -> tuple[Float[Array, "*batch"], Float[Array, "*batch 3"], Float[Array, "*batch 3 3"]]:
        """Signed distance in metres, gradient, and Hessian in 1/m."""
