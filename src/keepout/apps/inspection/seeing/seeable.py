"""What of a mesh can be seen at all from the room allowed: shown by a witness, or proved impossible, or not decided."""

import enum
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int8

from keepout.apps.inspection.seeing.patches import Patches


class Verdict(enum.IntEnum):
    """What is known of a unit."""

    SEEABLE = 0
    """A place in the room allowed is known from which it is wholly seen."""
    HIDDEN = 1
    """Proved: from no place in the room allowed."""
    UNDECIDED = 2
    """Neither a place was found nor a proof."""


class Hidden(enum.IntEnum):
    """Why a unit that is proved hidden is so, for people: measured by rays from its middle, not proved."""

    NOT = 0
    """It is seeable, or not decided."""
    ENCLOSED = 1
    """Each of many rays over its side meets the mesh."""
    NARROW = 2
    """Some of them gets out: incidence, range, stand-off or the width of what is open forbid it."""


@dataclass(frozen=True, eq=False)
class Seeable:
    """The verdict on each unit (2 n) of a mesh's patches.

    Attributes:
        patches: the units.
        verdict: (2 n,) a `Verdict`.
        why: (2 n,) a `Hidden`.
        witness: (2 n, 3) a place from which the unit is wholly seen, m; nan where none is known.
        squares: of directions that were looked at for it.
        by_clock: whether a clock ended the search before that was all it might look at: another machine may then decide
            more, or less.

    """

    patches: Patches
    verdict: Int8[np.ndarray, " units"]
    why: Int8[np.ndarray, " units"]
    witness: Float[np.ndarray, "units 3"]
    squares: int = 0
    by_clock: bool = False

    @property
    def possible(self) -> Bool[np.ndarray, " units"]:
        """Say which counted units are not proved hidden: an inspection wants to see them."""
        return self.patches.counted & (self.verdict != Verdict.HIDDEN)

    @property
    def lower(self) -> float:
        """Share of the area counted that surely can be seen: a witness is known."""
        return self.patches.coverage(self.verdict == Verdict.SEEABLE)

    @property
    def upper(self) -> float:
        """Share of the area counted beyond which no chaser can see: the rest is proved hidden."""
        return 1.0 - self.patches.coverage(self.verdict == Verdict.HIDDEN)
