"""The smallest ball around what two balls share."""

import jax.numpy as jnp
from jaxtyping import Array, Bool

from keepout.flights.navigation.sensor import Ball

ROUNDING = 1e-13
"""Relative allowance for rounding in sums of vectors, squares and roots: some hundred units in the last place."""


def cut(first: Ball, second: Ball) -> tuple[Ball, Bool[Array, ""]]:
    """Give the smallest ball that holds every point within both balls, and whether there is one.

    For every λ in [0, 1] and every point p of both, (1 − λ)‖p − c₁‖² + λ‖p − c₂‖² = ‖p − c‖² + λ(1 − λ) d² with
    c = (1 − λ) c₁ + λ c₂ and d = ‖c₂ − c₁‖, so that p is within √((1 − λ) R₁² + λ R₂² − λ(1 − λ) d²) of c. This is
    least at λ = (d² + R₁² − R₂²)/(2 d²), cut to [0, 1]; there it is the radius of the circle in which the spheres
    meet, or that of the smaller ball. It is never wider than either ball: where the allowance for rounding would make
    it so, it is that ball.

    Args:
        first: what is kept where the balls do not meet, or the second one is not a number.
        second: another; its radius may be infinite.

    """
    between = second.centre - first.centre
    square = between @ between
    distance = jnp.sqrt(square)
    known = jnp.isfinite(distance) & (second.radius >= 0.0)
    size = jnp.linalg.norm(first.centre) + jnp.linalg.norm(second.centre)
    meets = known & (distance <= (first.radius + second.radius) * (1.0 + ROUNDING) + ROUNDING * size)
    smaller_is_first = first.radius <= second.radius
    R1, R2 = first.radius, second.radius
    share = jnp.clip(0.5 + 0.5 * (R1 - R2) * (R1 + R2) / jnp.where(square > 0.0, square, 1.0), 0.0, 1.0)
    left = (1.0 - share) * R1**2 + share * R2**2 - share * (1.0 - share) * square
    scale = jnp.maximum(R1, R2) + distance
    # The square is off by a small part of scale², and the centre by a small part of the coordinates.
    radius = jnp.sqrt(jnp.maximum(left, 0.0) + ROUNDING * scale**2) + ROUNDING * size
    lens = meets & (square > 0.0) & (share > 0.0) & (share < 1.0) & (radius < jnp.minimum(R1, R2))
    take_second = meets & ~smaller_is_first
    centre = jnp.where(lens, first.centre + share * between, jnp.where(take_second, second.centre, first.centre))
    return Ball(centre, jnp.where(lens, radius, jnp.where(take_second, R2, R1))), meets
