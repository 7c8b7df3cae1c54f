"""What estimators make of a sensor: its measurement linearised, and the attitude from one that gives it."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from keepout.core.motion import rotation
from keepout.core.motion.relative import MotionState, RelativeMotion
from keepout.core.motion.rotation import Quaternion
from keepout.flights.navigation.sensor import Sample, Sensor


def linearised(sensor: Sensor, state: MotionState) -> tuple[Float[Array, " m"], Float[Array, "m 6"]]:
    """Give what a sensor would say of a state, and its Jacobian by position (m) and velocity (m/s)."""

    def said(x: Float[Array, "6"]) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
        value = sensor.ideal(eqx.tree_at(lambda m: (m.position, m.velocity), state, (x[:3], x[3:])))
        return value, value

    jacobian, value = jax.jacfwd(said, has_aux=True)(jnp.concatenate([state.position, state.velocity]))
    return value, jacobian


def probe(motion: RelativeMotion) -> MotionState:
    """Give a state in no special place, to ask sensors what they are."""
    state = motion.initial_state([20.0, -30.0, 10.0], [0.1, 0.2, -0.3])
    return eqx.tree_at(lambda m: m.attitude, state, rotation.normalise(jnp.array([0.8, 0.4, -0.2, 0.3])))


def attitude_sensors(motion: RelativeMotion, sensors: Sequence[Sensor]) -> tuple[bool, ...]:
    """Give for each sensor whether it says the target's attitude quaternion and nothing else."""
    state = probe(motion)
    said = [np.asarray(sensor.ideal(state)) for sensor in sensors]
    return tuple(v.shape == (4,) and np.allclose(v, state.attitude, rtol=0.0, atol=1e-12) for v in said)


def turned(attitude: Quaternion, sample: Sample, share: float | Float[Array, ""]) -> tuple[Quaternion, Bool[Array, ""]]:
    """Turn an attitude by a share of the way, the shorter one, to a sampled one; and say whether that was none."""
    length = jnp.sqrt(jnp.sum(sample.value**2))
    valid = jnp.isfinite(length) & (length > 0.0)
    new = jnp.where(valid, sample.value / jnp.where(valid, length, 1.0), attitude)
    new = jnp.where(jnp.sum(new * attitude) < 0.0, -new, new)
    pulled = rotation.normalise(attitude + share * (new - attitude))
    return jnp.where(sample.came & valid, pulled, attitude), sample.came & ~valid
