"""What a safety layer is to the flight loop: it stands between the control law and the thrusters."""

import abc

import equinox as eqx
from jaxtyping import Array, Bool, Float, Int, PyTree

from keepout.core.motion.relative import MotionState


def mode(status: Int[Array, "*batch"]) -> Int[Array, "*batch"]:
    """Give what a safety layer did: the two lowest bits of its status, 0 where it passed the command on."""
    return status & 3


class SafetyLayer(eqx.Module):
    """Passes each commanded force on, or replaces it. What it remembers is a pytree that it takes and gives back."""

    @abc.abstractmethod
    def initial_state(self, estimate: MotionState) -> PyTree:
        """Return the memory before the first step, at the estimate of the motion that the layer is told."""

    @property
    def delay(self) -> int:
        """Control steps between a command and its effect, as the layer assumes them; 0 unless it knows of a delay."""
        return 0

    def begun_with(self, estimate: MotionState, under_way: Float[Array, "steps 3"]) -> PyTree:
        """Return the memory before the first step where commands are under way: forces, N, body axes, the oldest first.

        A layer that knows of no delay begins as it always does.
        """
        return self.initial_state(estimate)

    @abc.abstractmethod
    def filter(
        self,
        guard_state: PyTree,
        estimate: MotionState,
        force: Float[Array, "3"],
        disturbance_estimate: Float[Array, "3"],
        errors: Float[Array, "2"] | None = None,
        contradicted: Bool[Array, ""] | None = None,
    ) -> tuple[PyTree, Float[Array, "3"], Int[Array, ""]]:
        """Accept or replace a commanded force.

        Args:
            guard_state: the memory.
            estimate: of the motion, as the law was told it.
            force: that the law commands, N, body axes.
            disturbance_estimate: of the law, N.
            errors: bounds of this estimate's errors in position (m) and velocity (m/s), where they are known; None
                where only those declared for the whole flight are.
            contradicted: whether what this estimate is made of contradicts itself, so that those bounds cannot all
                hold; None where nothing could tell.

        Returns:
            The memory for the next step, the force to command (N, body axes), and a status: 0 in its two lowest bits
            where the command was passed on; the layer's own flags in the bits above.

        """
