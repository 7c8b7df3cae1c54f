"""Law and guard of one chaser in real time: numbers of the estimate in, a force out.

The compiled step is `loop.command`, the one that flies in single flights and campaigns. What is carried from step to
step is one array of numbers inside: passing trees of arrays through Python would take longer than the step itself.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from keepout.compiled.kept_programs import keep_programs
from keepout.compiled.one_kernel import compiled
from keepout.errors import ControlError
from keepout.flight import loop
from keepout.flight.setup import FlightSetup
from keepout.motion.relative import MotionState

Numbers = Float[np.ndarray, "_"] | Array | Sequence[float]
"""One number a component, SI units."""


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


class OnBoard:
    """A setup's law and guard, compiled, with their memory: call `step` once a control period.

    Faults, disturbance and thrusters of the setup are the world's and stay out of it; a force beyond the thrusters'
    limits is the law's to avoid, and the guard's to cut.

    For the shortest times start JAX with `jax.config.update("jax_cpu_enable_async_dispatch", False)`: handing over to
    another thread is most of the tail.

    Attributes:
        one_kernel: whether the step is compiled in one piece (`keepout.compiled.one_kernel`): several times faster, not
            otherwise different.

    """

    def __init__(self, setup: FlightSetup, estimate: MotionState) -> None:
        """Compile the step, and start law and guard from an estimate.

        Raises:
            ControlError: a law or guard whose memory cannot be kept as numbers (a random key, say).

        """
        keep_programs()
        try:
            packed, unpack = ravel_pytree(loop.memories(setup, estimate))
        except TypeError as error:
            raise ControlError(f"on board: the memory of law and guard must be arrays of numbers: {error}") from None
        size, unpack_estimate = len(packed), ravel_pytree(estimate)[1]

        def step(whole: Float[Array, " n"], numbers: Float[Array, " m"]) -> Float[Array, " n"]:
            law, guard = unpack(whole[:size])
            law, guard, order, force, status = loop.command(setup, law, guard, unpack_estimate(numbers))
            vectors = (force, order.force, order.desired_velocity, order.safe_velocity, order.disturbance_estimate)
            rest = (order.barrier, order.backstepping_barrier, order.lyapunov, order.status, status)
            given = [*vectors, jnp.stack([jnp.asarray(number, jnp.float64) for number in rest])]
            return jnp.concatenate([ravel_pytree((law, guard))[0], *given])

        self._setup, self._size, self._places = setup, size, _places(estimate)
        self.restart(estimate)
        self._step, self.one_kernel = compiled(step, self._whole, self._numbers)

    def restart(self, estimate: MotionState) -> None:
        """Forget what was learned in flight, and start law and guard from an estimate."""
        self._numbers = np.array(ravel_pytree(estimate)[0])
        packed = ravel_pytree(loop.memories(self._setup, estimate))[0]
        self._whole = jnp.concatenate([packed, jnp.zeros(_WIDTH)])
        self._latest = np.asarray(self._whole)

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
            ControlError: too few or too many numbers. Those that are not finite are law's and guard's to answer.

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
        self._numbers = numbers
        self._whole = self._step(self._whole, numbers)
        self._latest = np.asarray(self._whole)
        return self._latest[self._size : self._size + 3]

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
