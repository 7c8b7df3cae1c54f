"""What steers one chaser in real time: numbers of the estimate, or samples of its sensors, in; a force out.

The compiled step is what the flight loop does on board: `loop.command`, and with sensors `Navigation.know` before it,
`Navigation.told` and the thrusters' `fire` after it. What is carried from step to step is one array of numbers inside:
passing trees of arrays through Python would take longer than the step itself.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import jaxpr_as_fun
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int, PyTree

from keepout.core.compiled.kept_programs import keep_programs
from keepout.core.control.law import Command
from keepout.core.errors import ControlError
from keepout.core.flight import loop
from keepout.core.flight.navigation import Sample
from keepout.core.flight.setup import FlightSetup
from keepout.core.motion.arrays import Vector
from keepout.core.motion.relative import MotionState
from keepout.flights.one_kernel import compiled

Numbers = Float[np.ndarray, "_"] | Array | Sequence[float]
"""One number a component, SI units."""
Forces = Sequence[Numbers] | Float[np.ndarray, "_ _"]
"""Three numbers each, N, body axes, the oldest first."""
Taken = tuple[float, Numbers]
"""When a sample was taken, s since the orbit's epoch, and what: one number a component, in its sensor's units."""


class Order(NamedTuple):
    """What the last step gave, beside the force: SI units, body axes; see `Command` and `Guard.filter`."""

    force: Float[np.ndarray, "3"]
    commanded_force: Float[np.ndarray, "3"]
    desired_velocity: Float[np.ndarray, "3"]
    safe_velocity: Float[np.ndarray, "3"]
    disturbance_estimate: Float[np.ndarray, "3"]
    barrier: float
    backstepping_barrier: float
    lyapunov: float
    control_status: int
    guard_status: int


_ORDER = 5 * 3 + 3 + 2
"""Numbers in an `Order`."""


class Known(NamedTuple):
    """What the last step knew by its samples: SI units, body axes.

    Attributes:
        position: the law's estimate, m.
        velocity: likewise, m/s.
        known_position: centre of the guard's set, m.
        known_velocity: likewise, m/s.
        errors: the set's radii, m and m/s.
        outliers: samples that the law's estimate left out.
        contradicted: whether the samples cannot all be within their bounds.
        not_due: samples left out as they were not taken when this step's are.
        on_time: of each thruster over the coming period, s; none where the thrusters hold their force.

    """

    position: Float[np.ndarray, "3"]
    velocity: Float[np.ndarray, "3"]
    known_position: Float[np.ndarray, "3"]
    known_velocity: Float[np.ndarray, "3"]
    errors: Float[np.ndarray, "2"]
    outliers: int
    contradicted: bool
    not_due: int
    on_time: Float[np.ndarray, " thrusters"]


_KNOWN = 4 * 3 + 4
"""Numbers in a `Known` before the on-times."""

_LONGEST_DELAY = 8
"""Commands that may be under way: the guard's theorem and the law's model allow no more."""


class Clock:
    """The time at which the next step is due, and the forces that may not have taken effect by then.

    Attributes:
        period: control period, s.
        due: time of the next step, s; None before the first.
        sent: the last forces given, N, body axes, the oldest first; zero where none was.

    """

    def __init__(self, period: float) -> None:
        self.period, self.due, self.sent = float(period), None, np.zeros((_LONGEST_DELAY, 3))

    def holds(self, time: float, expected: float) -> bool:
        """Whether a time told is the one expected: within a millionth of a period, and what rounding leaves of it."""
        return bool(abs(time - expected) <= 1e-6 * self.period + 1e-15 * abs(expected))

    def tells(self, time: float, delay: int) -> bool:
        """Whether it can be said what is under way at `time`, where commands take `delay` periods to take effect.

        Not before the time that is due, since some were given later; nor between two control steps while one of those
        given acts: the last does until `delay` periods after the time that is due.
        """
        if delay == 0 or self.due is None or self.holds(time, self.due):
            return True
        after = (time - self.due) / self.period
        return after > 0.0 and (after >= delay or self.holds(time, self.due + round(after) * self.period))

    def under_way(self, time: float) -> Float[np.ndarray, "steps 3"]:
        """Give the forces that may be under way at `time`, N: none was commanded in the periods without a step."""
        missed = 0 if self.due is None else min(max(round((time - self.due) / self.period), 0), len(self.sent))
        return np.concatenate([self.sent[missed:], np.zeros((missed, 3))]) if missed else self.sent

    def stepped(self, time: float, force: Float[np.ndarray, "3"]) -> None:
        """Take down that a force (N) was given at `time`."""
        self.sent = np.concatenate([self.under_way(time)[1:], force[None]])
        self.due = time + self.period


def as_under_way(forces: Forces) -> Float[np.ndarray, "steps 3"]:
    """Give forces (n, 3), N, the oldest first, as those of the last steps.

    Raises:
        ControlError: another shape, too many, or numbers that are not finite.

    """
    told = np.asarray(forces, dtype=np.float64) if len(forces) else np.zeros((0, 3))
    if told.ndim != 2 or told.shape[1] != 3 or len(told) > _LONGEST_DELAY or not np.isfinite(told).all():
        raise ControlError(
            f"on board: under_way has the shape {told.shape}; it must be at most {_LONGEST_DELAY} finite forces of "
            "3 numbers, N, the oldest first"
        )
    return np.concatenate([np.zeros((_LONGEST_DELAY - len(told), 3)), told])


class OnBoard:
    """A setup's law and guard, compiled, with their memory: call `step` once a control period.

    It is told the state, or, with `by_samples`, what the sensors of the setup's navigation say; then navigation and the
    thrusters' pulses are on board too.

    Told states, law and guard begin with the first step, from the state that it tells. From then on the time told must
    be that of the last step plus a period: the guard's numbers are those of exact periods. Where a clock jitters, tell
    the state of the nominal time. Told samples, the first estimate must be within the bounds
    `setup.navigation.initial_errors` of the truth at the first step, as in a flight; so the first step must be at the
    estimate's time.

    Faults, disturbance and thrusters of the setup are the world's and stay out of it (on-times do not depend on the
    true forces of thrusters that are not as they should be); a force beyond the thrusters' limits is the law's to
    avoid, and the guard's to cut.

    For the shortest times start JAX with `jax.config.update("jax_cpu_enable_async_dispatch", False)`: handing over to
    another thread is most of the tail.

    Attributes:
        one_kernel: whether the step is compiled in one piece (`flights/one_kernel.py`): several times faster, not
            otherwise different.

    """

    def __init__(
        self, setup: FlightSetup, estimate: MotionState, on_gap: str = "refuse", *, by_samples: bool = False
    ) -> None:
        """Compile the step.

        Args:
            setup: of a flight.
            estimate: of the motion now. A first step that tells no finite state begins from it, if it is of that time.
            on_gap: what a step does at another time than the last one plus a period: "refuse" raises an error, "begin
                anew" begins law and guard from the state that it tells. Where commands take effect late an earlier time
                is refused all the same, and so is one between two control steps: what is under way then is not known.
            by_samples: whether a step tells what the sensors say; then no other time than the one due is taken.

        Raises:
            ControlError: a law or guard whose memory cannot be kept as numbers (a random key, say), another `on_gap`,
                or samples for a setup without navigation.

        """
        if on_gap not in ("refuse", "begin anew"):
            raise ControlError(f'on board: on_gap is {on_gap!r}; it must be "refuse" or "begin anew"')
        keep_programs()
        self._clock, self._anew = Clock(float(setup.period)), on_gap == "begin anew" and not by_samples
        self._delay = 0 if setup.guard is None else setup.guard.delay
        told = _Samples(setup, estimate) if by_samples else _State(setup, estimate)
        self._told, self._not_due = told, 0
        self.restart(estimate)

        try:
            memory = self._memory = jax.eval_shape(told.memories, self._numbers, told.none, self._clock.sent)
            packed, self._unpack = ravel_pytree(jax.tree.map(lambda of: np.zeros(of.shape, of.dtype), memory))
        except TypeError as error:
            raise ControlError(f"on board: the memory of law and guard must be arrays of numbers: {error}") from None
        size = self._size = len(packed)
        self._estimate = estimate
        # Traced once, and compiled from that below: how much a step gives is known only by then.
        traced, after = jax.make_jaxpr(self._stepped_by(told), return_shape=True)(packed, told.none)
        given = after.size - size

        def begin(
            estimate: Float[Array, " m"], numbers: Float[Array, " k"], under_way: Float[Array, "steps 3"]
        ) -> Float[Array, " n"]:
            return jnp.concatenate([ravel_pytree(told.memories(estimate, numbers, under_way))[0], jnp.zeros(given)])

        self._begin = jax.jit(begin).lower(self._numbers, told.none, self._clock.sent).compile()
        self._whole = jnp.zeros(size + given)  # what is remembered is written by the first step
        self._latest = np.asarray(self._whole)
        self._step, self.one_kernel = compiled(
            lambda whole, numbers: jaxpr_as_fun(traced)(whole[:size], numbers)[0], self._whole, told.none
        )

    def ready(self, setup: FlightSetup) -> Callable[[], None]:
        """Compile the step of another setup, and give what lets it lead from the next step on, at once.

        Law and guard go on with what they remember, so the setups may differ in numbers only: what is right of segments
        (`loop.fly_segment`) is right here. A word that is said in flight, as "go", is such another setup
        (`core.mission.approach.by_word`).

        Args:
            setup: the other one.

        Raises:
            ControlError: its memory has another structure.

        """
        told = type(self._told)(setup, self._estimate)
        memory = jax.eval_shape(told.memories, self._numbers, told.none, self._clock.sent)
        if memory != self._memory:
            raise ControlError("on board: the other setup's law and guard remember otherwise than those that lead now")
        step, _ = compiled(self._stepped_by(told), self._whole, told.none)

        def lead_on() -> None:
            self._told, self._step = told, step

        return lead_on

    def _stepped_by(self, told: "_State | _Samples") -> Callable[[Array, Array], Array]:
        size, unpack = self._size, self._unpack

        def step(whole: Float[Array, " n"], numbers: Float[Array, " m"]) -> Float[Array, " after"]:
            memory, given = told.step(unpack(whole[:size]), numbers)
            return jnp.concatenate([ravel_pytree(memory)[0], *given])

        return step

    def restart(self, estimate: MotionState, under_way: Forces | None = None) -> None:
        """Forget what was learned in flight: law and guard begin with the next step, from what it tells.

        Args:
            estimate: of the motion, as at the beginning.
            under_way: forces commanded that have not taken effect at the next step, N, body axes, the oldest first.
                Left out, they are those that the last steps gave, with none in the periods since.

        Raises:
            ControlError: `under_way` of another shape.

        """
        if under_way is not None:
            self._clock.sent, self._clock.due = as_under_way(under_way), None
        self._numbers = np.array(ravel_pytree(estimate)[0])
        self._begun = False

    def step(
        self,
        time: float,
        position: Numbers | None = None,
        velocity: Numbers | None = None,
        attitude: Numbers | None = None,
        angular_velocity: Numbers | None = None,
        target_orbit: Numbers | None = None,
        *,
        samples: Sequence[Taken | None] | None = None,
    ) -> Float[np.ndarray, "3"]:
        """Return the force to hold over the coming period, N, body axes.

        Args:
            time: s since the orbit's epoch.
            position: (3,) m, of the chaser relative to the target, body axes.
            velocity: (3,) m/s, likewise.
            attitude: (4,) quaternion body ← VVLH, scalar first; as it was in the last step if left out.
            angular_velocity: (3,) rad/s, of the body, body axes; likewise.
            target_orbit: (6,) ECI position (m) and velocity (m/s), where the setup's motion carries it; likewise.
            samples: instead of all these, of each sensor of the suite, in its order: when it was taken and what arrived
                now, or None where nothing did. One that was not taken a sensor's latency ago (told twice, early, late)
                is left out, and `known.not_due` counts it.

        Raises:
            ControlError: too few or too many numbers or samples (numbers that are not finite are law's, guard's and
                estimates' to answer), a time that is not due, or a first step that tells nothing to begin with. Nothing
                has changed then.

        """
        told = self._told
        if isinstance(told, _Samples):
            if samples is None or position is not None or velocity is not None:
                raise ControlError("on board: it was built with by_samples; tell it samples, and no state")
            numbers, not_due = told.numbers(self._clock, time, samples)
            estimate = self._numbers
        else:
            if samples is not None or position is None or velocity is None:
                raise ControlError("on board: it was built without by_samples; tell it position and velocity")
            parts = {"position": position, "velocity": velocity, "attitude": attitude}
            parts |= {"angular_velocity": angular_velocity, "target_orbit": target_orbit}
            numbers, not_due = told.numbers(self._numbers, time, parts), 0
            estimate = numbers
        goes_on = self._goes_on(time)
        whole = self._whole
        if not goes_on:
            begun_with = self._begun_with(time, estimate)
            whole = self._begin(begun_with, numbers, self._clock.under_way(time))
        self._numbers, self._begun, self._not_due = estimate, True, not_due
        self._whole = self._step(whole, numbers)
        self._latest = np.asarray(self._whole)
        force = self._latest[self._size : self._size + 3]
        self._clock.stepped(time, force)
        return force

    def _goes_on(self, time: float) -> bool:
        """Whether a step goes on with what is remembered; refuse a time at which nothing can begin either."""
        clock, due = self._clock, self._clock.due
        if isinstance(self._told, _Samples):
            due = clock.due if self._begun else float(self._numbers[0])
            if due is not None and clock.holds(time, due):
                return self._begun
            since = "a period after the last step" if self._begun else "when the estimate to begin with was made"
            raise ControlError(
                f"on board: told the time {time:.9g} s; {due:.9g} s is due, {since}. Call restart with an estimate of "
                "the state now"
            )
        if self._begun and due is not None and clock.holds(time, due):
            return True
        if due is not None and ((self._begun and not self._anew) or not clock.tells(time, self._delay)):
            raise ControlError(
                f"on board: told the time {time:.9g} s; {due:.9g} s is due, a period of {clock.period:g} s after "
                "the last step. Call restart with the state now and the commands under way"
                + ("" if self._anew else ', or build it with on_gap="begin anew"')
            )
        return False

    def _begun_with(self, time: float, told: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
        """Give the numbers of what is told, or, where that is no state, of the estimate of this time."""
        if math.isfinite(time) and np.isfinite(told).all():
            return told
        if not (math.isfinite(time) and self._clock.holds(time, self._numbers[0])):
            raise ControlError(
                f"on board: the step at {time:g} s tells no finite state to begin with, and the last one known is "
                f"of {self._numbers[0]:g} s"
            )
        return self._numbers

    @property
    def order(self) -> Order:
        """All that law and guard gave in the last step; zeros before the first."""
        given = self._latest[self._size : self._size + _ORDER]
        *numbers, control, guard = given[15:].tolist()
        return Order._make((*given[:15].reshape(5, 3), *numbers, int(control), int(guard)))

    @property
    def known(self) -> Known:
        """What the last step knew by its samples; zeros before the first.

        Raises:
            ControlError: it is told states.

        """
        if not isinstance(self._told, _Samples):
            raise ControlError("on board: it was built without by_samples; what is known is the state that it is told")
        given = self._latest[self._size + _ORDER :]
        outliers, contradicted = given[14:_KNOWN].tolist()
        vectors = given[:12].reshape(4, 3)
        rest = given[12:14], int(outliers), bool(contradicted), self._not_due, given[_KNOWN:]
        return Known._make((*vectors, *rest))


class _State:
    """What an `OnBoard` does that is told the state: its numbers are those of a `MotionState`."""

    def __init__(self, setup: FlightSetup, estimate: MotionState) -> None:
        self.setup = setup
        numbers, self._unpack = ravel_pytree(estimate)
        self.none, self._places, first = np.zeros(len(numbers)), {}, 0
        for name, part in vars(estimate).items():
            if part is not None:
                self._places[name] = slice(first, first + np.size(part))
                first += np.size(part)

    def numbers(
        self, before: Float[np.ndarray, " m"], time: float, parts: dict[str, Numbers | None]
    ) -> Float[np.ndarray, " m"]:
        """Put what is told into one array; what is left out is as before."""
        numbers = before.copy()
        numbers[0] = time
        for name, value in parts.items():
            if value is None:
                continue
            if name not in self._places:
                raise ControlError(f"on board: {name} is given, but the setup's motion does not carry it")
            place = self._places[name]
            needed = place.stop - place.start
            if len(value) != needed:
                raise ControlError(f"on board: {name} has {len(value)} numbers; it must have {needed}")
            numbers[place] = value
        return numbers

    def memories(
        self, estimate: Float[Array, " m"], numbers: Float[Array, " m"], under_way: Float[Array, "steps 3"]
    ) -> PyTree:
        """Give what law and guard remember before the first step."""
        return loop.memories(self.setup, self._unpack(estimate), under_way=under_way)

    def step(self, memory: PyTree, numbers: Float[Array, " m"]) -> tuple[PyTree, list[Array]]:
        """Run the on-board part of a step; give the new memory, and the numbers of an `Order`."""
        law, guard = memory
        law, guard, order, force, status = loop.command(self.setup, law, guard, self._unpack(numbers))
        return (law, guard), _of_order(order, force, status)


class _Samples:
    """What an `OnBoard` does that is told samples: of each sensor whether one came, 1 or 0, and its numbers."""

    def __init__(self, setup: FlightSetup, estimate: MotionState) -> None:
        if setup.navigation is None:
            raise ControlError("on board: the setup has no navigation; build it without by_samples, and tell it states")
        self.setup, self._navigation = setup, setup.navigation
        sensors = setup.navigation.suite.sensors
        self._late = [sensor.latency * float(setup.period) for sensor in sensors]
        self._lengths = tuple(jax.eval_shape(sensor.ideal, estimate).size for sensor in sensors)
        self._unpack = ravel_pytree(estimate)[1]
        self.none = np.zeros(sum(self._lengths) + len(self._lengths))

    def numbers(
        self, clock: Clock, time: float, samples: Sequence[Taken | None]
    ) -> tuple[Float[np.ndarray, " m"], int]:
        """Put samples into one array, and count those that are left out."""
        if len(samples) != len(self._lengths):
            raise ControlError(f"on board: {len(samples)} samples; the suite has {len(self._lengths)} sensors")
        numbers, first, not_due = self.none.copy(), 0, 0
        for number, (sample, length, late) in enumerate(zip(samples, self._lengths, self._late, strict=True)):
            if sample is not None:
                if len(sample) != 2 or np.ndim(sample[0]) != 0:
                    raise ControlError(f"on board: sample {number} must be when it was taken, s, and its numbers")
                taken, value = sample
                if len(value) != length:
                    raise ControlError(f"on board: sample {number} has {len(value)} numbers; it must have {length}")
                if clock.holds(taken, time - late):
                    numbers[first] = 1.0
                    numbers[first + 1 : first + 1 + length] = value
                else:
                    not_due += 1
            first += 1 + length
        return numbers, not_due

    def _samples(self, numbers: Float[Array, " m"]) -> tuple[Sample, ...]:
        samples, first = [], 0
        for length in self._lengths:
            samples.append(Sample(numbers[first + 1 : first + 1 + length], numbers[first] > 0.5))
            first += 1 + length
        return tuple(samples)

    def memories(
        self, estimate: Float[Array, " k"], numbers: Float[Array, " m"], under_way: Float[Array, "steps 3"]
    ) -> PyTree:
        """Give what is remembered before the first step; as in a flight, law and guard know its samples already."""
        knowing = self._navigation.begin(self._unpack(estimate), under_way)
        knowledge = self._navigation.know(knowing, self._samples(numbers))[1]
        law, guard = loop.memories(self.setup, knowledge.estimate, knowledge.known.state, under_way)
        return knowing, law, guard, self.setup.thrusters.initial_state(jax.random.key(0))

    def step(self, memory: PyTree, numbers: Float[Array, " m"]) -> tuple[PyTree, list[Array]]:
        """Run the on-board part of a step; give the new memory, and the numbers of an `Order` and of a `Known`."""
        knowing, law, guard, thrusters = memory
        knowing, knowledge = self._navigation.know(knowing, self._samples(numbers))
        estimate, known = knowledge.estimate, knowledge.known
        law, guard, order, force, status = loop.command(self.setup, law, guard, estimate, known)
        knowing = self._navigation.told(knowing, force)
        thrusters, firing = self.setup.thrusters.fire(thrusters, force)
        vectors = (estimate.position, estimate.velocity, known.state.position, known.state.velocity, known.errors)
        found = _stacked(knowledge.outliers, known.contradicted)
        on_time = () if firing.on_time is None else (firing.on_time,)
        return (knowing, law, guard, thrusters), [*_of_order(order, force, status), *vectors, found, *on_time]


def _of_order(order: Command, force: Vector, status: Int[Array, ""]) -> list[Array]:
    vectors = (force, order.force, order.desired_velocity, order.safe_velocity, order.disturbance_estimate)
    return [*vectors, _stacked(order.barrier, order.backstepping_barrier, order.lyapunov, order.status, status)]


def _stacked(*numbers: Any) -> Float[Array, " numbers"]:
    return jnp.stack([jnp.asarray(number, jnp.float64) for number in numbers])
