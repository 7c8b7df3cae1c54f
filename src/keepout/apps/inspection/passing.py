"""Frames taken on the way from one view to the next: what they see comes free."""

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Float, Int

from keepout.apps.inspection.lit_times import LitTimes
from keepout.core.cores import available_cores

Shown = Callable[[Float[np.ndarray, "3"], Float[np.ndarray, "3"]], Int[np.ndarray, " _"]]
"""What a frame from a place in a direction shows, in any light."""
Passing = dict[tuple[bytes, ...], Int[np.ndarray, " _"]]
"""What was seen on legs, by all that it follows from."""

_SURELY = 2
"""Frames of a leg that must show a unit before it is counted on: the flight's are at other moments."""
_FRAMES = 20_000
"""On a whole tour, at most: of more, every second one and so on is looked at."""
_SAME = 0.01
"""Seconds by which a leg may last longer and is still the same leg."""


def seen_in_passing(
    courses: list[Float[np.ndarray, "_ 3"]],
    boresights: Float[np.ndarray, "stops 3"],
    times: Float[np.ndarray, " stops"],
    *,
    shown: Shown,
    lit: LitTimes,
    rate: float,
    period: float,
    known: Passing | None = None,
) -> list[Int[np.ndarray, " _"]]:
    """Say which units are seen between the views, leg by leg; neither of a leg's ends counts.

    On a leg the chaser goes at one speed, and the boresight turns at its rate from one view's direction straight to
    the next's as soon as the leg begins.

    Args:
        courses: corners of the way of each leg, m.
        boresights: at the start and at each view.
        times: at the start and at each view, s.
        shown: by a frame.
        lit: when.
        rate: of the boresight, rad/s.
        period: between frames, s.
        known: legs looked at before, and added to: where the light does not change, they are not looked at again.

    """
    every = max(1, math.ceil((times[-1] - times[0]) / period / _FRAMES))

    known = {} if known is None or lit.changes else known

    def leg(n: int) -> Int[np.ndarray, " n"]:
        seen = [np.zeros(0, dtype=np.int64)]
        begin, end = times[n], times[n + 1]
        if not math.isfinite(end):
            return seen[0]
        lasts = round((end - begin) / _SAME)
        key = (courses[n].tobytes(), boresights[n].tobytes(), boresights[n + 1].tobytes(), b"%d %d" % (lasts, every))
        if key in known:
            return known[key]
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(courses[n], axis=0), axis=1))])
        for after in np.arange(every * period, end - begin, every * period):
            at = along[-1] * after / (end - begin)
            place = np.array([np.interp(at, along, courses[n][:, axis]) for axis in range(3)])
            units = shown(place, turned(boresights[n], boresights[n + 1], rate * after))
            seen.append(units[lit.at(float(begin + after))[units]])
        units, frames = np.unique(np.concatenate(seen), return_counts=True)
        known[key] = units[frames >= _SURELY]
        return known[key]

    with ThreadPoolExecutor(available_cores()) as pool:
        return list(pool.map(leg, range(len(courses))))


def turned(first: Float[np.ndarray, "3"], last: Float[np.ndarray, "3"], angle: float) -> Float[np.ndarray, "3"]:
    """Turn a unit vector towards another by an angle (rad), and no farther than there."""
    whole = math.atan2(float(np.linalg.norm(np.cross(first, last))), float(first @ last))
    if angle >= whole:
        return last
    across = last - (first @ last) * first
    size = float(np.linalg.norm(across))
    if size < 1e-9:
        across = np.cross(first, np.eye(3)[np.argmin(np.abs(first))])
        size = float(np.linalg.norm(across))
    return math.cos(angle) * first + math.sin(angle) * across / size
