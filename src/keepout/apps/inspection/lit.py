"""What of a target the sun lights at some time of a mission."""

import numpy as np
from jaxtyping import Bool

from keepout.apps.inspection.frames import Camera

_TURN = np.radians(2.0)
"""Angle that the sun may turn, in body axes, between two directions that are looked at, rad."""
_COARSE = 120.0
"""Seconds between the times at which the sun's turn is looked at."""
_MOST = 720
"""Directions that are looked at, at most."""


def ever_lit(
    camera: Camera, units: Bool[np.ndarray, " units"], duration: float, *, begin: float = 0.0
) -> Bool[np.ndarray, " units"]:
    """Say which units are wholly lit at some time from `begin` to `duration` (s); all where light does not matter.

    The sun is looked at every few degrees of its way. What is lit only in between is left out: the answer is a lower
    bound.

    Args:
        camera: its light and lines of sight.
        units: (2 n,) that are asked for.
        duration: of the mission, s.
        begin: s.

    """
    if not camera.light.matters:
        return units.copy()
    lit, last, looked = np.zeros_like(units), None, 0
    for now in np.linspace(begin, duration, max(2, int(np.ceil((duration - begin) / _COARSE)) + 1)):
        sun = camera.sun(float(now))
        if sun is None or (last is not None and float(sun @ last) > np.cos(_TURN)):
            continue
        left = np.flatnonzero(units & ~lit)
        if not len(left) or looked >= _MOST:
            break
        lit[left[camera.lit(sun, left)]] = True
        last, looked = sun, looked + 1
    return lit
