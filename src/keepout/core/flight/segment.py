"""A flight in segments: what leads it, its field and its goal may be others in each, and its memories go on.

A flight's setup is data to the compiled program. So one program flies every segment of one room, whatever map, goal
and guidance it has, as long as their arrays keep their shapes and everything that is no array stays equal.
"""

from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Array, Int

from keepout.core.compiled.kept_executables import kept_jit
from keepout.core.errors import FlightError
from keepout.core.flight import loop
from keepout.core.flight.loop import FlightLog, LoopState
from keepout.core.flight.setup import FlightSetup

begin = kept_jit(loop.start)
"""`loop.start`, compiled: `begin(setup, initial, key) -> LoopState`, the state before the first segment."""


@kept_jit
def _fly(setup: FlightSetup, state: LoopState, rows: Int[Array, ""], room: int) -> tuple[LoopState, FlightLog]:
    return loop.advanced(setup, state, rows, room)


def fly_segment(
    setup: FlightSetup, state: LoopState, steps: int, *, longest: int | None = None
) -> tuple[LoopState, FlightLog]:
    """Fly `steps` control periods from a state: the state after them, and a row for the start of each.

    Law and guard go on with what they remember: the law's observer, the force held, the commands under way, the guard's
    plan. That is right as long as what is new in `setup` leaves the meaning of these: another goal, guidance or tuning,
    and a field that says nowhere less than the one before (docs/mapping-field.md). One program serves all numbers of
    steps up to its room.

    A whole flight's record has one more row, of its end: fly a last segment of one step and keep its row only.

    Args:
        setup: of the segment.
        state: after the one before.
        steps: of the segment.
        longest: of a flight's segments, in steps: the room that its one program is made for. By default the steps.

    Raises:
        FlightError: fewer than one step, or more than the longest.

    """
    if steps < 1:
        raise FlightError(f"segment: steps is {steps}; at least 1 is needed")
    if longest is not None and steps > longest:
        raise FlightError(f"segment: steps is {steps}; longest is {longest}")
    room = loop.room_for(steps if longest is None else longest)
    state, log = _fly(setup, state, loop.as_count(steps), room)
    return state, loop.rows_of(log, steps)


def joined(logs: Sequence[FlightLog]) -> FlightLog:
    """Put the rows of segments flown one after another into one log."""
    # Not by a compiled program: of thousands of segments that takes minutes to compile.
    return jax.tree.map(lambda *rows: jax.device_put(np.concatenate([np.asarray(row) for row in rows])), *logs)
