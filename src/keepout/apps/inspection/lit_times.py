"""When each unit is wholly lit, at times a step apart, and the windows in which a view's units all are.

Between two times that follow each other a unit counts as lit if it is at both. The step is at most a hundred and
twentieth of the time looked at, and shorter where the sun turns fast: what is lit for less than that is not resolved.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from keepout.apps.inspection.light import Light
from keepout.apps.inspection.seeing.rules import SeeingRules
from keepout.apps.inspection.seeing.sightlines import Sightlines
from keepout.apps.inspection.seeing.visible import lit_units

_STEPS, _MOST_STEPS = 120, 1200
"""Of the time looked at: so many where the light turns slowly, and at most."""
_TURN = math.radians(1.25)
"""By which the sun turns in a step, rad, where `_MOST_STEPS` allow it."""
_ROOM = 4e8
"""Steps times units, at most, where these are more than `_STEPS`."""
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
        most = math.floor((end - begin) / shortest) if end > begin else 0
        steps = max(_STEPS, _turns(light, begin, end, min(most, _MOST_STEPS)))
        steps = min(steps, most, max(_STEPS, int(_ROOM / len(wanted))))
        count = max(2, steps + 1) if end > begin else 1
        times = np.linspace(begin, max(end, begin), count)
        suns = light.suns(times)
        dark = np.isnan(suns[:, 0])
        if not dark.any() and np.ptp(suns, axis=0).max() < _SAME:
            return cls(times[:1], lit_units(sight, rules, suns[0], among=wanted)[None], False)
        nothing = np.zeros_like(wanted)
        lit = np.array([nothing if dark[n] else lit_units(sight, rules, suns[n], among=wanted) for n in range(count)])
        return cls(times, lit, True)

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


def _turns(light: Light, begin: float, end: float, steps: int) -> int:
    """Give how many equal steps there would have to be for the sun to turn by `_TURN` in none; `steps` at most."""
    if steps < 1:
        return 0
    suns = light.suns(np.linspace(begin, end, steps + 1))
    across = np.linalg.norm(np.cross(suns[1:], suns[:-1]), axis=1)
    angles = np.arctan2(across, np.einsum("ni,ni->n", suns[1:], suns[:-1]))
    angles = angles[np.isfinite(angles)]
    return min(steps, math.ceil(steps * float(angles.max()) / _TURN)) if len(angles) else 0
