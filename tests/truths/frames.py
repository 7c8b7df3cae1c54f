"""Conversions of positions and velocities between ECI, VVLH, RTN and body axes, to hold the motion against.

RTN (also Hill, RSW, and one of the meanings of "LVLH") is centred on the target, R outwards along the radius, T along
the velocity side, N along the orbit normal; it rotates with VVLH. A velocity in a rotating frame is the rate of change
that an observer turning with the frame sees.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from keepout.motion.frames import orbital_rate, vvlh_axes
from keepout.motion.rotation import Quaternion, Vector, matrix

PositionVelocity = tuple[Vector, Vector]


def rtn_from_vvlh(position: Vector, velocity: Vector) -> PositionVelocity:
    """RTN components of a VVLH position and velocity: R = −z, T = x, N = −y."""
    return _permute(position, (2, 0, 1), (-1.0, 1.0, -1.0)), _permute(velocity, (2, 0, 1), (-1.0, 1.0, -1.0))


def vvlh_from_rtn(position: Vector, velocity: Vector) -> PositionVelocity:
    """VVLH components of an RTN position and velocity: x = T, y = −N, z = −R."""
    return _permute(position, (1, 2, 0), (1.0, -1.0, -1.0)), _permute(velocity, (1, 2, 0), (1.0, -1.0, -1.0))


def _permute(vector: Vector, order: tuple[int, ...], signs: tuple[float, ...]) -> Vector:
    return vector[jnp.array(order)] * jnp.array(signs)


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
    return _to_inertial(position, velocity, axes, rate, target_position, target_velocity)


def vvlh_from_eci(
    position: Vector,
    velocity: Vector,
    target_position: Vector,
    target_velocity: Vector,
    normal_acceleration: float | Float[Array, ""] = 0.0,
) -> PositionVelocity:
    """VVLH position and velocity of a chaser given by its absolute ECI position and velocity."""
    axes = vvlh_axes(target_position, target_velocity)
    rate = orbital_rate(target_position, target_velocity, normal_acceleration)
    return _from_inertial(position, velocity, axes, rate, target_position, target_velocity)


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


def _to_inertial(
    position: Vector, velocity: Vector, axes: Float[Array, "3 3"], rate: Vector, origin: Vector, origin_velocity: Vector
) -> PositionVelocity:
    offset = axes.T @ position
    return origin + offset, origin_velocity + axes.T @ velocity + jnp.cross(rate, offset)


def _from_inertial(
    position: Vector, velocity: Vector, axes: Float[Array, "3 3"], rate: Vector, origin: Vector, origin_velocity: Vector
) -> PositionVelocity:
    offset = position - origin
    return axes @ offset, axes @ (velocity - origin_velocity - jnp.cross(rate, offset))
