"""Exact distances to an ellipsoid and to a capsule, as fields: smooth outside them."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from keepout.core.fields.field import Field

Point = Float[Array, "3"]


class RoundField(Field):
    """A distance in closed form at one point, with its gradient; the Hessian is the gradient's derivative."""

    def single(self, point: Point) -> tuple[Float[Array, ""], Point]:
        """Give the signed distance (m) and its gradient at one point."""
        raise NotImplementedError

    def value(self, points: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Signed distance in metres."""
        return self.value_and_gradient(points)[0]

    def value_and_gradient(
        self, points: Float[Array, "*batch 3"]
    ) -> tuple[Float[Array, "*batch"], Float[Array, "*batch 3"]]:
        """Signed distance in metres and its gradient."""
        value, gradient = jax.vmap(self.single)(points.reshape(-1, 3))
        return value.reshape(points.shape[:-1]), gradient.reshape(points.shape)

    def value_gradient_hessian(
        self, points: Float[Array, "*batch 3"]
    ) -> tuple[Float[Array, "*batch"], Float[Array, "*batch 3"], Float[Array, "*batch 3 3"]]:
        """Signed distance in metres, its gradient, and its Hessian in 1/m."""
        value, gradient = self.value_and_gradient(points)
        hessian = jax.vmap(jax.jacfwd(lambda point: self.single(point)[1]))(points.reshape(-1, 3))
        return value, gradient, hessian.reshape(*points.shape, 3)


class EllipsoidField(RoundField):
    """Signed distance to an ellipsoid, exact outside it; inside, that to the surface along a line to the centre.

    The closest point x of y has x_i = a_i² y_i/(a_i² + t) with Σ (a_i y_i/(a_i² + t))² = 1 (Eberly 2013). The root
    t ≥ 0 is found by Newton's method from below, where the convex function makes it rise to the root; two more steps,
    with derivatives, make the first and second derivatives exact.

    Attributes:
        centre: (3,) m.
        axes: (3, 3), rows are the unit axes.
        semi_axes: (3,) m.

    """

    centre: Point
    axes: Float[Array, "3 3"]
    semi_axes: Point

    def single(self, point: Point) -> tuple[Float[Array, ""], Point]:
        """Give the signed distance (m) and its gradient at one point."""
        y, squares = self.axes @ (point - self.centre), self.semi_axes**2
        weighted = squares * y**2
        level = jnp.sum(y**2 / squares)

        def newton(t: Array) -> Array:
            function = jnp.sum(weighted / (squares + t) ** 2) - 1.0
            return t + function / (2.0 * jnp.sum(weighted / (squares + t) ** 3))

        outside = level > 1.0
        scaled = jnp.sqrt(jnp.maximum(level, 1e-12))
        # A lower bound: with the largest axis in every denominator the sum is smaller, and its root is closed.
        first = jnp.maximum(jnp.sqrt(jnp.sum(weighted)) - jnp.max(squares), 0.0)
        root = jax.lax.fori_loop(0, 20, lambda _, t: jax.lax.stop_gradient(newton(t)), jax.lax.stop_gradient(first))
        root = newton(newton(root))
        root = jnp.where(outside, root, 0.0)
        surface = jnp.where(outside, squares * y / (squares + root), y / scaled)
        slope = surface / squares
        normal = slope / jnp.sqrt(jnp.sum(slope**2) + 1e-300)
        value = jnp.where(outside, jnp.sum(normal * (y - surface)), -jnp.sqrt(jnp.sum((surface - y) ** 2) + 1e-300))
        return value, self.axes.T @ normal


class CapsuleField(RoundField):
    """Signed distance to a capsule; its curvature jumps where the cylinder meets its caps.

    Attributes:
        start: (3,) m, of the segment.
        end: (3,) m.
        radius: m.

    """

    start: Point
    end: Point
    radius: Float[Array, ""]

    def single(self, point: Point) -> tuple[Float[Array, ""], Point]:
        """Give the signed distance (m) and its gradient at one point."""
        edge = self.end - self.start
        share = jnp.clip(jnp.sum((point - self.start) * edge) / (jnp.sum(edge**2) + 1e-300), 0.0, 1.0)
        away = point - self.start - share * edge
        distance = jnp.sqrt(jnp.sum(away**2) + 1e-300)
        return distance - self.radius, away / distance
