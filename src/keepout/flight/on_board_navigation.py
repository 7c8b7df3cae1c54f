"""Sensors, estimates, law, guard and pulses of one chaser in real time: samples in, a force and on-times out.

The compiled step is what the flight loop does on board: `Navigation.know`, `loop.command`, `Navigation.told`, and
the thrusters' `fire`. What is carried from step to step is one array of numbers, as in `OnBoard`.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from keepout.compiled.kept_programs import keep_programs
from keepout.compiled.one_kernel import compiled
from keepout.errors import ControlError
from keepout.flight import loop
from keepout.flight.setup import FlightSetup
from keepout.motion.relative import MotionState
from keepout.sensing.sensor import Sample

Value = Float[np.ndarray, "_"] | Array | Sequence[float]
"""What one sensor measured: one number a component, in its own units and axes."""

_Memory = tuple[PyTree, PyTree, PyTree, PyTree]
"""Of navigation, law, guard and thrusters."""


class Known(NamedTuple):
    """What the last step knew, beside the force: SI units, body axes.

    Attributes:
        force: to hold over the coming period, N.
        position: the law's estimate, m.
        velocity: likewise, m/s.
        known_position: centre of the guard's set, m.
        known_velocity: likewise, m/s.
        errors: the set's radii, m and m/s.
        control_status: of the law.
        guard_status: of the guard.
        outliers: samples that the law's estimate left out.
        contradicted: whether the samples cannot all be within their bounds.
        on_time: of each thruster over the coming period, s; none where the thrusters hold their force.

    """

    force: Float[np.ndarray, "3"]
    position: Float[np.ndarray, "3"]
    velocity: Float[np.ndarray, "3"]
    known_position: Float[np.ndarray, "3"]
    known_velocity: Float[np.ndarray, "3"]
    errors: Float[np.ndarray, "2"]
    control_status: int
    guard_status: int
    outliers: int
    contradicted: bool
    on_time: Float[np.ndarray, " thrusters"]


_FIXED = 5 * 3 + 2 + 4
"""Numbers in a `Known` before the on-times."""


class OnBoardNavigation:
    """A setup's navigation, law, guard and pulses, compiled, with their memory: call `step` once a control period.

    The first estimate must be within the bounds `setup.navigation.initial_errors` of the truth, as in a flight.
    Faults and disturbance of the setup are the world's and stay out of it. So are the true forces of thrusters that are
    not as they should be: on-times do not depend on them. See `OnBoard` for the shortest times.

    Attributes:
        one_kernel: whether the step is compiled in one piece (`keepout.compiled.one_kernel`).

    """

    def __init__(self, setup: FlightSetup, estimate: MotionState) -> None:
        """Compile the step, and begin at the first estimate.

        Raises:
            ControlError: a setup without navigation, or a memory that cannot be kept as numbers.

        """
        if setup.navigation is None:
            raise ControlError("on board: the setup has no navigation; fly it with OnBoard, which takes an estimate")
        keep_programs()
        self._lengths = tuple(jax.eval_shape(sensor.ideal, estimate).size for sensor in setup.navigation.suite.sensors)
        self._numbers = sum(self._lengths) + len(self._lengths)
        none = np.zeros(self._numbers)
        self._memory = jax.jit(lambda estimate, numbers: _memory(setup, estimate, _samples(numbers, self._lengths)))
        try:
            packed, unpack = ravel_pytree(self._memory(estimate, none))
        except TypeError as error:
            raise ControlError(f"on board: the memory must be arrays of numbers: {error}") from None
        self._size = len(packed)

        def step(whole: Float[Array, " n"], numbers: Float[Array, " m"]) -> Float[Array, " after"]:
            memory, given = _stepped(setup, unpack(whole[: self._size]), _samples(numbers, self._lengths))
            return jnp.concatenate([ravel_pytree(memory)[0], given])

        whole = jnp.zeros(self._size)
        given = jax.eval_shape(step, whole, none).size - self._size
        self._step, self.one_kernel = compiled(step, jnp.zeros(self._size + given), none)
        self._given = given
        self.restart(estimate)

    def restart(self, estimate: MotionState) -> None:
        """Forget what was learned in flight, and begin at an estimate."""
        self._estimate: MotionState | None = estimate
        self._latest = np.zeros(self._size + self._given)

    def step(self, samples: Sequence[Value | None]) -> Float[np.ndarray, "3"]:
        """Return the force to hold over the coming period, N, body axes.

        Args:
            samples: of each sensor of the suite, in its order: what arrived now, or None where nothing did.

        Raises:
            ControlError: too few or too many samples or numbers. Those that are not finite are the estimates' to
                leave out.

        """
        if len(samples) != len(self._lengths):
            raise ControlError(f"on board: {len(samples)} samples; the suite has {len(self._lengths)} sensors")
        numbers, first = np.zeros(self._numbers), 0
        for number, (value, length) in enumerate(zip(samples, self._lengths, strict=True)):
            if value is not None:
                if len(value) != length:
                    raise ControlError(f"on board: sample {number} has {len(value)} numbers; it must have {length}")
                numbers[first] = 1.0
                numbers[first + 1 : first + 1 + length] = value
            first += 1 + length
        if self._estimate is not None:
            # As in a flight, law and guard start from what the first samples leave to know.
            packed = ravel_pytree(self._memory(self._estimate, numbers))[0]
            self._whole, self._estimate = jnp.concatenate([packed, jnp.zeros(self._given)]), None
        self._whole = self._step(self._whole, numbers)
        self._latest = np.asarray(self._whole)
        return self._latest[self._size : self._size + 3]

    @property
    def known(self) -> Known:
        """All that the last step gave; zeros before the first."""
        given = self._latest[self._size :]
        control, guard, outliers, contradicted = given[17:_FIXED].tolist()
        force, position, velocity, known_position, known_velocity = given[:15].reshape(5, 3)
        return Known(
            force,
            position,
            velocity,
            known_position,
            known_velocity,
            given[15:17],
            int(control),
            int(guard),
            int(outliers),
            bool(contradicted),
            given[_FIXED:],
        )


def _samples(numbers: Float[Array, " m"], lengths: tuple[int, ...]) -> tuple[Sample, ...]:
    """Take samples out of an array: of each sensor whether one came, 1 or 0, and its numbers."""
    samples, first = [], 0
    for length in lengths:
        samples.append(Sample(numbers[first + 1 : first + 1 + length], numbers[first] > 0.5))
        first += 1 + length
    return tuple(samples)


def _memory(setup: FlightSetup, estimate: MotionState, samples: tuple[Sample, ...]) -> _Memory:
    """Give what is remembered before the first step, whose samples are known already."""
    assert setup.navigation is not None
    knowing = setup.navigation.begin(estimate)
    knowledge = setup.navigation.know(knowing, samples)[1]
    law, guard = loop.memories(setup, knowledge.estimate, knowledge.known.state)
    return knowing, law, guard, setup.thrusters.initial_state(jax.random.key(0))


def _stepped(
    setup: FlightSetup, memory: _Memory, samples: tuple[Sample, ...]
) -> tuple[_Memory, Float[Array, " given"]]:
    """Run the on-board part of a step; give the new memory, and the numbers of a `Known`."""
    assert setup.navigation is not None
    knowing, law, guard, thrusters = memory
    knowing, knowledge = setup.navigation.know(knowing, samples)
    estimate, known = knowledge.estimate, knowledge.known
    law, guard, order, force, status = loop.command(setup, law, guard, estimate, known)
    knowing = setup.navigation.told(knowing, force)
    thrusters, firing = setup.thrusters.fire(thrusters, force)
    vectors = (force, estimate.position, estimate.velocity, known.state.position, known.state.velocity)
    rest = (known.errors[0], known.errors[1], order.status, status, knowledge.outliers, known.contradicted)
    numbers = jnp.stack([jnp.asarray(number, jnp.float64) for number in rest])
    on_time = () if firing.on_time is None else (firing.on_time,)
    return (knowing, law, guard, thrusters), jnp.concatenate([*vectors, numbers, *on_time])
