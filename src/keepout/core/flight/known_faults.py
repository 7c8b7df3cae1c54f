"""Faults whose every draw is given beforehand, as tables: a flight is then a function of these and of its start.

Rows are taken one a call, in the order of the calls, and the last row is repeated beyond the end.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray, PyTree

from keepout.core.flight.faults import Transparent, wrong_by
from keepout.core.motion.relative import MotionState

Vector = Float[Array, "3"]
Scalar = Float[Array, ""]


class KnownErrors(Transparent):
    """Estimates that are wrong by given errors.

    Attributes:
        position: one row an estimate, m.
        velocity: likewise, m/s.

    """

    position: Float[Array, "rows 3"]
    velocity: Float[Array, "rows 3"]

    def initial_state(self, key: PRNGKeyArray) -> PyTree:
        """Start with the first row."""
        return jnp.zeros((), jnp.int32)

    def estimate(self, fault_state: PyTree, true_state: MotionState) -> tuple[PyTree, MotionState]:
        """Add this row's errors."""
        return fault_state + 1, wrong_by(true_state, self.position[fault_state], self.velocity[fault_state])


class KnownLosses(Transparent):
    """Commands of which given ones are lost; the thrusters then go on as they were."""

    lost: Bool[Array, "rows"]

    def initial_state(self, key: PRNGKeyArray) -> PyTree:
        """Start with the first row and without force."""
        return jnp.zeros((), jnp.int32), jnp.zeros(3)

    def command(self, fault_state: PyTree, force: Vector, time: Scalar) -> tuple[PyTree, Vector]:
        """Give this command or the last one that arrived."""
        row, last = fault_state
        arrived = jnp.where(self.lost[row], last, force)
        return (row + 1, arrived), arrived


class KnownGain(Transparent):
    """Thrusters that give their command times a given factor an axis."""

    factor: Vector

    def initial_state(self, key: PRNGKeyArray) -> PyTree:
        """No memory."""
        return ()

    def actuate(self, fault_state: PyTree, force: Vector, time: Scalar) -> tuple[PyTree, Vector]:
        """Scale the force."""
        return fault_state, self.factor * force
