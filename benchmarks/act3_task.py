"""The public inspection task of act3, written from its published numbers: where it starts, and when a point is seen.

Units are m, s, N, kg; positions and directions are in VVLH. What its documents and its code say differently is one
`Task` each; docs/reproduce.md lists the differences.
"""

import dataclasses
import math

import numba
import numpy as np
from jaxtyping import Float

from keepout.apps.inspection.passive import VVLH_FROM_RTN, coast_matrix

MEAN_MOTION = 0.001027
"""Of the chief's circular orbit and, in Hill's frame, of the sun, rad/s."""
MASS, FORCE, PERIOD = 12.0, 1.0, 10.0
LONGEST = 12236.0
STEPS = int(LONGEST // PERIOD)
"""Periods that end within the longest time."""
FARTHEST = 800.0


@dataclasses.dataclass(frozen=True)
class Task:
    """One reading of the task.

    Attributes:
        name: of the reading.
        radius: of the chief's ball, on which the points lie, m.
        crash: the deputy's centre must not come nearer to the chief's than this, m.
        by_elevation: whether directions are drawn by azimuth and elevation, as documented, or as the code does.
        fastest: at the start, m/s; with `by_distance` times 2 n r.
        by_distance: whether the speed at the start grows with the distance r.

    """

    name: str
    radius: float
    crash: float
    by_elevation: bool
    fastest: float
    by_distance: bool = False


TASKS = {
    task.name: task
    for task in (
        Task("code", radius=1.0, crash=15.0, by_elevation=False, fastest=0.8),
        Task("documents", radius=10.0, crash=10.0, by_elevation=True, fastest=0.8, by_distance=True),
    )
}


def push_matrix(mean_motion: float, seconds: float | Float[np.ndarray, "*times"]) -> Float[np.ndarray, "*times 6 3"]:
    """Give the matrix from an acceleration held for `seconds` (m/s², VVLH) to what it adds to the state at their end.

    Args:
        mean_motion: n of the circular orbit, rad/s.
        seconds: any shape.

    """
    n, t = mean_motion, np.asarray(seconds, float)
    s, c = np.sin(n * t), np.cos(n * t)
    rtn = np.zeros((*t.shape, 3, 3))
    rtn[..., 0, 0] = rtn[..., 2, 2] = (1.0 - c) / n**2
    rtn[..., 0, 1] = 2.0 * (t - s / n) / n
    rtn[..., 1, 0] = -rtn[..., 0, 1]
    rtn[..., 1, 1] = 4.0 * (1.0 - c) / n**2 - 1.5 * t**2
    position = VVLH_FROM_RTN @ rtn @ VVLH_FROM_RTN.T
    return np.concatenate([position, coast_matrix(n, t)[..., :3, 3:]], axis=-2)


def directions_of_points(asked=100):
    """Give unit vectors (n, 3) of points that lie evenly on a ball: rings about the orbit normal (Deserno 2004).

    The recipe rounds the points of each ring, so that 100 asked make 99.
    """
    area = 4.0 * math.pi / asked
    rings = round(math.pi / math.sqrt(area))
    apart = area / (math.pi / rings)
    found = []
    for ring in range(rings):
        polar = math.pi * (ring + 0.5) / rings
        count = round(2.0 * math.pi * math.sin(polar) / apart)
        azimuth = 2.0 * math.pi * np.arange(count) / count
        flat = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1) * math.sin(polar)
        found.append(np.column_stack([flat, np.full(count, math.cos(polar))]))
    return np.concatenate(found) @ VVLH_FROM_RTN.T


def start(task, seed):
    """Draw a start: position (3,) m, velocity (3,) m/s and the sun's angle, rad, in the code's order of draws."""
    generator = np.random.default_rng(seed)

    def direction():
        around, tilt = generator.uniform(0.0, 2.0 * math.pi), generator.uniform(-0.5 * math.pi, 0.5 * math.pi)
        polar, azimuth = (0.5 * math.pi - tilt, around) if task.by_elevation else (around, tilt)
        flat = math.sin(polar)
        return VVLH_FROM_RTN @ [flat * math.cos(azimuth), flat * math.sin(azimuth), math.cos(polar)]

    distance = generator.uniform(50.0, 100.0)
    position = distance * direction()
    speed = generator.uniform(0.0, task.fastest) * (2.0 * MEAN_MOTION * distance if task.by_distance else 1.0)
    velocity = speed * direction()
    return position, velocity, generator.uniform(0.0, 2.0 * math.pi)


def sun_directions(angle):
    """Give unit vectors (STEPS + 1, 3) towards the sun at every period's end; it goes round in the orbit's plane."""
    turned = angle + MEAN_MOTION * PERIOD * np.arange(STEPS + 1)
    return np.column_stack([np.cos(turned), -np.sin(turned), np.zeros(STEPS + 1)]) @ VVLH_FROM_RTN.T


def darkest(task):
    """Give the least sine of the sun's height over a point's horizon at which the point counts as lit.

    It is a little below 0: the task looks for the chief's ball between the sun and a place 1e-5 m above the point.
    """
    return -math.sqrt(1.0 - (task.radius / (task.radius + 1e-5)) ** 2)


@numba.njit(cache=True)
def steps_until_seen(positions, suns, points, radius, lowest, dimmest):
    """Say after how many periods each point is first seen, -1 for never.

    Args:
        positions: (k, 3) of the deputy, at every period's end, m; it looks at the chief with half a sphere of view.
        suns: (k, 3) unit vectors towards the sun.
        points: (n, 3) unit vectors.
        radius: of the chief's ball, m.
        lowest: what the point's height over the deputy's horizon must at least be, in radii (0: the task's rule).
        dimmest: least sine of the sun's height over the point's horizon.

    """
    seen = np.full(len(points), -1)
    for k in range(len(positions)):
        x, y, z = positions[k]
        distance = math.sqrt(x * x + y * y + z * z)
        least = radius / distance + lowest
        for i in range(len(points)):
            if seen[i] < 0:
                a, b, c = points[i]
                lit = a * suns[k, 0] + b * suns[k, 1] + c * suns[k, 2]
                if lit >= dimmest and (a * x + b * y + c * z) / distance >= least:
                    seen[i] = k
    return seen
