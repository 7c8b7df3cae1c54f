"""What an inspection still wants to see, as it is known on board, and what it has given up."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int

from keepout.apps.inspection.seeing.patches import Patches

_ATTEMPTS = 2
"""Tours that may promise a unit and not show it before it is given up."""
_ROUNDING = 1e-12


@dataclass(eq=False)
class Wanted:
    """The units wanted, taken and given up.

    Attributes:
        patches: the units.
        possible: (2 n,) what is not proved hidden, and is lit in the mission's time.
        share: of the area of these that is wanted, 0 to 1.
        taken: (2 n,) seen in some frame, by the estimates on board.
        failures: (2 n,) tours that promised a unit and ended without it.

    """

    patches: Patches
    possible: Bool[np.ndarray, " units"]
    share: float
    taken: Bool[np.ndarray, " units"]
    failures: Int[np.ndarray, " units"]

    @classmethod
    def of(cls, patches: Patches, possible: Bool[np.ndarray, " units"], share: float) -> "Wanted":
        """Begin with nothing taken."""
        return cls(patches, possible, share, np.zeros(patches.units, bool), np.zeros(patches.units, np.int64))

    @property
    def left(self) -> Bool[np.ndarray, " units"]:
        """The units still wanted and not given up."""
        return self.possible & ~self.taken & (self.failures < _ATTEMPTS)

    @property
    def reached(self) -> float:
        """Share of the possible area that was taken, 0 to 1."""
        areas = self.patches.unit_areas()
        whole = float(areas[self.possible].sum())
        return float(areas[self.possible & self.taken].sum()) / whole if whole > 0.0 else 1.0

    @property
    def enough(self) -> bool:
        """Whether the share wanted was taken."""
        return self.reached >= self.share - _ROUNDING

    @property
    def all_taken(self) -> bool:
        """Whether nothing of the possible area is left, given up or not."""
        return not bool((self.possible & ~self.taken).any())

    @property
    def ending(self) -> tuple[str, str]:
        """Say how an inspection ends by which the share wanted was taken, and why."""
        outcome = "all seen" if self.all_taken else f"{100.0 * self.share:g} % asked, seen"
        return outcome, f"{self.reached:.2%} of what is not proved hidden was taken, {self.share:.2%} were asked for"

    @property
    def share_of_left(self) -> float:
        """Share of the area left that is to be seen so that the share wanted is reached, 0 to 1."""
        areas = self.patches.unit_areas()
        whole, left = float(areas[self.possible].sum()), float(areas[self.left].sum())
        missing = (self.share - self.reached) * whole
        return float(np.clip(missing / left, 0.0, 1.0)) if left > 0.0 else 1.0

    def take(self, units: Int[np.ndarray, " k"]) -> int:
        """Note what a frame showed; give how many units of it were wanted and new."""
        fresh = int((self.possible[units] & ~self.taken[units]).sum())
        self.taken[units] = True
        return fresh

    def failed(self, promised: Int[np.ndarray, " k"]) -> None:
        """Note that a tour promised units; those not taken are tried so many times at most."""
        missing = promised[~self.taken[promised]]
        self.failures[missing] += 1
