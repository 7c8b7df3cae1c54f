"""Fields in closed form: truths for tests, and baselines that need no learning."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from keepout.core.fields.field import Field, of_places, within_numbers


def _derivatives(function, points: Float[Array, "*batch 3"]):
    batch = points.shape[:-1]
    flat = points.reshape(-1, 3)
    value, gradient = jax.vmap(jax.value_and_grad(function))(flat)
    hessian = jax.vmap(jax.hessian(function))(flat)
    return value.reshape(batch), gradient.reshape(*batch, 3), hessian.reshape(*batch, 3, 3)


class SphereField(Field):
    """‖p - c‖ - ρ, exact and smooth everywhere but at the centre, where the gradient is taken as zero.

    Attributes:
        centre: (3,) metres.
        radius: ρ, metres.

    """

    centre: Float[Array, "3"]
    radius: Float[Array, ""]

    def value(self, points: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Signed distance in metres."""
        y = within_numbers(points) - self.centre
        return of_places(points, jnp.sqrt(jnp.sum(y**2, axis=-1)) - self.radius)

    def value_and_gradient(
        self, points: Float[Array, "*batch 3"]
    ) -> tuple[Float[Array, "*batch"], Float[Array, "*batch 3"]]:
        """Signed distance in metres and the unit vector away from the centre."""
        value, gradient, _ = self.value_gradient_hessian(points)
        return value, gradient

    def value_gradient_hessian(
        self, points: Float[Array, "*batch 3"]
    ) -> tuple[Float[Array, "*batch"], Float[Array, "*batch 3"], Float[Array, "*batch 3 3"]]:
        """Signed distance in metres, u = y/‖y‖, and (I - u uᵀ)/‖y‖ in 1/m."""
        y = within_numbers(points) - self.centre
        r = jnp.sqrt(jnp.sum(y * y, axis=-1))
        inverse = jnp.where(r > 0.0, 1.0 / jnp.where(r > 0.0, r, 1.0), 0.0)
        u = y * inverse[..., None]
        across = jnp.eye(3) - u[..., :, None] * u[..., None, :]
        return of_places(points, r - self.radius), u, across * inverse[..., None, None]


class BoxUnionField(Field):
    """A C^∞ lower bound of the signed distance to a union of axis-aligned boxes.

    The exact distance is not C² (edges, corners, medial axis). Each box's distance is the largest of its six face
    distances, which never exceeds the exact one outside, and maxima and minima are replaced by log-sum-exp with
    temperature τ: within a box the soft maximum lowered by τ log 6, over the boxes the soft minimum, which is low by
    at most τ log(number of boxes). So the value never over-states the distance, and is exact to those two terms beside
    a face.

    Attributes:
        lower: (boxes, 3) corners, metres.
        upper: (boxes, 3) opposite corners, metres.
        smoothing: τ, metres, positive.

    """

    lower: Float[Array, "boxes 3"]
    upper: Float[Array, "boxes 3"]
    smoothing: Float[Array, ""]

    def _single(self, p: Float[Array, "3"]) -> Float[Array, ""]:
        tau, near = self.smoothing, within_numbers(p)
        faces = jnp.concatenate([self.lower - near, near - self.upper], axis=-1)
        boxes = tau * (jax.nn.logsumexp(faces / tau, axis=-1) - jnp.log(6.0))
        return of_places(p, -tau * jax.nn.logsumexp(-boxes / tau))

    def value(self, points: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Return a distance in metres that is never over-stated outside the boxes, negative inside."""
        return jax.vmap(self._single)(points.reshape(-1, 3)).reshape(points.shape[:-1])

    def value_and_gradient(
        self, points: Float[Array, "*batch 3"]
    ) -> tuple[Float[Array, "*batch"], Float[Array, "*batch 3"]]:
        """Return the value in metres and its gradient."""
        value, gradient = jax.vmap(jax.value_and_grad(self._single))(points.reshape(-1, 3))
        return value.reshape(points.shape[:-1]), gradient.reshape(points.shape)

    def value_gradient_hessian(
        self, points: Float[Array, "*batch 3"]
    ) -> tuple[Float[Array, "*batch"], Float[Array, "*batch 3"], Float[Array, "*batch 3 3"]]:
        """Return the value in metres, its gradient, and its Hessian in 1/m."""
        return _derivatives(self._single, points)
