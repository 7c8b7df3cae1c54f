"""What only a simulation can know: a map against the true mesh, promises broken, and the share that was seen."""

import math

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from keepout.apps.led.first_hit import FirstHit
from keepout.apps.unknown.by_map import DeclaredBall
from keepout.apps.unknown.known_free import KnownFreeMap
from keepout.core.cores import kernel
from keepout.core.geometry.target import Target
from keepout.core.mission.scenario import Scenario

_TOUCHED = 1e-9
"""Metres by which each side of a cube is moved inwards, so that a triangle that only touches it does not count."""
_SAMPLES = 4000
_DIRECTIONS = 64
_LIFT = 1e-3
"""Metres off the surface from which its rays begin."""


class WronglyFree:
    """Cubes that a map calls free although they hold a part of the true mesh, which only a simulation can know.

    They are what the assumptions of docs/mapping.md exclude. So this looks at assumption A1 wherever it matters, in
    every view, and misses no part however thin: where an image frees no such cube, nothing follows from a part that
    it did not meet.
    """

    def __init__(self, known: KnownFreeMap, target: Target) -> None:
        met = cubes_met(target.vertices, target.faces, known.origin, known.spacing, len(known.free))
        self._held = np.flatnonzero(met)
        self._before = self._count = int(known.free.ravel()[self._held].sum())
        self._first = math.inf

    def note(self, known: KnownFreeMap, now: float) -> None:
        """Look at the map after it has taken in an image of the time `now` (s)."""
        self._count = int(known.free.ravel()[self._held].sum())
        if self._count > self._before:
            self._first = min(self._first, now)

    def words(self, scenario: Scenario) -> tuple[str, ...]:
        """Say what was found; () where every free cube is."""
        told = []
        if self._before and scenario.map.file is not None:
            told.append(f"map.file: {self._before} cubes that it calls free hold a part of the target")
        if self._count > self._before:
            sensor = scenario.depth_sensor
            # Its other promises are kept wherever the simulation is not told to break one.
            why = f": assumption A1 (width {sensor.surely_returned_width:g} m) is broken"
            why = "" if sensor.broken != "none" else why
            told.append(
                f"{self._count - self._before} cubes that hold a part of the target were called free, the first by the "
                f"image at {self._first:g} s{why}"
            )
        return tuple(told)


def broken_promises(scenario: Scenario, target: Target, ball: DeclaredBall) -> tuple[str, ...]:
    """Name what the simulated world does beyond what ball and sensor promise, each with its numbers."""
    found = []
    reach = float(np.linalg.norm(target.vertices - np.asarray(ball.centre), axis=1).max())
    if reach > ball.radius:
        found.append(f"target: reaches {reach:.6g} m from map.centre > map.radius {ball.radius:.6g} m")
    if scenario.depth_sensor.broken != "none":
        found.append(f"depth_sensor.broken {scenario.depth_sensor.broken}")
    return tuple(found)


def cubes_met(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    origin: Float[np.ndarray, "3"],
    spacing: float,
    count: int,
) -> Bool[np.ndarray, "n n n"]:
    """Say of count³ cubes of edge `spacing` (m) from the corner `origin` (m) on which of them a mesh (m) meets.

    Exact but for rounding: what reaches less than a billionth of a metre into a cube may not count.
    """
    met = np.zeros((count, count, count), dtype=np.bool_)
    _meet((vertices[faces] - origin) / spacing, 0.5 - _TOUCHED / spacing, met)
    return met


@kernel()
def _meet(triangles, half, met):
    """Mark the unit cubes, cut to the half side `half`, that triangles in units of the edge meet.

    Two convex bodies are apart just where a plane parts them. Of a triangle and a cube it is enough to look along the
    cube's sides, along the triangle's normal, and along the products of their edges.
    """
    last = len(met) - 1
    axes = np.empty((13, 3))
    axes[:3] = np.eye(3)
    for t in range(len(triangles)):
        corners = triangles[t]
        for e in range(3):
            x, y, z = corners[(e + 1) % 3] - corners[e]
            axes[3 + 3 * e], axes[4 + 3 * e], axes[5 + 3 * e] = (0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)
        axes[12] = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        low, high = np.empty(13), np.empty(13)
        for a in range(13):
            along = corners @ axes[a]
            reach = half * np.abs(axes[a]).sum()
            low[a], high[a] = along.min() - reach, along.max() + reach
        for i in range(max(int(np.floor(low[0])), 0), min(int(np.floor(high[0])), last) + 1):
            for j in range(max(int(np.floor(low[1])), 0), min(int(np.floor(high[1])), last) + 1):
                for k in range(max(int(np.floor(low[2])), 0), min(int(np.floor(high[2])), last) + 1):
                    apart = met[i, j, k]
                    for a in range(13):
                        middle = (i + 0.5) * axes[a, 0] + (j + 0.5) * axes[a, 1] + (k + 0.5) * axes[a, 2]
                        if apart or middle < low[a] or middle > high[a]:
                            apart = True
                            break
                    if not apart:
                        met[i, j, k] = True


def open_surface(target: Target, first_hit: FirstHit) -> Float[np.ndarray, "m 3"]:
    """Sample the surface evenly by area, and give the points from which some of 64 directions leads out freely, m."""
    corners = target.vertices[target.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = 0.5 * np.linalg.norm(normals, axis=1)
    generator = np.random.default_rng(0)
    face = generator.choice(len(areas), _SAMPLES, p=areas / areas.sum())
    a, b = np.sqrt(generator.random(_SAMPLES)), generator.random(_SAMPLES)
    weights = np.stack([1.0 - a, a * (1.0 - b), a * b], axis=1)
    points = np.einsum("nk,nkx->nx", weights, corners[face])
    normal = normals[face] / (2.0 * areas[face, None])
    directions = generator.standard_normal((_SAMPLES, _DIRECTIONS, 3))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    side = np.sign(np.einsum("ndx,nx->nd", directions, normal))
    starts = points[:, None] + _LIFT * side[..., None] * normal[:, None]
    reach = 2.0 * float(np.linalg.norm(np.ptp(target.vertices, axis=0))) + 1.0
    hit = first_hit.ranges(starts.reshape(-1, 3), directions.reshape(-1, 3), reach)
    return points[np.isinf(hit).reshape(_SAMPLES, _DIRECTIONS).any(axis=1)]


def seen_share(surface: Float[np.ndarray, "m 3"], returns: Float[np.ndarray, "k 3"], within: float) -> float:
    """Give the share of surface points that have a return within so many metres."""
    if len(surface) == 0 or len(returns) == 0:
        return 0.0
    return float(np.mean(KDTree(returns).query(surface, distance_upper_bound=within)[0] < within))
