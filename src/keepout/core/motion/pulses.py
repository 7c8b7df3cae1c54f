"""Thrusters that are on or off within a control period: how far the motion leaves that under the mean force."""

import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from keepout.core.motion.rotation import Vector

Scalar = Float[Array, ""]


class Pulses(eqx.Module):
    """Constant forces, each on between two moments of one control period.

    With F(t) their sum and F̄ its mean, the chaser's path is x = y + δ: y under F̄, and δ̈ = (F(t) − F̄)/m with δ and δ̇
    zero at the period's start. δ̇ is zero at its end too, and so is δ where every pulse is centred in the period.

    Attributes:
        begin: when each is switched on, s since the period's start.
        end: when it is switched off, not before `begin`.
        force: of each while it is on, N, body axes.
        period: s.

    """

    begin: Float[Array, " pulses"]
    end: Float[Array, " pulses"]
    force: Float[Array, "pulses 3"]
    period: Scalar

    @property
    def mean(self) -> Vector:
        """F̄, N."""
        return (self.end - self.begin) @ self.force / self.period

    def moment(self, order: int, time: float | Scalar) -> Vector:
        """Give F(t) − F̄ integrated `order` times from the period's start to `time` (s): 1 is m δ̇, 2 is m δ."""
        since, until = jnp.maximum(time - self.begin, 0.0), jnp.maximum(time - self.end, 0.0)
        return ((since**order - until**order) @ self.force - self.mean * time**order) / math.factorial(order)


class Departure(eqx.Module):
    """What pulses add to the motion under their mean force, in a turning frame.

    The frame turns δ aside: x = y + δ + η with η̈ = −2 (ω + ω̇ t)×δ̇ + 3 ω×(ω×δ) − ω̇×δ, in which Coriolis force of η̇ is
    counted to first order, and what is left is of third order in ω. Both are integrals of δ in closed form, so that y
    is smooth enough for one Runge–Kutta step.

    Attributes:
        pulses: over the period.
        mass: kg.
        angular_velocity: ω of the frame at the period's start, rad/s.
        angular_acceleration: ω̇, rad/s².

    """

    pulses: Pulses
    mass: Scalar
    angular_velocity: Vector
    angular_acceleration: Vector

    def at(self, time: Scalar) -> tuple[Vector, Vector, Vector]:
        """Give δ + η (m), δ̇ + η̇ (m/s) and η̈ (m/s²), `time` s after the period's start."""
        speed, moved, summed, twice = (self.pulses.moment(order, time) / self.mass for order in (1, 2, 3, 4))
        turn, change = self.angular_velocity, self.angular_acceleration

        def aside(vector: Vector) -> Vector:
            return 3.0 * jnp.cross(turn, jnp.cross(turn, vector)) - jnp.cross(change, vector)

        def coriolis(still: Vector, growing: Vector) -> Vector:
            return -2.0 * (jnp.cross(turn, still) + jnp.cross(change, growing))

        position = moved + coriolis(summed, time * summed - 2.0 * twice) + aside(twice)
        velocity = speed + coriolis(moved, time * moved - summed) + aside(summed)
        return position, velocity, coriolis(speed, time * speed) + aside(moved)
