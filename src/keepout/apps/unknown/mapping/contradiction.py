"""Returns that prove a promise broken: farther inside known-free room than the errors explain."""

from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float


def in_free_room(
    points: Float[np.ndarray, "m 3"],
    reach: Float[np.ndarray, "m"],
    origin: Float[np.ndarray, "3"],
    spacing: float,
    free: Bool[np.ndarray, "n n n"],
    cap: float,
) -> Bool[np.ndarray, "m"]:
    """Say round which points a whole ball lies in free cubes: farther than `reach` from each cube that is not free.

    Args:
        points: m, in the grid's frame.
        reach: radius of each point's ball, m. A ball of the cap or more is not judged: the answer is no.
        origin: (3,) lower corner of the grid, m.
        spacing: edge of a cube, m.
        free: whether each cube is. Those within the cap of the border are; so is all beyond it.
        cap: m.

    """
    found = np.zeros(len(points), dtype=np.bool_)
    judged = np.flatnonzero(reach < cap)
    held = np.empty(len(judged), dtype=np.bool_)
    _in_free_room((points[judged] - origin) / spacing, reach[judged] / spacing, free, held)
    found[judged] = held
    return found


@no_type_check
@numba.njit(cache=True, nogil=True)
def _in_free_room(places, reach, free, held):
    """Decide for places and radii in cells: the box of cubes round each ball, less those that it does not meet."""
    last = free.shape[0] - 1
    for p in range(len(places)):
        x, y, z, r = places[p, 0], places[p, 1], places[p, 2], reach[p]
        held[p] = True
        for i in range(max(int(np.floor(x - r)), 0), min(int(np.floor(x + r)), last) + 1):
            across = max(i - x, x - i - 1.0, 0.0) ** 2
            for j in range(max(int(np.floor(y - r)), 0), min(int(np.floor(y + r)), last) + 1):
                down = across + max(j - y, y - j - 1.0, 0.0) ** 2
                if down > r * r:
                    continue
                for k in range(max(int(np.floor(z - r)), 0), min(int(np.floor(z + r)), last) + 1):
                    if not free[i, j, k] and down + max(k - z, z - k - 1.0, 0.0) ** 2 <= r * r:
                        held[p] = False
                        break
                if not held[p]:
                    break
            if not held[p]:
                break
