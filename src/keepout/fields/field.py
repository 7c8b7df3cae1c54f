"""The field interface: all that control and flight know about a shape."""

import abc

import equinox as eqx
from jaxtyping import Array, Float


class Field(eqx.Module):
    """A signed distance to the target, positive outside, in metres, twice continuously differentiable in its domain.

    Points are in the target's body frame, in metres, float64, of any batch shape. All answers are float64. Outside its
    domain a field continues with a distance that it never over-states.
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
