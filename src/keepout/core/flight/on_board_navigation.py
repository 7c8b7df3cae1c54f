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

from keepout.core.compiled.kept_programs import keep_programs
from keepout.core.compiled.one_kernel import compiled
from keepout.core.errors import ControlError
from keepout.core.flight import loop
from keepout.core.flight.navigation import Sample
from keepout.core.flight.on_board import Clock, Forces, as_under_way
from keepout.core.flight.setup import FlightSetup
from keepout.core.motion.relative import MotionState

Taken = tuple[float, Float[np.ndarray, "_"] | Array | Sequence[float]]
"""When a sample was taken, s since the orbit's epoch, and what: one number a component, in its sensor's units."""

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
        not_due: samples left out as they were not taken when this step's are.
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
    not_due: int
    on_time: Float[np.ndarray, " thrusters"]


_FIXED = 5 * 3 + 2 + 4
"""Numbers in a `Known` before the on-times."""


class OnBoardNavigation:
    """A setup's navigation, law, guard and pulses, compiled, with their memory: call `step` once a control period.

    The first estimate must be within the bounds `setup.navigation.initial_errors` of the truth at the first step, as in
    a flight; so the first step must be at the estimate's time, and every other one a period after the last.
    Faults and disturbance of the setup are the world's and stay out of it. So are the true forces of thrusters that are
    not as they should be: on-times do not depend on them. See `OnBoard` for the shortest times.

    Attributes:
        one_kernel: whether the step is compiled in one piece (`keepout.core.compiled.one_kernel`).

    """

    def __init__(self, setup: FlightSetup, estimate: MotionState) -> None:
        """Compile the step, and begin at the first estimate.

        Raises:
            ControlError: a setup without navigation, or a memory that cannot be kept as numbers.

        """
        if setup.navigation is None:
            raise ControlError("on board: the setup has no navigation; fly it with OnBoard, which takes an estimate")
        keep_programs()
        self._clock, sensors = Clock(float(setup.period)), setup.navigation.suite.sensors
        self._late = [sensor.latency * self._clock.period for sensor in sensors]
        self._lengths = tuple(jax.eval_shape(sensor.ideal, estimate).size for sensor in sensors)
        self._numbers = sum(self._lengths) + len(self._lengths)
        none = np.zeros(self._numbers)
        self._memory = jax.jit(
            lambda estimate, numbers, under_way: _memory(setup, estimate, _samples(numbers, self._lengths), under_way)
        )
        try:
            packed, unpack = ravel_pytree(self._memory(estimate, none, self._clock.sent))
        except TypeError as error:
            raise ControlError(f"on board: the memory must be arrays of numbers: {error}") from None
        self._size = len(packed)

        def step(whole: Float[Array, " n"], numbers: Float[Array, " m"]) -> Float[Array, " after"]:
            memory, given = _stepped(setup, unpack(whole[: self._size]), _samples(numbers, self._lengths))
            return jnp.concatenate([ravel_pytree(memory)[0], given])

        whole = jnp.zeros(self._size)
        given = jax.eval_shape(step, whole, none).size - self._size
        self._step, self.one_kernel = compiled(step, jnp.zeros(self._size + given), none)
        self._given, self._whole = given, jnp.zeros(self._size + given)
        self.restart(estimate)

    def restart(self, estimate: MotionState, under_way: Forces | None = None) -> None:
        """Forget what was learned in flight, and begin at an estimate of the next step's state.

        Args:
            estimate: of the motion, at the time of the next step.
            under_way: forces commanded that have not taken effect then, N, body axes, the oldest first. Left out, they
                are those that the last steps gave, with none in the periods since.

        Raises:
            ControlError: `under_way` of another shape.

        """
        if under_way is not None:
            self._clock.sent, self._clock.due = as_under_way(under_way), None
        self._estimate: MotionState | None = estimate
        self._latest, self._not_due = np.zeros(self._size + self._given), 0

    def step(self, time: float, samples: Sequence[Taken | None]) -> Float[np.ndarray, "3"]:
        """Return the force to hold over the coming period, N, body axes.

        Args:
            time: s since the orbit's epoch.
            samples: of each sensor of the suite, in its order: when it was taken and what arrived now, or None where
                nothing did. One that was not taken a sensor's latency ago (told twice, early, late) is left out, and
                `known.not_due` counts it.

        Raises:
            ControlError: too few or too many samples or numbers (those that are not finite are the estimates' to leave
                out), or a time that is not due. Nothing has changed then.

        """
        anew = self._estimate is not None
        due = float(self._estimate.time) if self._estimate is not None else self._clock.due
        if due is None or not self._clock.holds(time, due):
            raise ControlError(
                f"on board: told the time {time:.9g} s; {due:.9g} s is due, "
                + ("when the estimate to begin with was made" if anew else "a period after the last step")
                + ". Call restart with an estimate of the state now"
            )
        numbers, not_due = self._numbers_of(time, samples)
        whole = self._whole
        if self._estimate is not None:
            # As in a flight, law and guard start from what the first samples leave to know.
            packed = ravel_pytree(self._memory(self._estimate, numbers, self._clock.under_way(time)))[0]
            whole = jnp.concatenate([packed, jnp.zeros(self._given)])
        self._whole, self._estimate, self._not_due = self._step(whole, numbers), None, not_due
        self._latest = np.asarray(self._whole)
        force = self._latest[self._size : self._size + 3]
        self._clock.stepped(time, force)
        return force

    def _numbers_of(self, time: float, samples: Sequence[Taken | None]) -> tuple[Float[np.ndarray, " m"], int]:
        """Put samples into one array, and count those that are left out."""
        if len(samples) != len(self._lengths):
            raise ControlError(f"on board: {len(samples)} samples; the suite has {len(self._lengths)} sensors")
        numbers, first, not_due = np.zeros(self._numbers), 0, 0
        for number, (sample, length, late) in enumerate(zip(samples, self._lengths, self._late, strict=True)):
            if sample is not None:
                if len(sample) != 2 or np.ndim(sample[0]) != 0:
                    raise ControlError(f"on board: sample {number} must be when it was taken, s, and its numbers")
                taken, value = sample
                if len(value) != length:
                    raise ControlError(f"on board: sample {number} has {len(value)} numbers; it must have {length}")
                if self._clock.holds(taken, time - late):
                    numbers[first] = 1.0
                    numbers[first + 1 : first + 1 + length] = value
                else:
                    not_due += 1
            first += 1 + length
        return numbers, not_due

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
            self._not_due,
            given[_FIXED:],
        )


def _samples(numbers: Float[Array, " m"], lengths: tuple[int, ...]) -> tuple[Sample, ...]:
    """Take samples out of an array: of each sensor whether one came, 1 or 0, and its numbers."""
    samples, first = [], 0
    for length in lengths:
        samples.append(Sample(numbers[first + 1 : first + 1 + length], numbers[first] > 0.5))
        first += 1 + length
    return tuple(samples)


def _memory(
    setup: FlightSetup, estimate: MotionState, samples: tuple[Sample, ...], under_way: Float[Array, "steps 3"]
) -> _Memory:
    """Give what is remembered before the first step, whose samples are known already."""
    assert setup.navigation is not None
    knowing = setup.navigation.begin(estimate, under_way)
    knowledge = setup.navigation.know(knowing, samples)[1]
    law, guard = loop.memories(setup, knowledge.estimate, knowledge.known.state, under_way)
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
