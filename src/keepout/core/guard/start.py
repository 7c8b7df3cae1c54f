"""From which states a guarded flight may start: some are refused, and from some of the others the theorem holds."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from keepout.core.compiled.kept_executables import kept_jit
from keepout.core.errors import ControlError
from keepout.core.guard.guard import Guard
from keepout.core.motion.arrays import Flag, Scalar, Vector, as_float64, numbers_as_arrays
from keepout.core.motion.relative import MotionState

_ROOM = 256
"""States handed to a compiled program at once where many starts are looked at; fewer cost no more than they are."""


def require_flyable(guard: Guard, start: MotionState, goal: Vector, arrival: float = 0.0) -> bool:
    """Refuse what cannot be flown; return `Guard.certified_start` of the true start. Needs concrete values.

    A start that is not certified is flown; where its estimate is not either, in mode `ESCAPING` until a plan is.

    Args:
        guard: of the flight.
        start: the true state.
        goal: (3,) m, body frame.
        arrival: the earliest time, s, at which the chaser can be there.

    Raises:
        ControlError: a start that is not finite, beyond the range limit or at or below the field's zero, or a goal that
            the guard would never let the chaser rest at; the message names value and distance.

    """
    for name, vector in (("start.position", start.position), ("start.velocity", start.velocity), ("goal", goal)):
        if not np.all(np.isfinite(np.asarray(vector))):
            raise ControlError(f"guard: {name} is {vector.tolist()}; it must be finite")
    for name, point in (("start", start.position), ("goal", goal)):
        away = float(np.linalg.norm(np.asarray(point))) + guard.braking.position_radius
        if away > guard.assumptions.range_limit:
            limit = guard.assumptions.range_limit
            raise ControlError(f"guard: {name} needs a range of {away:.3f} m; range_limit is {limit} m")
    here, there, certified = _looked_at(numbers_as_arrays(guard), start, goal, as_float64(arrival))
    value = float(here)
    if not value > 0.0:
        raise ControlError(f"guard: the field is {value:.3f} m at the start: inside the target; it must be above 0")
    value = float(there)
    if not value > guard.least_value:
        raise ControlError(
            f"guard: the field is {value:.3f} m at the goal; the guard lets the chaser rest only above "
            f"{guard.least_value:.3f} m (threshold {guard.threshold:.3f} m and tube)"
        )
    return bool(certified)


@kept_jit
def _looked_at(guard: Guard, start: MotionState, goal: Vector, arrival: Scalar) -> tuple[Scalar, Scalar, Flag]:
    """Give the field (m) at start and goal, and `certified_start`: one program instead of one each."""
    here = guard.field.at_time(start.time).value(start.position)
    there = guard.field.at_time(arrival).value(goal)
    return here, there, guard.certified_start(start)


def starts_certified(guard: Guard, truths: MotionState) -> Bool[np.ndarray, "states"]:
    """Whether true states, with a leading axis, are those of `Guard.certified_start`; needs concrete values.

    Guards of other numbers share what is compiled, as their numbers are handed over as arrays. One state is looked at
    after another, so that what is said of one does not depend on how many there are.
    """
    numbers, found = numbers_as_arrays(guard), []
    for first in range(0, len(truths.position), _ROOM):
        count = min(len(truths.position) - first, _ROOM)
        places = np.minimum(np.arange(first, first + _ROOM), first + count - 1)
        some = jax.tree.map(lambda array, places=places: np.asarray(array)[places], truths)
        found.append(np.asarray(_certified_starts(numbers, some, jnp.asarray(count)))[:count])
    return np.concatenate(found)


@kept_jit
def _certified_starts(guard: Guard, truths: MotionState, count: Int[Array, ""]) -> Bool[Array, "room"]:
    def look(place: Int[Array, ""], found: Bool[Array, "room"]) -> Bool[Array, "room"]:
        return found.at[place].set(guard.certified_start(jax.tree.map(lambda array: array[place], truths)))

    return jax.lax.fori_loop(0, count, look, jnp.zeros(_ROOM, bool))
