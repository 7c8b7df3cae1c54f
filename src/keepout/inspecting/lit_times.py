"""When each unit is wholly lit, at times a step apart, and the windows in which a view's units all are.

Between two times that follow each other a unit counts as lit if it is at both. The step is at most a hundred and
twentieth of the time looked at: where the sun turns by more than a few degrees in it, less than that is not resolved.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from keepout.mission.light import Light
from keepout.seeing.rules import SeeingRules
from keepout.seeing.sightlines import Sightlines
from keepout.seeing.visible import lit_units

_STEPS = 120
_SPELLS = 16
"""Parts of the time looked at, in each of which a view is a candidate of its own."""
_AT_ONCE = 1e-6
"""Seconds: nearer times are one."""
_SAME = 1e-9
"""Change of the sun's direction below which it counts as fixed."""


@dataclass(frozen=True, eq=False)
class LitTimes:
    """What is lit when.

    Attributes:
        times: (t,) s; one, with all that is ever lit, where the light does not change.
        lit: (t, units).
        changes: whether the light changes.

    """

    times: Float[np.ndarray, " t"]
    lit: Bool[np.ndarray, "t units"]
    changes: bool

    @classmethod
    def of(
        cls,
        light: Light,
        sight: Sightlines,
        rules: SeeingRules,
        wanted: Bool[np.ndarray, " units"],
        begin: float,
        end: float,
        shortest: float,
    ) -> "LitTimes":
        """Look at the light from `begin` to `end` (s), at steps of at least `shortest` (s).

        Args:
            light: of the mission.
            sight: for the shadows that the target throws on itself.
            rules: greatest incidence of the sun.
            wanted: (units,) that are asked for.
            begin: s.
            end: s.
            shortest: s.

        """
        if not light.matters:
            return cls(np.array([begin]), wanted[None].copy(), False)
        count = max(2, min(_STEPS, math.floor((end - begin) / shortest)) + 1) if end > begin else 1
        times = np.linspace(begin, max(end, begin), count)
        suns = light.suns(times)
        dark = np.isnan(suns[:, 0])
        if not dark.any() and np.ptp(suns, axis=0).max() < _SAME:
            return cls(times[:1], lit_units(sight, rules, suns[0], among=wanted)[None], False)
        nothing = np.zeros_like(wanted)
        lit = np.array([nothing if dark[n] else lit_units(sight, rules, suns[n], among=wanted) for n in range(count)])
        return cls(times, lit, True)

    def spells(self) -> Bool[np.ndarray, "s units"]:
        """Give for each spell, a part of the times, what is lit all through it."""
        if not self.changes:
            return self.lit
        parts = np.array_split(np.arange(len(self.times)), max(1, min(_SPELLS, len(self.times) // 2)))
        # A spell ends at the time at which the next begins.
        return np.array([self.lit[part[0] : part[-1] + 2].all(axis=0) for part in parts])

    def at(self, time: float) -> Bool[np.ndarray, " units"]:
        """Give what is lit at a time, s: at the looked-at times before and after it, or at that of them which it is."""
        if not self.changes:
            return self.lit[0]
        if not self.times[0] <= time <= self.times[-1]:
            return np.zeros(self.lit.shape[1], dtype=bool)
        after = int(np.searchsorted(self.times, time))
        if self.times[after] - time < _AT_ONCE:
            return self.lit[after]
        return self.lit[after] & self.lit[max(after - 1, 0)]

    def windows(self, units: Int[np.ndarray, " k"]) -> list[tuple[float, float]]:
        """Give the times, s, from and to, in which all of some units are lit."""
        if not self.changes:
            return [(-math.inf, math.inf)]
        together = np.concatenate([[False], self.lit[:, units].all(axis=1), [False]])
        edges = np.flatnonzero(together[1:] != together[:-1]).reshape(-1, 2)
        return [(float(self.times[first]), float(self.times[last - 1])) for first, last in edges]
