"""A flight in segments: what leads it, its field and its goal may be others in each, and its memories go on.

A flight's setup is data to the compiled program. So one program flies every segment of one length, whatever map, goal
and guidance it has, as long as their arrays keep their shapes and everything that is no array stays equal.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from keepout.compiled.kept_executables import kept_jit
from keepout.errors import FlightError
from keepout.flight import loop
from keepout.flight.loop import FlightLog, LoopState
from keepout.flight.setup import FlightSetup

begin = kept_jit(loop.start)
"""`loop.start`, compiled: `begin(setup, initial, key) -> LoopState`, the state before the first segment."""


@kept_jit
def _fly(setup: FlightSetup, state: LoopState, steps: int) -> tuple[LoopState, FlightLog]:
    def advance(state: LoopState, _: None) -> tuple[LoopState, FlightLog]:
        return loop.step(setup, state)

    return jax.lax.scan(advance, state, length=steps)


@kept_jit
def _fly_some(setup: FlightSetup, state: LoopState, steps: Int[Array, ""], room: int) -> tuple[LoopState, FlightLog]:
    """Step `room` times; the state is that after `steps` of them, and later rows say nothing."""

    def advance(state: LoopState, place: Int[Array, ""]) -> tuple[LoopState, FlightLog]:
        flown, row = loop.step(setup, state)
        return jax.tree.map(lambda new, old: jnp.where(place < steps, new, old), flown, state), row

    return jax.lax.scan(advance, state, jnp.arange(room))


def fly_segment(
    setup: FlightSetup, state: LoopState, steps: int, *, room: int | None = None
) -> tuple[LoopState, FlightLog]:
    """Fly `steps` control periods from a state: the state after them, and a row for the start of each.

    Law and guard go on with what they remember: the law's observer, the force held, the commands under way, the guard's
    plan. That is right as long as what is new in `setup` leaves the meaning of these: another goal, guidance or tuning,
    and a field that says nowhere less than the one before (docs/mapping-field.md).

    A whole flight's record has one more row, of its end: fly a last segment of one step and keep its row only.

    Args:
        setup: that the segment is flown with.
        state: at its start.
        steps: of it; compiles anew for another number of them where `room` is absent.
        room: the most steps of any segment that shall share one compiled program; each costs as much as these.

    Raises:
        FlightError: fewer than one step, or more than there is room for.

    """
    if steps < 1:
        raise FlightError(f"segment: steps is {steps}; at least 1 is needed")
    if room is None:
        return _fly(setup, state, steps)
    if steps > room:
        raise FlightError(f"segment: steps is {steps}; room is {room}, which is the most")
    state, log = _fly_some(setup, state, jnp.asarray(steps), room)
    return state, log if steps == room else jax.tree.map(lambda rows: jnp.asarray(np.asarray(rows)[:steps]), log)


def joined(logs: Sequence[FlightLog]) -> FlightLog:
    """Put the rows of segments flown one after another into one log."""
    # By NumPy: JAX would compile a program for each column and number of segments.
    return jax.tree.map(lambda *rows: jnp.asarray(np.concatenate([np.asarray(one) for one in rows])), *logs)
