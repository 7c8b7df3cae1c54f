"""Tracking of the safe velocity, and the smooth safety filter on it (paper, section V-B)."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from keepout.core.control.velocity import VelocityPoint
from keepout.core.motion.arrays import norm

_NO_GRADIENT = 1e-24


def safety_gain(a: Float[Array, ""], b: Float[Array, ""], sharpness: Float[Array, ""]) -> Float[Array, ""]:
    """Return Λ(a, b) = ln(1 + exp(−ε a/b))/ε, and 0 where b = 0 (paper Eq. SmoothSafetyFiltersParam).

    Free of overflow for any a and b ≥ 0, with finite derivatives on both branches.
    """
    usable = b > _NO_GRADIENT
    ratio = -sharpness * a / jnp.where(usable, b, 1.0)
    return jnp.where(usable, jnp.logaddexp(0.0, ratio) / sharpness, 0.0)


class TrackingPoint(eqx.Module):
    """The tracking layer at one state.

    `reference` u_ref and `control` u in N (both before the disturbance is compensated), `backstepping_barrier` h₁ in
    m and `lyapunov` V₁ in m², both with the unknown estimation error e_d taken as zero; `a`, `b` as in the paper.
    """

    reference: Float[Array, "3"]
    control: Float[Array, "3"]
    backstepping_barrier: Float[Array, ""]
    lyapunov: Float[Array, ""]
    a: Float[Array, ""]
    b: Float[Array, ""]


class Tracking(eqx.Module):
    """u_ref, Λ, h₁ and V₁ (paper Eqs. composite_controller to SmoothSafetyFiltersParam), with the sign of g corrected.

    `gain` λ (1/s), `position_weight` H₀ (3, 3), `lyapunov_ratio` μ_v (1/s²), `barrier_ratio` μ_h (m/s²),
    `estimation_weight` β (m/N²), `estimation_rate` β_e and `barrier_rate` β_c (1/s), `sharpness` ε, `gradient_error`
    e_∇h. `acceleration_limit` (m/s²), where given, limits the norm of the velocity and position feedback; its
    direction stays.
    """

    gain: Float[Array, ""]
    position_weight: Float[Array, "3 3"]
    lyapunov_ratio: Float[Array, ""]
    barrier_ratio: Float[Array, ""]
    estimation_weight: Float[Array, ""]
    estimation_rate: Float[Array, ""]
    barrier_rate: Float[Array, ""]
    sharpness: Float[Array, ""]
    gradient_error: Float[Array, ""]
    acceleration_limit: Float[Array, ""] | None = None

    def __call__(
        self,
        point: VelocityPoint,
        position_error: Float[Array, "3"],
        velocity: Float[Array, "3"],
        drift: Float[Array, "3"],
        mass: Float[Array, ""],
    ) -> TrackingPoint:
        """Return the tracking layer for r_e (m), v (m/s), the drift acceleration (m/s²) and a mass in kg."""
        error = velocity - point.velocity
        square = jnp.sum(error * error)
        pull = self.position_weight @ position_error
        feedback = -self.lyapunov_ratio * pull - 0.5 * self.gain * error
        if self.acceleration_limit is not None:
            size = jnp.sqrt(jnp.sum(feedback * feedback) + 1e-300)
            feedback = feedback * jnp.minimum(1.0, self.acceleration_limit / size)
        feedforward = -drift + point.jacobian @ velocity
        reference = mass * (feedforward + feedback)

        # With u_ref put in, P·u_ref cancels against (v − v_s)·(−drift + J v)/μ_h; the feedback is what remains.
        gradient = -error / (mass * self.barrier_ratio)
        b = jnp.sum(gradient * gradient)
        speed = norm(velocity)
        barrier = point.barrier - square / (2.0 * self.barrier_ratio)
        a = (
            -jnp.sum(error * feedback) / self.barrier_ratio
            + jnp.sum(point.normal * velocity)
            - self.gradient_error * speed
            + self.barrier_rate * barrier
            - b / (2.0 * self.estimation_weight * (2.0 * self.estimation_rate - self.barrier_rate))
        )
        control = reference + safety_gain(a, b, self.sharpness) * gradient
        lyapunov = 0.5 * jnp.sum(position_error * pull) + square / (2.0 * self.lyapunov_ratio)
        return TrackingPoint(reference, control, barrier, lyapunov, a, b)
