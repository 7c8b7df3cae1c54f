"""The learned field: a softplus network evaluated in float32, with a safe continuation outside its domain."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from keepout.core.fields import mlp
from keepout.core.fields.continuation import RadialContinuation
from keepout.core.fields.field import Field


class NeuralField(Field):
    """f̃(p) = s N((p - c)/s) with N a softplus network, p cast to the weights' float type after normalisation.

    The unit ball of the normalisation is the ball on which the network was trained; up to the continuation's domain
    radius the value is the network's own, beyond it the continuation's.

    Attributes:
        layers: the network, usually float32.
        scale: s, metres.
        continuation: centre c, domain, and what happens beyond it.
        beta: sharpness β of the softplus.

    """

    layers: mlp.Layers
    scale: Float[Array, ""]
    continuation: RadialContinuation
    beta: float = eqx.field(static=True)

    def _evaluate(self, function, points: Float[Array, "*batch 3"]) -> tuple[Any, Any, tuple[int, ...]]:
        batch = points.shape[:-1]
        flat = jnp.asarray(points, jnp.float64).reshape(-1, 3)

        def rows(p):
            q = self.continuation.into_domain(p)
            x = ((q - self.continuation.centre) / self.scale).astype(self.layers.weights[0].dtype)
            return function(self.layers, self.beta, x)

        return flat, mlp.in_chunks(rows, flat), batch

    def value(self, points: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Signed distance in metres."""
        flat, y, batch = self._evaluate(mlp.value, points)
        return self.continuation.value(flat, y.astype(jnp.float64) * self.scale).reshape(batch)

    def value_and_gradient(
        self, points: Float[Array, "*batch 3"]
    ) -> tuple[Float[Array, "*batch"], Float[Array, "*batch 3"]]:
        """Signed distance in metres and its gradient, by one forward and one reverse sweep."""
        flat, (y, g), batch = self._evaluate(mlp.value_and_gradient, points)
        value = self.continuation.value(flat, y.astype(jnp.float64) * self.scale)
        gradient = self.continuation.gradient(flat, g.astype(jnp.float64))
        return value.reshape(batch), gradient.reshape(*batch, 3)

    def value_gradient_hessian(
        self, points: Float[Array, "*batch 3"]
    ) -> tuple[Float[Array, "*batch"], Float[Array, "*batch 3"], Float[Array, "*batch 3 3"]]:
        """Signed distance in metres, gradient, and Hessian in 1/m, by one forward and one reverse sweep."""
        flat, (y, g, H), batch = self._evaluate(mlp.value_gradient_hessian, points)
        g = g.astype(jnp.float64)
        value = self.continuation.value(flat, y.astype(jnp.float64) * self.scale)
        gradient = self.continuation.gradient(flat, g)
        hessian = self.continuation.hessian(flat, g, H.astype(jnp.float64) / self.scale)
        return value.reshape(batch), gradient.reshape(*batch, 3), hessian.reshape(*batch, 3, 3)
