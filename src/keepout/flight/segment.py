"""A flight in segments: what leads it, its field and its goal may be others in each, and its memories go on.

A flight's setup is data to the compiled program. So one program flies every segment of one length, whatever map, goal
and guidance it has, as long as their arrays keep their shapes and everything that is no array stays equal.
"""

from collections.abc import Sequence

import jax
import numpy as np

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


def fly_segment(setup: FlightSetup, state: LoopState, steps: int) -> tuple[LoopState, FlightLog]:
    """Fly `steps` control periods from a state: the state after them, and a row for the start of each.

    Law and guard go on with what they remember: the law's observer, the force held, the commands under way, the guard's
    plan. That is right as long as what is new in `setup` leaves the meaning of these: another goal, guidance or tuning,
    and a field that says nowhere less than the one before (docs/mapping-field.md). Compiles anew for another number of
    steps.

    A whole flight's record has one more row, of its end: fly a last segment of one step and keep its row only.

    Raises:
        FlightError: fewer than one step.

    """
    if steps < 1:
        raise FlightError(f"segment: steps is {steps}; at least 1 is needed")
    return _fly(setup, state, steps)


def joined(logs: Sequence[FlightLog]) -> FlightLog:
    """Put the rows of segments flown one after another into one log."""
    # Not by a compiled program: of thousands of segments that takes minutes to compile.
    return jax.tree.map(lambda *rows: jax.device_put(np.concatenate([np.asarray(row) for row in rows])), *logs)
