"""Proof that a point lies in the exterior: a chain of free balls from it to beyond the mesh's bounding box.

The audit's clearance bound shows that a path never meets {d ≤ radius}. It then stays in whichever component of
{d > radius} it began in, and an unsigned distance alone cannot tell the outside from a closed cavity. The ball of
radius d(p) − radius about p is free, so a chain of points, each in the ball of the one before, that leaves the bounding
box by more than the radius settles it. No orientation, sign or watertightness is needed.
"""

import heapq
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

_DIRECTIONS = np.array([[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z], float)
_DIRECTIONS /= np.linalg.norm(_DIRECTIONS, axis=1, keepdims=True)


def proved_outside(
    point: Float[np.ndarray, "3"],
    distance: Callable[[Float[np.ndarray, "points 3"]], Float[np.ndarray, "points"]],
    lower: Float[np.ndarray, "3"],
    upper: Float[np.ndarray, "3"],
    *,
    radius: float,
    expansions: int = 2000,
    away: float | None = None,
) -> bool:
    """Whether a free way for a sphere of `radius` metres leads from `point` out of the box [lower, upper] (metres).

    `away` is the point's distance, where that is known. Best-first search over ball chains, balls nearer the box's
    faces first. False means "not proved", never "inside".
    """
    least = 0.02

    def depth(at: np.ndarray) -> np.ndarray:
        """How far points are from being outside the box grown by the radius; negative outside."""
        return np.min(np.minimum(at - lower, upper - at), axis=-1) + radius

    free = (float(distance(point[None])[0]) if away is None else away) - radius
    if free <= 0.0:
        return False
    if depth(point[None])[0] < 0.0:
        return True
    queue: list[tuple[float, int, np.ndarray, float]] = [(0.0, 0, point, free)]
    seen: set[tuple[int, ...]] = set()
    count = 0
    while queue and count < expansions:
        _, _, at, free = heapq.heappop(queue)
        count += 1
        nexts = at + 0.9 * free * _DIRECTIONS
        # A ball that already reaches beyond the box settles it.
        depths = depth(nexts)
        if np.any(depths < 0.0):
            return True
        found = distance(nexts) - radius
        for i in np.flatnonzero(found > least):
            cell = tuple(np.floor(nexts[i] / max(0.25 * float(found[i]), least)).astype(int))
            if cell not in seen:
                seen.add(cell)
                heapq.heappush(queue, (float(depths[i] - found[i]), count * 32 + int(i), nexts[i], float(found[i])))
    return False
