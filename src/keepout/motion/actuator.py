"""Thrusters: from the commanded force to the one that can be given."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from keepout.errors import ScenarioError
from keepout.motion.arrays import NumbersLike, as_float64
from keepout.motion.rotation import Vector


def _per_axis(value: NumbersLike) -> Array:
    if isinstance(value, jax.Array):
        return jnp.broadcast_to(as_float64(value), (3,))
    return as_float64(np.broadcast_to(np.asarray(value), (3,)))


class ThrusterModel(eqx.Module):
    """What becomes of a commanded force; `Thrusters` are the ones that ship."""

    @abc.abstractmethod
    def apply(self, command: Vector) -> Vector:
        """Give the force (N, body axes) that is held over the period for a commanded one."""

    @abc.abstractmethod
    def saturated(self, command: Vector) -> Bool[Array, ""]:
        """Whether a command (N) is more than can be given."""


class Thrusters(ThrusterModel):
    """Thrusters along the body axes, each limited on its own (paper, section VI: 0.1 N per axis).

    force_limit: N, one number or one per axis.

    Raises:
        ScenarioError: a limit that is not positive.

    """

    force_limit: Float[Array, "3"] = eqx.field(converter=_per_axis)

    def __check_init__(self):
        if isinstance(self.force_limit, Tracer):
            return  # values are not known yet inside a transformation
        if not np.all(np.asarray(self.force_limit) > 0):
            raise ScenarioError(f"force_limit: {self.force_limit.tolist()} N; every axis must be positive")

    def apply(self, command: Vector) -> Vector:
        """Cut the command off at the limit in each axis, N. A command that is not a number stays one."""
        return jnp.clip(command, -self.force_limit, self.force_limit)

    def saturated(self, command: Vector) -> Bool[Array, ""]:
        """Whether the command reaches the limit in any axis."""
        return jnp.any(jnp.abs(command) >= self.force_limit * (1 - 1e-9))
