"""Law and guard of one chaser in real time: numbers of the estimate in, a force out.

The compiled step is `loop.command`, the one that flies in single flights and campaigns. What is carried from step to
step is one array of numbers inside: passing trees of arrays through Python would take longer than the step itself.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from keepout.core.compiled.kept_programs import keep_programs
from keepout.core.compiled.one_kernel import compiled
from keepout.core.errors import ControlError
from keepout.core.flight import loop
from keepout.core.flight.setup import FlightSetup
from keepout.core.motion.relative import MotionState

Numbers = Float[np.ndarray, "_"] | Array | Sequence[float]
"""One number a component, SI units."""
Forces = Sequence[Numbers] | Float[np.ndarray, "_ _"]
"""Three numbers each, N, body axes, the oldest first."""


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


_WIDTH = 5 * 3 + 3 + 2
"""Numbers in an `Order`."""


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
        return np.concatenate([self.sent[missed:], np.zeros((missed, 3))])

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

    Law and guard begin with the first step, from the state that it tells. From then on the time told must be that of
    the last step plus a period: the guard's numbers are those of exact periods. Where a clock jitters, tell the state
    of the nominal time.

    Faults, disturbance and thrusters of the setup are the world's and stay out of it; a force beyond the thrusters'
    limits is the law's to avoid, and the guard's to cut.

    For the shortest times start JAX with `jax.config.update("jax_cpu_enable_async_dispatch", False)`: handing over to
    another thread is most of the tail.

    Attributes:
        one_kernel: whether the step is compiled in one piece (`compiled/one_kernel.py`): several times faster, not
            otherwise different.

    """

    def __init__(self, setup: FlightSetup, estimate: MotionState, on_gap: str = "refuse") -> None:
        """Compile the step.

        Args:
            setup: of a flight.
            estimate: of the motion now. A first step that tells no finite state begins from it, if it is of that time.
            on_gap: what a step does at another time than the last one plus a period: "refuse" raises an error, "begin
                anew" begins law and guard from the state that it tells. Where commands take effect late an earlier time
                is refused all the same, and so is one between two control steps: what is under way then is not known.

        Raises:
            ControlError: a law or guard whose memory cannot be kept as numbers (a random key, say), or another
                `on_gap`.

        """
        if on_gap not in ("refuse", "begin anew"):
            raise ControlError(f'on board: on_gap is {on_gap!r}; it must be "refuse" or "begin anew"')
        keep_programs()
        unpack_estimate = ravel_pytree(estimate)[1]
        self._clock, self._anew = Clock(float(setup.period)), on_gap == "begin anew"
        self._delay = 0 if setup.guard is None else setup.guard.delay
        self.restart(estimate)

        def memories(numbers: Float[Array, " m"], under_way: Float[Array, "steps 3"]):
            return loop.memories(setup, unpack_estimate(numbers), under_way=under_way)

        try:
            packed, unpack = ravel_pytree(jax.jit(memories)(self._numbers, self._clock.sent))
        except TypeError as error:
            raise ControlError(f"on board: the memory of law and guard must be arrays of numbers: {error}") from None
        self._size, self._places = len(packed), _places(estimate)

        def begin(numbers: Float[Array, " m"], under_way: Float[Array, "steps 3"]) -> Float[Array, " n"]:
            return jnp.concatenate([ravel_pytree(memories(numbers, under_way))[0], jnp.zeros(_WIDTH)])

        def step(whole: Float[Array, " n"], numbers: Float[Array, " m"]) -> Float[Array, " n"]:
            law, guard = unpack(whole[: self._size])
            law, guard, order, force, status = loop.command(setup, law, guard, unpack_estimate(numbers))
            vectors = (force, order.force, order.desired_velocity, order.safe_velocity, order.disturbance_estimate)
            rest = (order.barrier, order.backstepping_barrier, order.lyapunov, order.status, status)
            given = [*vectors, jnp.stack([jnp.asarray(number, jnp.float64) for number in rest])]
            return jnp.concatenate([ravel_pytree((law, guard))[0], *given])

        self._begin = jax.jit(begin).lower(self._numbers, self._clock.sent).compile()
        self._whole = jnp.concatenate([packed, jnp.zeros(_WIDTH)])
        self._latest = np.asarray(self._whole)
        self._step, self.one_kernel = compiled(step, self._whole, self._numbers)

    def restart(self, estimate: MotionState, under_way: Forces | None = None) -> None:
        """Forget what was learned in flight: law and guard begin with the next step, from the state that it tells.

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
        position: Numbers,
        velocity: Numbers,
        attitude: Numbers | None = None,
        angular_velocity: Numbers | None = None,
        target_orbit: Numbers | None = None,
    ) -> Float[np.ndarray, "3"]:
        """Return the force to hold over the coming period, N, body axes.

        Args:
            time: s since the orbit's epoch.
            position: (3,) m, of the chaser relative to the target, body axes.
            velocity: (3,) m/s, likewise.
            attitude: (4,) body ← VVLH, scalar first; as it was in the last step if left out.
            angular_velocity: (3,) rad/s, of the body, body axes; likewise.
            target_orbit: (6,) ECI position (m) and velocity (m/s), where the setup's motion carries it; likewise.

        Raises:
            ControlError: too few or too many numbers (those that are not finite are law's and guard's to answer), a
                time that is not due, or a first step that tells nothing to begin with. Nothing has changed then.

        """
        numbers = self._numbers.copy()
        numbers[0] = time
        self._put(numbers, "position", position)
        self._put(numbers, "velocity", velocity)
        if attitude is not None:
            self._put(numbers, "attitude", attitude)
        if angular_velocity is not None:
            self._put(numbers, "angular_velocity", angular_velocity)
        if target_orbit is not None:
            self._put(numbers, "target_orbit", target_orbit)
        due = self._clock.due
        goes_on = self._begun and due is not None and self._clock.holds(time, due)
        refused = (self._begun and not self._anew) or not self._clock.tells(time, self._delay)
        if not goes_on and due is not None and refused:
            raise ControlError(
                f"on board: told the time {time:.9g} s; {due:.9g} s is due, a period of {self._clock.period:g} s after "
                "the last step. Call restart with the state now and the commands under way"
                + ("" if self._anew else ', or build it with on_gap="begin anew"')
            )
        whole = self._whole if goes_on else self._memories(time, numbers)
        self._numbers, self._begun = numbers, True
        self._whole = self._step(whole, numbers)
        self._latest = np.asarray(self._whole)
        force = self._latest[self._size : self._size + 3]
        self._clock.stepped(time, force)
        return force

    def _memories(self, time: float, numbers: Float[np.ndarray, " m"]) -> Array:
        """Begin law and guard from what is told, or, where that is no state, from the estimate of this time."""
        told = math.isfinite(time) and np.isfinite(numbers).all()
        if not told:
            if not (math.isfinite(time) and self._clock.holds(time, self._numbers[0])):
                raise ControlError(
                    f"on board: the step at {time:g} s tells no finite state to begin with, and the last one known is "
                    f"of {self._numbers[0]:g} s"
                )
            numbers = self._numbers
        return self._begin(numbers, self._clock.under_way(time))

    def _put(self, numbers: Float[np.ndarray, " m"], name: str, value: Numbers) -> None:
        if name not in self._places:
            raise ControlError(f"on board: {name} is given, but the setup's motion does not carry it")
        place, needed = self._places[name]
        if len(value) != needed:
            raise ControlError(f"on board: {name} has {len(value)} numbers; it must have {needed}")
        numbers[place] = value

    @property
    def order(self) -> Order:
        """All that the last step gave; zeros before the first."""
        given = self._latest[self._size :]
        force, commanded, desired, safe, disturbance = given[:15].reshape(5, 3)
        barrier, backstepping, lyapunov, control, guard = given[15:].tolist()
        return Order(
            force, commanded, desired, safe, disturbance, barrier, backstepping, lyapunov, int(control), int(guard)
        )


def _places(estimate: MotionState) -> dict[str, tuple[slice, int]]:
    """Where each part of an estimate lies among its numbers, and how many it has."""
    places, first = {}, 0
    for name, part in vars(estimate).items():
        if part is not None:
            places[name] = (slice(first, first + np.size(part)), np.size(part))
            first += np.size(part)
    return places
