"""The cheapest single burn after which a deputy that only coasts sees all points: a search by Hill's equations."""

import itertools
import math

import numba
import numpy as np
from act3_task import (
    FARTHEST,
    FORCE,
    MASS,
    MEAN_MOTION,
    PERIOD,
    STEPS,
    darkest,
    directions_of_points,
    push_matrix,
    sun_directions,
)

from keepout.apps.inspection.passive import coast_matrix

KEPT = 8.0
"""Kept of the crash sphere and of the farthest distance in the plan, m: room for the guard, and for what Hill's
equations leave out."""
HEIGHT = 0.01
"""Kept of a point's and the sun's horizon in the plan, as a sine."""
DRIFTS = np.array([0.0, 0.0005, -0.0005, 0.001, -0.001, 0.002, -0.002, 0.004, -0.004, 0.008, -0.008, 0.012, -0.012])
"""Velocities along the orbit beyond that of a closed ellipse, m/s."""
CENTRES = np.arange(-400.0, 401.0, 20.0)
"""Of the ellipse, along the orbit, m; and heights of the motion across the orbit, m."""
EVERY = 4
"""Periods between the places that the search looks from: seen from these, seen from all."""


class Search:
    """Finds the burn of a task's starts.

    Args:
        task: with the ball and the crash sphere.

    """

    def __init__(self, task):
        self.task, self.points = task, directions_of_points()
        self.coast = coast_matrix(MEAN_MOTION, PERIOD * np.arange(STEPS + 1))[:, :3]

    def burns(self, position, velocity):
        """Give changes of velocity (m, 3), m/s, the cheapest first: by Δv, the sum over the thruster axes."""
        n, (x, _, z), (vx, vy, vz) = MEAN_MOTION, position, velocity
        along = np.unique(np.append(DRIFTS + 2.0 * n * z - vx, 0.0))
        radial = np.unique(np.append(-0.5 * n * (x - CENTRES) - vz, 0.0))
        across = np.unique(np.append(n * CENTRES - vy, 0.0))
        found = np.array(list(itertools.product(along, across, radial)))
        return found[np.argsort(np.abs(found).sum(axis=1), kind="stable")]

    def find(self, position, velocity, sun):
        """Give the force (3,) N and the periods that it is held for; None where no burn of the search is enough."""
        changes = self.burns(position, velocity)
        suns = sun_directions(sun)
        lasts = np.maximum(1, np.ceil(np.abs(changes).max(axis=1) * MASS / (FORCE * PERIOD) - 1e-9)).astype(int)
        state = np.concatenate([position, velocity])
        for begin in range(0, len(changes), 256):
            some = slice(begin, begin + 256)
            begun = np.empty((len(changes[some]), 6))
            for last in np.unique(lasts[some]):
                burning = lasts[some] == last
                pushed = changes[some][burning] / (last * PERIOD) @ push_matrix(MEAN_MOTION, last * PERIOD).T
                begun[burning] = coast_matrix(MEAN_MOTION, last * PERIOD) @ state + pushed
            best = _first_enough(
                begun,
                lasts[some],
                self.coast,
                suns,
                self.points,
                self.task.radius,
                self.task.crash + KEPT,
                FARTHEST - KEPT,
                darkest(self.task) + HEIGHT,
            )
            if best >= 0:
                best += begin
                return changes[best] * MASS / (lasts[best] * PERIOD), int(lasts[best])
        return None


@numba.njit(cache=True)
def _first_enough(begun, lasts, coast, suns, points, radius, nearest, farthest, dimmest):
    """Give the index of the first state (m, 6) from which coasting keeps off and sees all, or -1."""
    path = np.empty((len(coast), 3))
    seen = np.empty(len(points), np.bool_)
    for j in range(len(begun)):
        steps, safe = len(coast) - lasts[j], True
        for k in range(steps):
            square = 0.0
            for i in range(3):
                total = 0.0
                for c in range(6):
                    total += coast[k, i, c] * begun[j, c]
                path[k, i] = total
                square += total * total
            if square < nearest * nearest or square > farthest * farthest:
                safe = False
                break
        if not safe:
            continue
        seen[:] = False
        left = len(points)
        for k in range(0, steps, EVERY):
            x, y, z = path[k]
            distance = math.sqrt(x * x + y * y + z * z)
            least = radius / distance + HEIGHT
            sun = suns[k + lasts[j]]
            for i in range(len(points)):
                if not seen[i]:
                    a, b, c = points[i]
                    if a * sun[0] + b * sun[1] + c * sun[2] >= dimmest and (a * x + b * y + c * z) / distance >= least:
                        seen[i] = True
                        left -= 1
            if left == 0:
                break
        if left == 0:
            return j
    return -1
