"""What a control law is to the rest of Keepout: the interface that flight, faults and real-time use know it by."""

import abc
import enum
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from keepout.core.motion.relative import MotionState


class ControlStatus(enum.IntEnum):
    """What a control step has to say; where several apply, the gravest: the last one, `NOT_FINITE` before all."""

    NOMINAL = 0
    SATURATED = 1  # the force asked for was beyond the thrusters and has been cut off, axis by axis
    OUTSIDE_SAFE_SET = 2  # no safe velocity exists here; the law flies the fastest way out
    SOLVER_STALLED = 3  # the safe velocity could not be verified to rounding; the best iterate is used
    NOT_FINITE = 4  # an input or the field was not a number; the force is zero
    NO_WAY_OUT = 5  # no safe velocity exists and e_∇h ≥ ‖∇f̃‖: no direction is known to lead out, v_s is zero


class Command(eqx.Module):
    """The answer of one control step.

    Attributes:
        force: N, body axes, within the thrusters' limits.
        desired_velocity: v_c, m/s.
        safe_velocity: v_s, m/s.
        disturbance_estimate: N, now.
        barrier: h = field − error_bound − radius − margin, m (the law itself keeps its nominal offset on top).
        backstepping_barrier: h₁ of the law, m, with the unknown estimation error taken as zero.
        lyapunov: V₁, m².
        status: a `ControlStatus`.

    """

    force: Float[Array, "3"]
    desired_velocity: Float[Array, "3"]
    safe_velocity: Float[Array, "3"]
    disturbance_estimate: Float[Array, "3"]
    barrier: Float[Array, ""]
    backstepping_barrier: Float[Array, ""]
    lyapunov: Float[Array, ""]
    status: Int[Array, ""]

    @classmethod
    def of_force(cls, force: Float[Array, "3"]) -> "Command":
        """Give the answer of a law that has a force (N, body axes) to tell and nothing else.

        The disturbance estimate is zero, and whatever the law has no word of is not a number.
        """
        unknown = jnp.full(3, jnp.nan)
        return cls(
            force=force,
            desired_velocity=unknown,
            safe_velocity=unknown,
            disturbance_estimate=jnp.zeros(3),
            barrier=unknown[0],
            backstepping_barrier=unknown[0],
            lyapunov=unknown[0],
            status=jnp.asarray(ControlStatus.NOMINAL, jnp.int32),
        )


class Condition(NamedTuple):
    """One design condition: what it asks in words, the number found, the limit it is held against, and the verdict.

    A `required` condition is one without which the default law must not fly; the others void a theorem.
    """

    name: str
    statement: str
    value: float
    limit: float
    satisfied: bool
    required: bool = True

    def __str__(self) -> str:
        verdict = "holds" if self.satisfied else "violated"
        return f"{self.name} {verdict} ({self.statement}: {self.value:.4g} against {self.limit:.4g})"


class Law(eqx.Module):
    """A control law: one force a control period, from an estimate of the motion.

    A law is a pytree. What it remembers from step to step is a pytree too, which every method takes and gives back, so
    that one law flies single flights, batches and in real time.
    """

    @property
    @abc.abstractmethod
    def goal(self) -> Float[Array, "3"]:
        """Where the law leads, m, body frame."""

    @property
    def conditions(self) -> tuple[Condition, ...]:
        """The law's design conditions, checked when it was built; none unless the law has some."""
        return ()

    def flown(self) -> "Law":
        """Give the law without what flying it does not need, so that more laws share a compiled program."""
        return self

    @abc.abstractmethod
    def initial_state(self, state: MotionState) -> PyTree:
        """Return what the law remembers before its first step at `state`."""

    def begun_with(self, state: MotionState, under_way: Float[Array, "steps 3"]) -> PyTree:
        """Return the same where commands are under way: forces that have not taken effect, N, the oldest first.

        A law that knows of no delay begins as it always does.
        """
        return self.initial_state(state)

    @abc.abstractmethod
    def step(self, state: PyTree, estimate: MotionState) -> tuple[PyTree, Command]:
        """Run one control step on an estimate of the motion; called once a period."""

    def with_applied_force(self, state: PyTree, force: Float[Array, "3"]) -> PyTree:
        """Return the memory told that `force` (N) is held from now on instead of the one commanded.

        A law that models the force it commanded must override this, or it takes the difference for a disturbance.
        """
        return state
