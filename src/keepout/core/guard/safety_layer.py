"""What a safety layer is to the flight loop: it stands between the control law and the thrusters."""

import abc
from enum import IntEnum, IntFlag

import equinox as eqx
from jaxtyping import Array, Float, Int, PyTree

from keepout.core.motion.arrays import Flag, Vector
from keepout.core.motion.relative import MotionState


def mode(status: Int[Array, "*batch"]) -> Int[Array, "*batch"]:
    """Give what a safety layer did: the two lowest bits of its status, 0 where it passed the command on."""
    return status & 3


class SafetyLayer(eqx.Module):
    """Passes each commanded force on, or replaces it. What it remembers is a pytree that it takes and gives back."""

    @abc.abstractmethod
    def initial_state(self, estimate: MotionState) -> PyTree:
        """Return the memory before the first step, at the estimate of the motion that the layer is told.

        Args:
            estimate: at the start: m, m/s, body frame.

        """

    @property
    def delay(self) -> int:
        """Control steps between a command and its effect, as the layer assumes them; 0 unless it knows of a delay."""
        return 0

    def begun_with(self, estimate: MotionState, under_way: Float[Array, "steps 3"]) -> PyTree:
        """Return the memory before the first step where commands are under way: forces, N, body axes, the oldest first.

        A layer that knows of no delay begins as it always does.

        Args:
            estimate: at the start: m, m/s, body frame.
            under_way: (steps, 3) forces, N, body axes.

        """
        return self.initial_state(estimate)

    @abc.abstractmethod
    def filter(
        self,
        guard_state: PyTree,
        estimate: MotionState,
        force: Vector,
        disturbance_estimate: Vector,
        errors: Float[Array, "2"] | None = None,
        contradicted: Flag | None = None,
    ) -> tuple[PyTree, Vector, Int[Array, ""]]:
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


class GuardStatus(IntEnum):
    """What the guard did in a step: the status's two lowest bits."""

    CLEAR = 0
    """The command was passed on (cut to the thrusters' limits, if it was beyond them)."""
    BRAKING = 1
    """The command was replaced; the plan's braking motion was followed."""
    HOLDING = 2
    """The command was replaced; the chaser is held at the plan's point of rest."""
    ESCAPING = 3
    """No certified plan: the shortest way out was taken. Nothing is promised until the status changes."""


class GuardFlag(IntFlag):
    """What the guard saw in a step: bits added to the status. Any flag but COMMAND means an assumption did not hold."""

    STATE_JUMP = 4
    """The estimate moved further than force, disturbance bound and estimate errors allow, in a step or in several."""
    DISTURBANCE = 8
    """The disturbance estimate is above one and a half times what the assumptions let an observer see."""
    FIELD = 16
    """The field is not finite here, or not above the threshold."""
    REGION = 32
    """The chaser is beyond the range or speed limit within which the drift is bounded."""
    COMMAND = 64
    """The command held a number that is not finite; it was replaced."""
    OFF_PLAN = 128
    """The chaser has left the tube around its certified plan."""
    ESTIMATE = 256
    """The estimate held a number that is not finite; the plan was followed blind."""
    WIDE = 512
    """The estimate's error bound is wider than declared; no command was passed on, the plan was followed."""
    CONTRADICTED = 1024
    """What the guard is told contradicts itself (samples that no state explains, a map that a view proves wrong)."""
    EXPIRED = 2048
    """The time is past the one until which the assumptions' numbers were worked out."""


def flag_names(flags: int) -> tuple[str, ...]:
    """Name the `GuardFlag` bits of a status, or of several joined by `|`."""
    return tuple(flag.name.lower() for flag in GuardFlag if flag & flags and flag.name is not None)
