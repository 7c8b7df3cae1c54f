"""The motions that the guard plans with: under the commands under way, braking to rest, and out of the margin.

Each axis obeys r⁺ = r + T v + T²/2 u, v⁺ = v + T u, without what nobody commanded (docs/guard.md, section 2).
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from keepout.core.guard.braking import BrakingDesign, GuardAssumptions
from keepout.core.motion.arrays import norm

Vector = Float[Array, "3"]


def predict(
    assumptions: GuardAssumptions, position: Vector, velocity: Vector, pending: Float[Array, "delay 3"]
) -> tuple[Float[Array, "points 3"], Float[Array, "points 3"]]:
    """Positions and velocities now and after each pending command; the next command takes effect at the last."""
    T = assumptions.period
    points, velocities = [position], [velocity]
    for i in range(assumptions.delay):
        position = position + T * velocity + 0.5 * T**2 * pending[i]
        velocity = velocity + T * pending[i]
        points.append(position)
        velocities.append(velocity)
    return jnp.stack(points), jnp.stack(velocities)


def stop(assumptions: GuardAssumptions, braking: BrakingDesign, velocity: Vector) -> Vector:
    """From where the nominal braking motion begins to where it ends, m."""
    T, a_b = assumptions.period, braking.deceleration
    speed = jnp.linalg.norm(velocity)
    rest = jnp.fmod(speed, a_b * T)
    length = (speed**2 - rest**2) / (2.0 * a_b) + 0.5 * rest * T
    return velocity * (length / jnp.maximum(speed, 1e-12))


def brake(assumptions: GuardAssumptions, braking: BrakingDesign, velocity: Vector) -> tuple[Vector, Bool[Array, ""]]:
    """Give the nominal braking acceleration, m/s², and whether the nominal motion is at rest."""
    speed = norm(velocity)
    size = jnp.minimum(braking.deceleration, speed / assumptions.period)
    return -velocity * (size / jnp.maximum(speed, 1e-12)), speed < 1e-9


def escape(
    assumptions: GuardAssumptions,
    braking: BrakingDesign,
    escape_speed: float,
    position: Vector,
    velocity: Vector,
    outward: Vector,
) -> Vector:
    """Acceleration (m/s²) along the field's growth, or back into range, at `escape_speed`, within the authority."""
    a = assumptions
    afar = norm(position) + braking.position_radius > 0.99 * a.range_limit
    away = jnp.where(afar, -position, outward)
    direction = away / jnp.maximum(norm(away), 1e-9)
    wanted = (jnp.where(jnp.isfinite(direction), direction, 0.0) * escape_speed - velocity) / a.period
    return wanted * jnp.minimum(1.0, a.authority / jnp.maximum(norm(wanted), 1e-12))
