"""A control law for thrusters that answer late: it is asked for the state in which its command will take effect."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from keepout.core.control.law import Command, Condition, Law
from keepout.core.errors import ControlError
from keepout.core.motion.arrays import as_float64
from keepout.core.motion.disturbance import NoDisturbance
from keepout.core.motion.relative import MotionState, RelativeMotion


class AheadOfDelay(Law):
    """A law whose commands take effect some periods after they are given.

    Each estimate is moved ahead by the commands under way before the law sees it, without a disturbance unless the
    estimate comes with one. So the velocities that the law sees differ, from sample to sample, by the force it gave at
    the first of them, the drift and the disturbance that acted: its observer needs no change. A disturbance that comes
    with the estimate acts on the way, held, and is passed on as it is. What the law reports (barrier, safe velocity)
    is about the state ahead.

    Attributes:
        law: any control law.
        motion: the model of the drift.
        mass: kg.
        period: between control steps, s.
        delay: whole periods from command to effect, at least 1.

    Raises:
        ControlError: a delay below 1.

    """

    law: Law
    motion: RelativeMotion
    mass: Float[Array, ""] = eqx.field(converter=as_float64)
    period: Float[Array, ""] = eqx.field(converter=as_float64)
    delay: int = eqx.field(static=True)

    def __check_init__(self):
        if self.delay < 1:
            raise ControlError(f"delay: {self.delay} periods; it must be at least 1")

    @property
    def goal(self) -> Float[Array, "3"]:
        """Where the law leads, m."""
        return self.law.goal

    def flown(self) -> Law:
        """Give the same about its law without what flying does not need."""
        return dataclasses.replace(self, law=self.law.flown())

    @property
    def conditions(self) -> tuple[Condition, ...]:
        """The law's design conditions."""
        return self.law.conditions

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

    def with_applied_force(self, state: PyTree, force: Float[Array, "3"]) -> PyTree:
        """Return the state told that `force` (N) was commanded instead of the law's own."""
        memory, pending = state
        return self.law.with_applied_force(memory, force), pending.at[-1].set(force)

    def step(self, state: PyTree, estimate: MotionState) -> tuple[PyTree, Command]:
        """Run the law on the state ahead."""
        memory, pending = state
        memory, order = self.law.step(memory, self.ahead(estimate, pending))
        return (memory, jnp.concatenate([pending[1:], order.force[None]])), order
