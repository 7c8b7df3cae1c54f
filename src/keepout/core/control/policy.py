"""A law of a plain callable: what a policy that was learned elsewhere, or a few lines of your own, asks for."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from keepout.core.control.law import Command, Law
from keepout.core.motion.arrays import as_float64
from keepout.core.motion.relative import MotionState


class PolicyLaw(Law):
    """A law that asks a callable: force (3,) N = policy(position − goal (3,) m, velocity (3,) m/s, time s).

    Attributes:
        destination: the goal, (3,) m, body frame.
        policy: a function of JAX arrays, or with `on_host` of NumPy arrays.
        on_host: whether the callable is plain Python (NumPy, PyTorch, a table) and not JAX's. It is then called once a
            step from the compiled flight: slower, and such a flight has no derivatives.

    """

    destination: Float[Array, "3"] = eqx.field(converter=as_float64)
    policy: Callable[[Any, Any, Any], Any]
    on_host: bool = eqx.field(static=True, default=False)

    @property
    def goal(self) -> Float[Array, "3"]:
        """Where the policy leads, m."""
        return self.destination

    def initial_state(self, state: MotionState) -> PyTree:
        """Nothing to remember."""
        return ()

    def step(self, state: PyTree, estimate: MotionState) -> tuple[PyTree, Command]:
        """Ask the policy."""
        seen = (estimate.position - self.goal, estimate.velocity, estimate.time)
        if self.on_host:
            told = jax.ShapeDtypeStruct((3,), jnp.float64)
            force = jax.pure_callback(_on_host(self.policy), told, *seen, vmap_method="sequential")
        else:
            force = jnp.asarray(self.policy(*seen), jnp.float64)
        return state, Command.of_force(force)


def _on_host(policy: Callable[[Any, Any, Any], Any]) -> Callable[[Any, Any, Any], Float[np.ndarray, "3"]]:
    """Give what JAX calls back: it sees arrays of NumPy, and whatever the policy answers becomes three numbers."""

    def asked(away: Any, velocity: Any, time: Any) -> Float[np.ndarray, "3"]:
        answer = policy(np.asarray(away), np.asarray(velocity), float(time))
        return np.asarray(answer, dtype=np.float64).reshape(3)

    return asked
