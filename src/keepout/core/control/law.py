"""What a control law is to the rest of Keepout: the interface that flight, faults and real-time use know it by.

Two laws are made of others: `PolicyLaw` of a plain callable (a policy that was learned elsewhere, a few lines of your
own), `AheadOfDelay` of any law, for thrusters that answer late.
"""

import abc
import dataclasses
import enum
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from keepout.core.errors import ControlError
from keepout.core.motion.arrays import Scalar, Vector, as_float64
from keepout.core.motion.disturbance import NoDisturbance
from keepout.core.motion.relative import MotionState, RelativeMotion


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
        leg: under way, counted from 0; None where the law has no legs.

    """

    force: Vector
    desired_velocity: Vector
    safe_velocity: Vector
    disturbance_estimate: Vector
    barrier: Scalar
    backstepping_barrier: Scalar
    lyapunov: Scalar
    status: Int[Array, ""]
    leg: Int[Array, ""] | None = None

    @classmethod
    def of_force(cls, force: Vector | Float[np.ndarray, "3"]) -> "Command":
        """Give the answer of a law that has a force (N, body axes) to tell and nothing else.

        The disturbance estimate is zero, and whatever the law has no word of is not a number.

        Args:
            force: (3,) floats, N, body axes.

        """
        unknown, nominal = jnp.full(3, jnp.nan), jnp.asarray(ControlStatus.NOMINAL, jnp.int32)
        return cls(jnp.asarray(force), unknown, unknown, jnp.zeros(3), unknown[0], unknown[0], unknown[0], nominal)


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
    def goal(self) -> Vector:
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
        """Return what the law remembers before its first step.

        Args:
            state: the estimate at the start, as `step` is told it: time (s), position (m) and velocity (m/s) relative
                to the target in its body frame, attitude (body from VVLH) and angular velocity (rad/s).

        Returns:
            A pytree of arrays, the same in structure and shapes at every step; () where nothing is remembered.

        """

    def begun_with(self, state: MotionState, under_way: Float[Array, "steps 3"]) -> PyTree:
        """Return the same where commands are under way: forces that have not taken effect, N, the oldest first.

        A law that knows of no delay begins as it always does.

        Args:
            state: the estimate at the start, as of `initial_state`.
            under_way: (steps, 3) forces, N, body axes.

        """
        return self.initial_state(state)

    @abc.abstractmethod
    def step(self, state: PyTree, estimate: MotionState) -> tuple[PyTree, Command]:
        """Run one control step on an estimate of the motion; called once a period.

        Args:
            state: what the law remembers.
            estimate: of the motion now: `time` (s since the epoch), `position` (3,) m and `velocity` (3,) m/s of the
                chaser relative to the target in its body frame, `attitude` (unit quaternion body from VVLH, scalar
                first) and `angular_velocity` (3,) rad/s, inertial, in body axes. With sensors it is a filter's.

        Returns:
            The memory for the next step, and a `Command` whose force (N, body axes) is held for a period.

        """

    def with_applied_force(self, state: PyTree, force: Vector) -> PyTree:
        """Return the memory told that `force` (N) is held from now on instead of the one commanded.

        A law that models the force it commanded must override this, or it takes the difference for a disturbance.

        Args:
            state: the memory after `step`.
            force: (3,) N, body axes, as the guard leaves it.

        """
        return state


class PolicyLaw(Law):
    """A law that asks a callable: force (3,) N = policy(position − goal (3,) m, velocity (3,) m/s, time s).

    Attributes:
        destination: the goal, (3,) m, body frame.
        policy: a function of JAX arrays, or with `on_host` of NumPy arrays.
        on_host: whether the callable is plain Python (NumPy, PyTorch, a table) and not JAX's. It is then called once a
            step from the compiled flight: slower, and such a flight has no derivatives.

    """

    destination: Vector = eqx.field(converter=as_float64)
    policy: Callable[[Any, Any, Any], Any]
    on_host: bool = eqx.field(static=True, default=False)

    @property
    def goal(self) -> Vector:
        """Where the policy leads, m."""
        return self.destination

    def initial_state(self, state: MotionState) -> PyTree:
        """Nothing to remember.

        Args:
            state: of the motion at the start.

        """
        return ()

    def step(self, state: PyTree, estimate: MotionState) -> tuple[PyTree, Command]:
        """Ask the policy.

        Args:
            state: nothing.
            estimate: of the motion, of which the policy is told position, velocity and time.

        """
        seen = (estimate.position - self.goal, estimate.velocity, estimate.time)
        if self.on_host:

            def asked(away: Any, velocity: Any, time: Any) -> Float[np.ndarray, "3"]:
                # It sees arrays of NumPy, and whatever it answers becomes three numbers.
                answer = self.policy(np.asarray(away), np.asarray(velocity), float(time))
                return np.asarray(answer, dtype=np.float64).reshape(3)

            told = jax.ShapeDtypeStruct((3,), jnp.float64)
            force = jax.pure_callback(asked, told, *seen, vmap_method="sequential")
        else:
            force = jnp.asarray(self.policy(*seen), jnp.float64)
        return state, Command.of_force(force)


class LawOfAnother(Law):
    """A law made of another: what it does not say itself is that law's word.

    Attributes:
        law: the other one.

    """

    law: Law

    @property
    def goal(self) -> Vector:
        """Where the other law leads, m."""
        return self.law.goal

    @property
    def conditions(self) -> tuple[Condition, ...]:
        """The other law's design conditions."""
        return self.law.conditions

    def flown(self) -> Law:
        """Give the same about its law without what flying does not need."""
        return dataclasses.replace(self, law=self.law.flown())

    def initial_state(self, state: MotionState) -> PyTree:
        """Give the memory of the other law."""
        return self.law.initial_state(state)

    def with_applied_force(self, state: PyTree, force: Vector) -> PyTree:
        """Tell the other law."""
        return self.law.with_applied_force(state, force)


class AheadOfDelay(LawOfAnother):
    """A law whose commands take effect some periods after they are given.

    Each estimate is moved ahead by the commands under way before the law sees it, without a disturbance unless the
    estimate comes with one. So the velocities that the law sees differ, from sample to sample, by the force it gave at
    the first of them, the drift and the disturbance that acted: its observer needs no change. A disturbance that comes
    with the estimate acts on the way, held, and is passed on as it is. What the law reports (barrier, safe velocity)
    is about the state ahead.

    Attributes:
        motion: the model of the drift.
        mass: kg.
        period: between control steps, s.
        delay: whole periods from command to effect, at least 1.

    Raises:
        ControlError: a delay below 1.

    """

    motion: RelativeMotion
    mass: Scalar = eqx.field(converter=as_float64)
    period: Scalar = eqx.field(converter=as_float64)
    delay: int = eqx.field(static=True)

    def __check_init__(self):
        if self.delay < 1:
            raise ControlError(f"delay: {self.delay} periods; it must be at least 1")

    def ahead(self, estimate: MotionState, pending: Float[Array, "delay 3"]) -> MotionState:
        """Give the state after the commands under way (N, the oldest first)."""
        push, state = estimate.disturbance, dataclasses.replace(estimate, disturbance=None)
        for i in range(self.delay):
            force = pending[i] if push is None else pending[i] + push
            state = self.motion.step(state, force, NoDisturbance(), self.period, self.mass)
        return dataclasses.replace(state, disturbance=push)

    def initial_state(self, state: MotionState) -> PyTree:
        """Start the law where it will be first obeyed; nothing is under way."""
        return self.begun_with(state, jnp.zeros((self.delay, 3)))

    def begun_with(self, state: MotionState, under_way: Float[Array, "steps 3"]) -> PyTree:
        """Start the law where it will be first obeyed."""
        pending = under_way[-self.delay :]
        return self.law.begun_with(self.ahead(state, pending), under_way), pending

    def with_applied_force(self, state: PyTree, force: Vector) -> PyTree:
        """Return the state told that `force` (N) was commanded instead of the law's own."""
        memory, pending = state
        return self.law.with_applied_force(memory, force), pending.at[-1].set(force)

    def step(self, state: PyTree, estimate: MotionState) -> tuple[PyTree, Command]:
        """Run the law on the state ahead."""
        memory, pending = state
        memory, order = self.law.step(memory, self.ahead(estimate, pending))
        return (memory, jnp.concatenate([pending[1:], order.force[None]])), order
