"""Frames in which the target's orbit is told.

- **ECI**: inertial, z along the Earth's pole.
- **VVLH**: centred on the target, x along its velocity side, z to nadir, y against the orbit normal. It rotates.

All vectors are in metres and metres a second; use `jax.vmap` for batches.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from keepout.core.motion.rotation import Vector


def vvlh_axes(target_position: Vector, target_velocity: Vector) -> Float[Array, "3 3"]:
    """Rotation VVLH ← ECI of a target at an ECI position and velocity; the rows are VVLH's axes."""
    z = -target_position / jnp.linalg.norm(target_position)
    normal = jnp.cross(target_position, target_velocity)
    y = -normal / jnp.linalg.norm(normal)
    return jnp.stack([jnp.cross(y, z), y, z])


def orbital_rate(
    target_position: Vector, target_velocity: Vector, normal_acceleration: float | Float[Array, ""] = 0.0
) -> Vector:
    """Inertial angular velocity of VVLH, rad/s, in ECI axes.

    Along the orbit normal it is ‖r × v‖/‖r‖². An acceleration along the orbit normal (`normal_acceleration`, m/s²,
    zero on a Kepler orbit) turns the orbital plane about the radius at ‖r‖ a_n/‖r × v‖.
    """
    radius_squared = target_position @ target_position
    momentum = jnp.cross(target_position, target_velocity)
    return momentum / radius_squared + target_position * normal_acceleration / jnp.linalg.norm(momentum)
