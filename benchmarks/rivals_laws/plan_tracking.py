"""Laws that track a plan: LQR feedback to a reference, made before the flight or anew as it flies."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Float, Int

from keepout.core.motion.relative import MotionState
from rivals_laws.observed import ObservedLaw, Plant

Vector = Float[Array, "3"]
Reference = Float[Array, "steps 9"]
"""Position (m), velocity (m/s) and mean acceleration over the coming period (m/s²), a row a control step."""


class Tracker(eqx.Module):
    """LQR feedback of position and velocity errors: 1/s² and 1/s."""

    position: Float[Array, ""]
    velocity: Float[Array, ""]

    @classmethod
    def tuned(cls, period: float, authority: float) -> "Tracker":
        """Tune it by Bryson's rule: 5 cm, 1 cm/s and the authority (m/s²) weigh alike."""
        transition, push = np.array([[1.0, period], [0.0, 1.0]]), np.array([[0.5 * period**2], [period]])
        weights, effort = np.diag([0.05**-2, 0.01**-2]), np.array([[authority**-2]])
        cost = scipy.linalg.solve_discrete_are(transition, push, weights, effort)
        gain = np.linalg.solve(effort + push.T @ cost @ push, push.T @ cost @ transition)[0]
        return cls(*(jnp.asarray(number) for number in gain))

    def acceleration(self, row: Float[Array, "9"], estimate: MotionState) -> Vector:
        """Follow one row of a reference."""
        off, slip = row[:3] - estimate.position, row[3:6] - estimate.velocity
        return row[6:] + self.position * off + self.velocity * slip


class PlannedLaw(ObservedLaw):
    """Tracks a reference made before the flight; its last row is at rest at the goal."""

    plant: Plant
    tracker: Tracker
    towards: Vector
    reference: Reference
    wait: float

    @property
    def goal(self) -> Vector:
        """Where the plan ends, m."""
        return self.towards

    def initial_memory(self, state: MotionState) -> Int[Array, ""]:
        """Start at the first row."""
        return jnp.zeros((), jnp.int32)

    def acceleration(self, own, estimate: MotionState):
        """Follow the row of this step."""
        row = self.reference[jnp.minimum(own, len(self.reference) - 1)]
        near = jnp.sum((row[:3] - estimate.position) ** 2) < self.wait**2
        return own + near, self.tracker.acceleration(row, estimate)


class Memory(eqx.Module):
    """Of a `ReplannedLaw`: steps flown, the step at which the reference begins, the plan and its part flown now."""

    count: Int[Array, ""]
    begun: Int[Array, ""]
    nodes: Float[Array, "nodes 10"]
    reference: Reference


class ReplannedLaw(ObservedLaw):
    """Tracks a plan that is made anew as it flies; `replan` runs on the host.

    It is told the steps flown, position, velocity, goal and the memory's last three, and gives these three anew.
    """

    plant: Plant
    tracker: Tracker
    towards: Vector
    nodes: Float[Array, "nodes 10"]
    reference: Reference
    replan: Callable = eqx.field(static=True)

    @property
    def goal(self) -> Vector:
        """Where every plan ends, m."""
        return self.towards

    def initial_memory(self, state: MotionState) -> Memory:
        """Start on the first plan."""
        zero = jnp.zeros((), jnp.int32)
        return Memory(zero, zero, self.nodes, self.reference)

    def acceleration(self, own: Memory, estimate: MotionState):
        """Follow the plan, after asking for a new one where it is time."""
        kept = (own.begun, own.nodes, own.reference)
        begun, nodes, reference = jax.pure_callback(
            self.replan,
            jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), kept),
            own.count,
            estimate.position,
            estimate.velocity,
            self.towards,
            *kept,
            vmap_method="sequential",
        )
        own = Memory(own.count + 1, begun, nodes, reference)
        return own, self.tracker.acceleration(reference[own.count - 1 - begun], estimate)
