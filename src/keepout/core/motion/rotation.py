"""Rotations as unit quaternions, scalar first, and the frames in which the target's orbit is told.

A quaternion named `b_from_a` takes the components of a vector in frame a to its components in frame b,
`v_b = q ⊗ v_a ⊗ q*`; it is what SciPy calls `Rotation.from_quat(q, scalar_first=True).apply(v_a)`. Much of the
spacecraft literature writes the conjugate for the same attitude, so files that follow it convert at the edge.

- **ECI**: inertial, z along the Earth's pole.
- **VVLH**: centred on the target, x along its velocity side, z to nadir, y against the orbit normal. It rotates.

All vectors are in metres and metres a second; use `jax.vmap` for batches.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from keepout.core.motion.arrays import Scalar, Vector

Quaternion = Float[Array, "4"]


def identity() -> Quaternion:
    """Return the quaternion that changes nothing."""
    return jax.device_put(np.array([1.0, 0.0, 0.0, 0.0]))


def multiply(left: Quaternion, right: Quaternion) -> Quaternion:
    """Hamilton product: rotate by `right` first, then by `left`."""
    a, u = left[0], left[1:]
    b, w = right[0], right[1:]
    return jnp.concatenate([(a * b - u @ w)[None], a * w + b * u + jnp.cross(u, w)])


def matrix(quaternion: Quaternion) -> Float[Array, "3 3"]:
    """Give the 3 × 3 matrix of a unit quaternion: `matrix(q) @ v` equals `q ⊗ v ⊗ q*`."""
    w, x, y, z = quaternion
    return jnp.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def normalise(quaternion: Quaternion) -> Quaternion:
    """Return the nearest unit quaternion."""
    return quaternion / jnp.linalg.norm(quaternion)


def rate(b_from_a: Quaternion, angular_velocity: Vector) -> Quaternion:
    """Time derivative of `b_from_a` when frame b turns against frame a at `angular_velocity` (rad/s, in b's axes).

    A vector fixed in a seems, from b, to turn the other way: q̇ = −½ (0, ω) ⊗ q.
    """
    return -0.5 * multiply(jnp.concatenate([jnp.zeros(1), angular_velocity]), b_from_a)


def without_jumps(quaternions: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 4"]:
    """Give the same rotations, with no change of sign from row to row; in whichever order their components are."""
    turned = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0.0
    return quaternions * np.cumprod(np.append(1.0, np.where(turned, -1.0, 1.0)))[:, None]


def vvlh_axes(target_position: Vector, target_velocity: Vector) -> Float[Array, "3 3"]:
    """Rotation VVLH ← ECI of a target at an ECI position and velocity; the rows are VVLH's axes."""
    z = -target_position / jnp.linalg.norm(target_position)
    normal = jnp.cross(target_position, target_velocity)
    y = -normal / jnp.linalg.norm(normal)
    return jnp.stack([jnp.cross(y, z), y, z])


def orbital_rate(target_position: Vector, target_velocity: Vector, normal_acceleration: float | Scalar = 0.0) -> Vector:
    """Inertial angular velocity of VVLH, rad/s, in ECI axes.

    Along the orbit normal it is ‖r × v‖/‖r‖². An acceleration along the orbit normal (`normal_acceleration`, m/s²,
    zero on a Kepler orbit) turns the orbital plane about the radius at ‖r‖ a_n/‖r × v‖.
    """
    radius_squared = target_position @ target_position
    momentum = jnp.cross(target_position, target_velocity)
    return momentum / radius_squared + target_position * normal_acceleration / jnp.linalg.norm(momentum)
