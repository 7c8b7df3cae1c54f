"""Lights that tests make up."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from keepout.apps.inspection.light import Light


@dataclass(frozen=True, eq=False)
class Round(Light):
    """A light that goes round an axis once in a period (s) from `across` on over `along`.

    It is hidden where `dark` says so of (n, 3) directions.
    """

    across: tuple[float, float, float]
    along: tuple[float, float, float]
    period: float
    dark: Callable[[np.ndarray], np.ndarray] | None = None

    @property
    def matters(self):
        return True

    def suns(self, times):
        turn = 2.0 * np.pi * np.asarray(times) / self.period
        suns = np.stack([np.cos(turn), np.sin(turn)], axis=1) @ np.array([self.across, self.along], float)
        if self.dark is not None:
            suns[self.dark(suns)] = np.nan
        return suns
