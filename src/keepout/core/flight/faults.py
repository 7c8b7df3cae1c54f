"""What can go wrong in flight, each as a small seeded module: estimates, commands, thrusters, and the law itself.

`Faults` modules stand between truth and law (`FlightSetup.faults`); `BrokenLaw` modules stand in for the control law
(`FlightSetup.controller`), so that the guard behind them is shown a hostile command. Which of them the guard's
theorem covers, and under which numbers, is in docs/safety.md.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, PRNGKeyArray, PyTree

from keepout.core.control.law import Command, LawOfAnother
from keepout.core.errors import ScenarioError
from keepout.core.fields.field import Field
from keepout.core.flight.setup import Faults
from keepout.core.motion.arrays import Scalar, Vector, as_float64
from keepout.core.motion.relative import MotionState


def _in_ball(key: PRNGKeyArray, radius: Scalar) -> Vector:
    """Draw from the ball of a radius: nothing is ever beyond it, so that a bound on errors is a bound."""
    a, b = jax.random.split(key)
    direction = jax.random.normal(a, (3,))
    return radius * jax.random.uniform(b) ** (1.0 / 3.0) * direction / jnp.linalg.norm(direction)


class WrongEstimate(Faults):
    """A constant bias and a new error at every sample, each in a ball: the sum of bias and noise bounds the error.

    Attributes:
        position_bias: length of the bias, whose direction is drawn once a flight, m.
        velocity_bias: likewise, m/s.
        position_noise: radius of the ball that each sample's error is drawn from, m.
        velocity_noise: likewise, m/s.

    """

    position_bias: Scalar = eqx.field(converter=as_float64, default=0.0)
    velocity_bias: Scalar = eqx.field(converter=as_float64, default=0.0)
    position_noise: Scalar = eqx.field(converter=as_float64, default=0.0)
    velocity_noise: Scalar = eqx.field(converter=as_float64, default=0.0)

    def initial_state(self, key: PRNGKeyArray) -> PyTree:
        """Draw the biases."""
        key, a, b = jax.random.split(key, 3)
        first, second = jax.random.normal(a, (3,)), jax.random.normal(b, (3,))
        return (
            key,
            self.position_bias * first / jnp.linalg.norm(first),
            self.velocity_bias * second / jnp.linalg.norm(second),
        )

    def estimate(self, fault_state: PyTree, true_state: MotionState) -> tuple[PyTree, MotionState]:
        """Add bias and noise to position and velocity."""
        key, position_bias, velocity_bias = fault_state
        key, a, b = jax.random.split(key, 3)
        biased = true_state.moved(position_bias, velocity_bias)
        told = biased.moved(_in_ball(a, self.position_noise), _in_ball(b, self.velocity_noise))
        return (key, position_bias, velocity_bias), told


class GaussianEstimate(Faults):
    """A Gaussian error of the estimate, without a bound, that fades from sample to sample: a Gauss–Markov process.

    Attributes:
        position_std: standard deviation of each axis, m.
        velocity_std: likewise, m/s.
        memory: share of the error that is left a sample later, 0 to 1; the rest is drawn anew.

    """

    position_std: Scalar = eqx.field(converter=as_float64, default=0.0)
    velocity_std: Scalar = eqx.field(converter=as_float64, default=0.0)
    memory: Scalar = eqx.field(converter=as_float64, default=0.0)

    def initial_state(self, key: PRNGKeyArray) -> PyTree:
        """Draw the first error, as multiples of the standard deviations."""
        key, draw = jax.random.split(key)
        return key, jax.random.normal(draw, (6,))

    def estimate(self, fault_state: PyTree, true_state: MotionState) -> tuple[PyTree, MotionState]:
        """Add the error to position and velocity, and draw the next one."""
        key, error = fault_state
        told = true_state.moved(self.position_std * error[:3], self.velocity_std * error[3:])
        key, draw = jax.random.split(key)
        fresh = jnp.sqrt(1.0 - self.memory**2) * jax.random.normal(draw, (6,))
        return (key, self.memory * error + fresh), told


class DelayedCommands(Faults):
    """Every command takes effect late; before the first arrives there is no force.

    Attributes:
        steps: control periods from command to effect, at least 1.

    Raises:
        ScenarioError: fewer steps.

    """

    steps: int = eqx.field(static=True)

    def __check_init__(self):
        if self.steps < 1:
            raise ScenarioError(f"delay: {self.steps} steps; it must be at least 1")

    def initial_state(self, key: PRNGKeyArray) -> PyTree:
        """Start with an empty line."""
        return jnp.zeros((self.steps, 3))

    def command(self, fault_state: PyTree, force: Vector, time: Scalar) -> tuple[PyTree, Vector]:
        """Give the oldest command in the line."""
        return jnp.concatenate([fault_state[1:], force[None]]), fault_state[0]


class NoThrust(Faults):
    """From some time on no command reaches the thrusters.

    Attributes:
        start: that time, s since the epoch.

    """

    start: Scalar = eqx.field(converter=as_float64)

    def command(self, fault_state: PyTree, force: Vector, time: Scalar) -> tuple[PyTree, Vector]:
        """Give the command, or none."""
        return fault_state, jnp.where(time >= self.start, 0.0, force)


class DroppedCommands(Faults):
    """Each command is lost with a probability; the thrusters then go on as they were.

    Attributes:
        probability: of each command, 0 to 1.

    """

    probability: Scalar = eqx.field(converter=as_float64)

    def initial_state(self, key: PRNGKeyArray) -> PyTree:
        """Start without force."""
        return key, jnp.zeros(3)

    def command(self, fault_state: PyTree, force: Vector, time: Scalar) -> tuple[PyTree, Vector]:
        """Give this command or the last one that arrived."""
        key, last = fault_state
        key, draw = jax.random.split(key)
        arrived = jnp.where(jax.random.uniform(draw) < self.probability, last, force)
        return (key, arrived), arrived


class StuckThruster(Faults):
    """From some time on, the thruster that pushes along one direction of an axis is stuck.

    The opposite thruster works on, so a stuck-on force can be held against but not beyond.

    Attributes:
        axis: 0, 1 or 2.
        sign: +1 or -1, the direction in which it pushes.
        force: that it then always gives, N: its limit if stuck on, 0 if stuck off.
        start: when it sticks, s since the orbit's epoch.

    Raises:
        ScenarioError: another axis or sign.

    """

    axis: int = eqx.field(static=True)
    sign: int = eqx.field(static=True)
    force: Scalar = eqx.field(converter=as_float64)
    start: Scalar = eqx.field(converter=as_float64, default=0.0)

    def __check_init__(self):
        if self.axis not in (0, 1, 2) or self.sign not in (1, -1):
            raise ScenarioError(f"stuck thruster: axis {self.axis}, sign {self.sign}; valid are 0, 1, 2 and 1, -1")

    def actuate(self, fault_state: PyTree, force: Vector, time: Scalar) -> tuple[PyTree, Vector]:
        """Replace one direction's force."""
        healthy = jnp.maximum(-self.sign * force[self.axis], 0.0)
        stuck = force.at[self.axis].set(self.sign * (self.force - healthy))
        return fault_state, jnp.where(time >= self.start, stuck, force)


class ThrusterGain(Faults):
    """Each axis gives its command times a factor drawn once a flight.

    Attributes:
        error: the factors are drawn from 1 ± this.

    """

    error: Scalar = eqx.field(converter=as_float64)

    def initial_state(self, key: PRNGKeyArray) -> PyTree:
        """Draw the factors."""
        return 1.0 + self.error * jax.random.uniform(key, (3,), minval=-1.0, maxval=1.0)

    def actuate(self, fault_state: PyTree, force: Vector, time: Scalar) -> tuple[PyTree, Vector]:
        """Scale the force."""
        return fault_state, fault_state * force


class CombinedFaults(Faults):
    """Several faults at once, each applied to what the one before it leaves."""

    parts: tuple[Faults, ...] = eqx.field(converter=tuple)

    def initial_state(self, key: PRNGKeyArray) -> PyTree:
        """Start every part with a key of its own."""
        return tuple(part.initial_state(jax.random.fold_in(key, i)) for i, part in enumerate(self.parts))

    def _through(self, method: str, fault_state: PyTree, passed: Any, *arguments: Any) -> tuple[PyTree, Any]:
        states = []
        for part, state in zip(self.parts, fault_state, strict=True):
            state, passed = getattr(part, method)(state, passed, *arguments)
            states.append(state)
        return tuple(states), passed

    def estimate(self, fault_state: PyTree, true_state: MotionState) -> tuple[PyTree, MotionState]:
        """Pass the truth through every part."""
        return self._through("estimate", fault_state, true_state)

    def command(self, fault_state: PyTree, force: Vector, time: Scalar) -> tuple[PyTree, Vector]:
        """Pass the command through every part."""
        return self._through("command", fault_state, force, time)

    def actuate(self, fault_state: PyTree, force: Vector, time: Scalar) -> tuple[PyTree, Vector]:
        """Pass the force through every part."""
        return self._through("actuate", fault_state, force, time)


KINDS = ("none", "into the body", "through", "random", "bang-bang", "not a number")
"""How a `BrokenLaw` can be broken."""


def _kind(value: str | Int[Array, "*batch"]) -> Int[Array, "*batch"]:
    if not isinstance(value, str):
        return value
    if value not in KINDS:
        raise ScenarioError(f"broken law: {value!r}; valid are {', '.join(KINDS)}")
    return jnp.asarray(KINDS.index(value))


class BrokenLaw(LawOfAnother):
    """A control law whose force is replaced by a hostile one; all else it reports stays the law's own.

    Attributes:
        field: for "into the body".
        kind: a name or an index of `KINDS`: "none" (the law's own force), "into the body" (full thrust against the
            field's gradient), "through" (straight to the goal at twice the speed, whatever is between), "random" (each
            axis uniform within the limit), "bang-bang" (full thrust, a random corner of the box for `hold` steps),
            "not a number" (every `hold`-th command is NaN). As it is an array, flights of one batch can differ in it.
        force_limit: N.
        mass: kg.
        speed: for "through", m/s.
        seed: of what is drawn.
        hold: control steps, for the last two of `kind`.

    Raises:
        ScenarioError: an unknown kind.

    """

    field: Field
    kind: Int[Array, ""] = eqx.field(converter=_kind)
    force_limit: Scalar = eqx.field(converter=as_float64)
    mass: Scalar = eqx.field(converter=as_float64)
    speed: Scalar = eqx.field(converter=as_float64)
    seed: int = eqx.field(static=True, default=0)
    hold: int = eqx.field(static=True, default=15)

    def initial_state(self, state: MotionState) -> PyTree:
        """Start the working law, and a stream of its own that depends on where the flight starts."""
        key = jax.random.key(self.seed)
        for number in jnp.concatenate([state.position, state.velocity]):
            key = jax.random.fold_in(key, jnp.asarray(number * 1e6).astype(jnp.int32).astype(jnp.uint32))
        return self.law.initial_state(state), key, jnp.zeros((), jnp.int32)

    def with_applied_force(self, state: PyTree, force: Vector) -> PyTree:
        """Tell the working law what was applied."""
        return self.law.with_applied_force(state[0], force), state[1], state[2]

    def step(self, state: PyTree, estimate: MotionState) -> tuple[PyTree, Command]:
        """Run the working law, and replace its force."""
        memory, key, count = state
        memory, order = self.law.step(memory, estimate)
        steady = jax.random.fold_in(jax.random.fold_in(key, 2**31 - 1), count // self.hold)
        force = self._force(order.force, jax.random.fold_in(key, count), steady, count, estimate)
        return (memory, key, count + 1), eqx.tree_at(lambda o: o.force, order, force)

    def _force(
        self, own: Vector, key: PRNGKeyArray, steady: PRNGKeyArray, count: Int[Array, ""], estimate: MotionState
    ) -> Vector:
        limit = self.force_limit
        gradient = self.field.value_and_gradient(estimate.position)[1]
        away = self.goal - estimate.position
        wanted = 2.0 * self.speed * away / jnp.maximum(jnp.linalg.norm(away), 1e-9)
        forces = (
            own,
            -limit * gradient / jnp.maximum(jnp.max(jnp.abs(gradient)), 1e-9),
            jnp.clip(self.mass * (wanted - estimate.velocity), -limit, limit),
            limit * jax.random.uniform(key, (3,), minval=-1.0, maxval=1.0),
            limit * jax.random.rademacher(steady, (3,), dtype=jnp.float64),
            jnp.where(count % self.hold == 0, jnp.nan, own),
        )
        return jnp.stack(forces)[self.kind]
