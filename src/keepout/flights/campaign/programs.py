"""What differs between the flights of one compiled program, and which flights share one.

The setups of two runs are flown by one program where they have the same structure and differ in small arrays only:
these are then stacked, one entry a flight. Which arrays are stacked is settled once for the whole campaign, from its
first few runs, and not for each batch, since a compiled program's last bits depend on it. A run that differs elsewhere
is flown by a program of its structure in which all small arrays are stacked: again whatever is flown beside it.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from keepout.core.flight.batches import TARGET
from keepout.core.flight.setup import FlightSetup

LARGE = 4096
"""Arrays of more numbers are shared, never stacked: networks and grids. Runs that differ in them fly apart."""


@dataclasses.dataclass(frozen=True, eq=False)
class Program:
    """A structure of setups, and which of its leaves are stacked.

    Attributes:
        setup: one that has the structure; its shared small leaves are those of all setups of the program.
        stacked: for each leaf, whether each flight has its own.

    """

    setup: FlightSetup
    stacked: tuple[bool, ...]

    def takes(self, setup: FlightSetup) -> bool:
        """Whether a setup (`flown_setup`) may be flown by this program."""
        if jax.tree.structure(setup) != jax.tree.structure(self.setup):
            return False
        pairs = zip(jax.tree.leaves(self.setup), jax.tree.leaves(setup), self.stacked, strict=True)
        return all(np.shape(a) == np.shape(b) and (own or _is_large(a) or _same(a, b)) for a, b, own in pairs)

    @property
    def vary(self) -> FlightSetup | None:
        """A tree of truth values for the `vary` of `fly_batches`; None where nothing is stacked."""
        return jax.tree.unflatten(jax.tree.structure(self.setup), self.stacked) if any(self.stacked) else None

    @property
    def alike(self) -> tuple[str, ...]:
        """What of the target's motion flights have in common (`flight.batches.TARGET`): all where none varies it."""
        vary = self.vary
        turned = vary is not None and any(jax.tree.leaves(vary.motion))
        return ("time",) if turned else TARGET


def programs_of(setups: Sequence[FlightSetup]) -> tuple[Program, ...]:
    """Settle the programs of a campaign from the setups (`flown_setup`) of some of its runs."""
    made: list[Program] = []
    for setup in setups:
        place = next((i for i, program in enumerate(made) if _alike(program.setup, setup)), None)
        if place is None:
            made.append(Program(setup, tuple(False for _ in jax.tree.leaves(setup))))
            continue
        known = made[place]
        pairs = zip(jax.tree.leaves(known.setup), jax.tree.leaves(setup), known.stacked, strict=True)
        made[place] = Program(known.setup, tuple(own or not (_is_large(a) or _same(a, b)) for a, b, own in pairs))
    return tuple(made)


def program_for(programs: Sequence[Program], setup: FlightSetup) -> tuple[Any, Program]:
    """Find the program of a setup, and a key that setups flown together have in common."""
    large = tuple(id(leaf) for leaf in jax.tree.leaves(setup) if _is_large(leaf))
    for i, program in enumerate(programs):
        if program.takes(setup):
            return (i, large), program
    leaves, structure = jax.tree.flatten(setup)
    wide = Program(setup, tuple(_is_number(leaf) and not _is_large(leaf) for leaf in leaves))
    return ("wide", structure, tuple(np.shape(leaf) for leaf in leaves), large), wide


def stacked_setup(program: Program, setups: Sequence[FlightSetup]) -> FlightSetup:
    """Give the setup of flights that fly together: one entry a flight in the stacked leaves, the first's elsewhere."""
    if not any(program.stacked):
        return setups[0]
    columns = zip(*(jax.tree.leaves(setup) for setup in setups), strict=True)
    leaves = [
        np.stack([np.asarray(leaf) for leaf in column]) if own else column[0]
        for column, own in zip(columns, program.stacked, strict=True)
    ]
    return jax.tree.unflatten(jax.tree.structure(setups[0]), leaves)


def _alike(one: FlightSetup, other: FlightSetup) -> bool:
    if jax.tree.structure(one) != jax.tree.structure(other):
        return False
    return all(np.shape(a) == np.shape(b) for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True))


def _is_number(leaf: Any) -> bool:
    return isinstance(leaf, float | int | np.ndarray | np.generic | jax.Array)


def _is_large(leaf: Any) -> bool:
    return np.size(leaf) > LARGE if _is_number(leaf) else True


def _same(one: Any, other: Any) -> bool:
    return one is other or np.array_equal(np.asarray(one), np.asarray(other), equal_nan=True)
