"""Thrusters: from the commanded force to the one that can be given."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, PRNGKeyArray, PyTree

from keepout.core.errors import ScenarioError
from keepout.core.motion.arrays import NumbersLike, as_float64
from keepout.core.motion.pulses import Pulses
from keepout.core.motion.rotation import Vector


def _per_axis(value: NumbersLike) -> Array:
    if isinstance(value, jax.Array):
        return jnp.broadcast_to(as_float64(value), (3,))
    return as_float64(np.broadcast_to(np.asarray(value), (3,)))


class Firing(eqx.Module):
    """What thrusters do over one control period.

    Attributes:
        force: their mean force, N, body axes.
        pulses: when which force is on, where it is not held all along.
        on_time: of each thruster, s, where there are thrusters to tell apart.
        propellant: burnt, kg, where that is known.

    """

    force: Vector
    pulses: Pulses | None = None
    on_time: Float[Array, " thrusters"] | None = None
    propellant: Float[Array, ""] | None = None


class ThrusterModel(eqx.Module):
    """What becomes of a commanded force; `Thrusters` hold it, and `thrusters.on_off.OnOffThrusters` give pulses."""

    @abc.abstractmethod
    def apply(self, command: Vector) -> Vector:
        """Give the force (N, body axes) that is held over the period for a commanded one."""

    @abc.abstractmethod
    def saturated(self, command: Vector) -> Bool[Array, ""]:
        """Whether a command (N) is more than can be given."""

    def initial_state(self, key: PRNGKeyArray) -> PyTree:
        """Make the memory that a flight starts with; what differs from flight to flight is drawn from the key."""
        return ()

    def fire(self, state: PyTree, command: Vector) -> tuple[PyTree, Firing]:
        """Say what is done over the coming period for a commanded force (N, body axes): by default `apply`, held."""
        return state, Firing(self.apply(command))


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
