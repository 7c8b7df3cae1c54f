"""Where a field is learned or sampled, and its safe continuation beyond that ball.

Let the target lie in the ball of radius ρ_T about a centre, and let r be the distance of a point from that centre.
Moving outward along a ray, the distance to the target grows at least at the rate √(1 - (ρ_T/r)²), the cosine of half
the angle under which the ball is seen. With F(r) = ∫ √(1 - (ρ_T/s)²) ds = √(r² - ρ_T²) - ρ_T arccos(ρ_T/r), therefore

    d(p) ≥ d(q) + F(r) - F(ψ)      for the point q on the same ray at radius ψ ≤ r.

The field is asked only at q, with ψ(r) = r up to the domain's radius ρ_0, and bending smoothly (C²) to a constant.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from keepout.core.fields.field import of_places, within_numbers
from keepout.core.geometry.distance import Distance

Rows = Float[Array, "n"]
Vectors = Float[Array, "n 3"]
Matrices = Float[Array, "n 3 3"]


class RadialContinuation(eqx.Module):
    """Maps points into the ball of radius (ρ_0 + ρ_1)/2 and carries values, gradients and Hessians back out.

    Attributes:
        centre: (3,) metres.
        target_radius: ρ_T, a ball about the centre holds the target, metres.
        domain_radius: ρ_0 > ρ_T: the field is asked at the point itself up to here, metres.
        outer_radius: ρ_1 > ρ_0: beyond it the point asked lies at the constant radius (ρ_0 + ρ_1)/2, metres.
        allowance: subtracted from the value from ρ_0 on (growing smoothly from 0 at ρ_T), metres: what the field itself
            over-states on the shell. It only lowers values, so no bound of the field is broken by it.

    """

    centre: Float[Array, "3"]
    target_radius: Float[Array, ""]
    domain_radius: Float[Array, ""]
    outer_radius: Float[Array, ""]
    allowance: Float[Array, ""]

    def _radial(self, points: Vectors):
        y = within_numbers(points) - self.centre
        outside = jnp.sum(y * y, axis=-1) > self.domain_radius**2
        # Inside, a harmless stand-in keeps every derivative finite; its results are not used.
        away = jnp.where(outside[:, None], y, jnp.array([1.0, 0.0, 0.0]) * self.domain_radius)
        r = jnp.sqrt(jnp.sum(away * away, axis=-1))
        width = self.outer_radius - self.domain_radius
        t = jnp.clip((r - self.domain_radius) / width, 0.0, 1.0)
        # ψ' = 1 - (3t² - 2t³): C¹, so that ψ is C².
        psi = self.domain_radius + width * (t - t**3 + 0.5 * t**4)
        psi1 = 1.0 - t * t * (3.0 - 2.0 * t)
        psi2 = -6.0 * t * (1.0 - t) / width
        return outside, away, r, psi, psi1, psi2

    def _lowering(self, points: Vectors) -> tuple[Rows, Vectors, Matrices]:
        """Return the allowance times a smoothstep from ρ_T to ρ_0, with its gradient and Hessian."""
        y = within_numbers(points) - self.centre
        beyond = jnp.sum(y * y, axis=-1) > self.target_radius**2
        away = jnp.where(beyond[:, None], y, jnp.array([1.0, 0.0, 0.0]) * self.target_radius)
        r = jnp.sqrt(jnp.sum(away * away, axis=-1))
        width = self.domain_radius - self.target_radius
        t = jnp.clip((r - self.target_radius) / width, 0.0, 1.0)
        value = self.allowance * t**3 * (10.0 - 15.0 * t + 6.0 * t * t)
        first = self.allowance * 30.0 * (t * (1.0 - t)) ** 2 / width
        second = self.allowance * 60.0 * t * (1.0 - t) * (1.0 - 2.0 * t) / width**2
        u = away / r[:, None]
        uu = u[:, :, None] * u[:, None, :]
        hessian = second[:, None, None] * uu + (first / r)[:, None, None] * (jnp.eye(3) - uu)
        return value, first[:, None] * u, hessian

    def _rise(self, s: Rows) -> Rows:
        """F(s)."""
        return jnp.sqrt(s * s - self.target_radius**2) - self.target_radius * jnp.arccos(self.target_radius / s)

    def _rise_derivatives(self, s: Rows) -> tuple[Rows, Rows]:
        """F'(s) and F''(s)."""
        ratio = self.target_radius / s
        slope = jnp.sqrt(1.0 - ratio * ratio)
        return slope, ratio * ratio / (s * slope)

    def into_domain(self, points: Vectors) -> Vectors:
        """Return the points at which the field is asked: unchanged inside the domain."""
        outside, away, r, psi, *_ = self._radial(points)
        return jnp.where(outside[:, None], self.centre + away * (psi / r)[:, None], points)

    def value(self, points: Vectors, value: Rows) -> Rows:
        """Return the continued value, from the field's value at `into_domain(points)`."""
        outside, _, r, psi, _, _ = self._radial(points)
        added = self._rise(r) - self._rise(psi)
        return of_places(points, value + jnp.where(outside, added, 0.0) - self._lowering(points)[0])

    def gradient(self, points: Vectors, gradient: Vectors) -> Vectors:
        """Return the continued gradient, from the field's gradient at `into_domain(points)`."""
        outside, away, r, psi, psi1, _ = self._radial(points)
        u = away / r[:, None]
        radial = jnp.sum(gradient * u, axis=-1)
        rise, _ = self._rise_derivatives(r)
        rise_psi, _ = self._rise_derivatives(psi)
        added = rise - rise_psi * psi1
        tangential = (psi / r)[:, None] * (gradient - radial[:, None] * u)
        continued = jnp.where(outside[:, None], tangential + (psi1 * radial + added)[:, None] * u, gradient)
        return continued - self._lowering(points)[1]

    def hessian(self, points: Vectors, gradient: Vectors, hessian: Matrices) -> Matrices:
        """Return the continued Hessian, from the field's gradient and Hessian at `into_domain(points)`.

        With q = φ(r) y, φ = ψ/r: Dqᵀ H Dq + φ' (u gᵀ + g uᵀ) + (g·y)(φ'' u uᵀ + (φ'/r)(I - u uᵀ)), and radial terms.
        """
        outside, away, r, psi, psi1, psi2 = self._radial(points)
        u = away / r[:, None]
        uu = u[:, :, None] * u[:, None, :]
        across = jnp.eye(3) - uu
        # Dq = φ I + (ψ' - φ) u uᵀ, so Dqᵀ H Dq needs no product of matrices.
        phi, bent = psi / r, psi1 - psi / r
        Hu = jnp.sum(hessian * u[:, None, :], axis=-1)
        scaled = (phi * phi)[:, None, None] * hessian + (bent * bent * jnp.sum(u * Hu, axis=-1))[:, None, None] * uu
        # Symmetric parts u aᵀ + a uᵀ, of the field's Hessian and of its gradient, with φ' = (ψ' - φ)/r.
        phi1 = bent / r
        phi2 = (psi2 - 2.0 * phi1) / r
        radial = jnp.sum(gradient * u, axis=-1)
        mixed = u[:, :, None] * ((phi * bent)[:, None] * Hu + phi1[:, None] * gradient)[:, None, :]
        turned = (radial * r)[:, None, None] * (phi2[:, None, None] * uu + (phi1 / r)[:, None, None] * across)
        rise, rise2 = self._rise_derivatives(r)
        rise_psi, rise2_psi = self._rise_derivatives(psi)
        first = rise - rise_psi * psi1
        second = rise2 - rise2_psi * psi1**2 - rise_psi * psi2
        added = second[:, None, None] * uu + (first / r)[:, None, None] * across
        continued = scaled + mixed + mixed.swapaxes(-1, -2) + turned + added
        return jnp.where(outside[:, None, None], continued, hessian) - self._lowering(points)[2]


@dataclasses.dataclass(frozen=True)
class Domain:
    """Balls about one centre, metres: of the target, of the learned field, and of its continuation."""

    centre: Float[np.ndarray, "3"]
    target_radius: float
    domain_radius: float
    outer_radius: float

    @classmethod
    def around(cls, distance: Distance) -> "Domain":
        """Return the domain around a target: ρ_0 = 1.25 ρ_T, ρ_1 = 1.5 ρ_T, at least 2 m and 4 m beyond it."""
        centre = 0.5 * (distance.lower + distance.upper)
        radius = 0.5 * float(np.linalg.norm(distance.upper - distance.lower))
        return cls(centre, radius, max(1.25 * radius, radius + 2.0), max(1.5 * radius, radius + 4.0))

    @property
    def learned_radius(self) -> float:
        """The largest radius at which the continuation asks the field."""
        return 0.5 * (self.domain_radius + self.outer_radius)

    @property
    def room(self) -> float:
        """How far from the surface gaps between parts are sampled as densely as the rest of the room, metres."""
        return max(1.2, 0.05 * self.target_radius)

    def continuation(self, allowance: float) -> RadialContinuation:
        """Give the continuation of a field on this domain, lowered by an allowance (m)."""
        lengths = (self.target_radius, self.domain_radius, self.outer_radius, allowance)
        return RadialContinuation(jnp.asarray(self.centre), *(jnp.asarray(x, jnp.float64) for x in lengths))
