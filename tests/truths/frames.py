"""Conversions of positions and velocities between ECI, VVLH and body axes, to hold the motion against.

A velocity in a rotating frame is the rate of change that an observer turning with the frame sees.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from keepout.core.motion.arrays import Vector
from keepout.core.motion.rotation import Quaternion, matrix, orbital_rate, vvlh_axes

PositionVelocity = tuple[Vector, Vector]


def eci_from_vvlh(
    position: Vector,
    velocity: Vector,
    target_position: Vector,
    target_velocity: Vector,
    normal_acceleration: float | Float[Array, ""] = 0.0,
) -> PositionVelocity:
    """Absolute ECI position and velocity of a chaser given in the VVLH frame of a target."""
    axes = vvlh_axes(target_position, target_velocity)
    rate = orbital_rate(target_position, target_velocity, normal_acceleration)
    offset = axes.T @ position
    return target_position + offset, target_velocity + axes.T @ velocity + jnp.cross(rate, offset)


def body_from_vvlh(
    position: Vector, velocity: Vector, attitude: Quaternion, angular_velocity: Vector, vvlh_rate: Vector
) -> PositionVelocity:
    """Body position and velocity of a chaser given in VVLH.

    Args:
        position: in VVLH, m.
        velocity: seen from VVLH, m/s.
        attitude: unit quaternion body ← VVLH, scalar first.
        angular_velocity: the body's inertial angular velocity, rad/s, in body axes.
        vvlh_rate: VVLH's inertial angular velocity, rad/s, in VVLH axes.

    """
    rotation = matrix(attitude)
    in_body = rotation @ position
    return in_body, rotation @ velocity - jnp.cross(angular_velocity - rotation @ vvlh_rate, in_body)


def vvlh_from_body(
    position: Vector, velocity: Vector, attitude: Quaternion, angular_velocity: Vector, vvlh_rate: Vector
) -> PositionVelocity:
    """VVLH position and velocity of a chaser given in body axes; arguments as in `body_from_vvlh`."""
    rotation = matrix(attitude)
    turning = velocity + jnp.cross(angular_velocity - rotation @ vvlh_rate, position)
    return rotation.T @ position, rotation.T @ turning
