"""What an exploration leaves: the map, the flight, every view, and the verdict on the true mesh.

Beside it stands what is said of the map: where the seen surface departs from the mesh that the mission expected, which
is a theorem under the sensor's promises (docs/explore.md); and, as only a simulation can know, how the map compares
with the true mesh, which promises were broken, and what share was seen.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from scipy.spatial import KDTree

from keepout.apps.led.camera import Pinhole
from keepout.apps.led.driver import Led
from keepout.apps.led.first_hit import FirstHit
from keepout.apps.unknown.by_map import DeclaredBall
from keepout.apps.unknown.known_free import LATTICE, KnownFreeMap
from keepout.apps.unknown.next_view import Ending
from keepout.apps.unknown.skin import Stage
from keepout.core.cores import kernel
from keepout.core.geometry.level_set import surface_points
from keepout.core.geometry.target import Target
from keepout.core.mission.scenario import Scenario

SAMPLES_A_SQUARE, FEWEST, MOST = 4, 20_000, 400_000
"""Points of the expected surface that are looked up: so many a square as large as a cube's side, within limits."""
_ROUNDING = 1e-5
"""Metres: more than what 32-bit coordinates of returns and 64-bit arithmetic move a point by."""


@dataclass(frozen=True)
class Departures:
    """Where what was seen is not what was expected.

    Attributes:
        points: (k, 3) returns farther from the expected mesh than the sensor's errors explain, m, map frame.
        distance: (k,) of each from the expected mesh, m; more than `explained`.
        missing: (m, 3) points of the expected surface in room that is known to be free, m.
        depth: (m,) how far at least each is from everything that may be target, m; at most the map's cap.
        explained: the greatest distance between a return and the surface that it came from, m.
        missing_area: of the expected surface that `missing` stands for, m²: a mean over random points.

    """

    points: Float32[np.ndarray, "k 3"]
    distance: Float[np.ndarray, "k"]
    missing: Float[np.ndarray, "m 3"]
    depth: Float[np.ndarray, "m"]
    explained: float
    missing_area: float

    @property
    def largest(self) -> float:
        """Greatest of all distances and depths, m; 0 where nothing departs."""
        return float(max(self.distance.max(initial=0.0), self.depth.max(initial=0.0)))


def explained_distance(known: KnownFreeMap, camera: Pinhole) -> float:
    """Bound the distance between a return of the map and the surface that it came from, m.

    It is the error of a return at the greatest range, and half the diagonal of the lattice that returns are kept on.
    """
    lattice = 0.5 * math.sqrt(3.0) * known.spacing / LATTICE
    return float(known.bounds.return_error(camera, np.array([known.bounds.greatest_range]))[0]) + lattice + _ROUNDING


def departures(known: KnownFreeMap, expected: Target, camera: Pinhole) -> Departures:
    """Say where the seen surface is not where the expected mesh has it, and which expected surface is not there.

    Args:
        known: the map, whose sensor kept its promises.
        expected: the mesh that the mission believes in, in the map's frame.
        camera: that took the views: the width of its pixels is part of a return's error.

    """
    explained = explained_distance(known, camera)
    returns = known.returns
    distance = expected.distance.distance(returns.astype(np.float64))
    elsewhere = distance > explained
    area = expected.distance.area
    count = int(np.clip(SAMPLES_A_SQUARE * area / known.spacing**2, FEWEST, MOST))
    surface = surface_points(expected.distance, count, np.random.default_rng(0))
    missing = surface[known.is_free(surface)]
    return Departures(
        points=returns[elsewhere],
        distance=distance[elsewhere],
        missing=missing,
        depth=_depth(known, missing),
        explained=explained,
        missing_area=area * len(missing) / count,
    )


def _depth(known: KnownFreeMap, points: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "m"]:
    """Bound from below how far points are from every cube that is not free, m: the best bound from a cube's corners.

    The distance is 1-Lipschitz, so it is at least a corner's less the way to the corner. Outside the grid all is free,
    and the corners on its border are at the cap.
    """
    place = (points - known.origin) / known.spacing
    last = len(known.free)
    best = np.zeros(len(points))
    for corner in np.ndindex(2, 2, 2):
        node = np.clip(np.floor(place) + corner, 0, last).astype(np.int64)
        away = known.spacing * np.linalg.norm(place - node, axis=1)
        there = known.spacing * np.sqrt(known.squares[tuple(node.T)].astype(np.float64))
        best = np.maximum(best, np.minimum(there - away, known.cap))
    return best


@dataclass(frozen=True)
class TakenView:
    """One depth image of a flight, and what it opened.

    Attributes:
        time: of the image, s.
        position: (3,) of the sensor, m, map frame: the truth.
        direction: (3,) unit vector of the boresight, map frame.
        status: "seen", or why the map did not take it.
        opened: cubes that became free.
        free_volume: known-free room inside the declared ball after it, m³.
        why: what the planner wanted when it was taken.
        contradicting: returns in it that prove that a promise of ball or sensor is broken.

    """

    time: float
    position: Float[np.ndarray, "3"]
    direction: Float[np.ndarray, "3"]
    status: str
    opened: int
    free_volume: float
    why: str
    contradicting: int = 0


@dataclass(frozen=True, eq=False)
class Exploration(Led):
    """One exploration: a flight, and what was found.

    Attributes:
        outcome: how it ended.
        expected: the mesh that the mission believed in, or None.
        map: at the end.
        views: every image.
        stages: the skin of the map at some times.
        seen_share: of the true surface's reachable part, the share within `explore.explained` of a return.
        unknown: (m, 3) centres of the cubes that were in the way at the end, m.
        departures: where the seen surface is not what was expected; None where nothing was.
        keep: the distance from all that is not known free that ways of the chaser's centre were looked for with, m.

    """

    outcome: Ending
    expected: Target | None
    map: KnownFreeMap
    views: tuple[TakenView, ...]
    stages: tuple[Stage, ...]
    seen_share: float
    unknown: Float[np.ndarray, "m 3"]
    departures: Departures | None
    keep: float

    def summary(self) -> dict[str, Any]:
        """Give the figures as plain numbers for JSON.

        `contact` is true unless the audit proves that there was none; `contact_verdict` tells the cases apart.
        """
        refused = [view.status for view in self.views if view.status != "seen"]
        return {
            "outcome": self.outcome,
            "why": self.why,
            "reached": self.outcome == "reached goal",
            **self.contact_figures(),
            "seen_share": self.seen_share,
            "views": len(self.views),
            "refused_views": {status: refused.count(status) for status in sorted(set(refused))},
            "contradicting_returns": sum(view.contradicting for view in self.views),
            "opened_m3": sum(view.opened for view in self.views) * self.map.spacing**3,
            "duration_s": float(self.record.time[-1]),
            "delta_v_mps": float(self.flown.delta_v),
            "guard_interventions": int(self.flown.guard_interventions),
            "guard_flags": self.flight.guard_flags(),
            "start_certified": bool(self.start_certified),
            "assumptions_broken": list(self.assumptions_broken),
            "departures_largest_m": None if self.departures is None else self.departures.largest,
            "guard": self.guard or {},
            "seconds": self.seconds,
        }


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
    axes, edges = np.zeros((13, 3)), np.empty((3, 3))
    low, high = np.empty(13), np.empty(13)
    for t in range(len(triangles)):
        corners = triangles[t]
        for e in range(3):
            for axis in range(3):
                edges[e, axis] = corners[(e + 1) % 3, axis] - corners[e, axis]
            axes[e, e] = 1.0
            for axis in range(3):
                after, before = (axis + 1) % 3, (axis + 2) % 3
                axes[3 + 3 * e + axis, after], axes[3 + 3 * e + axis, before] = -edges[e, before], edges[e, after]
        for axis in range(3):
            after, before = (axis + 1) % 3, (axis + 2) % 3
            axes[12, axis] = edges[0, after] * edges[1, before] - edges[0, before] * edges[1, after]
        for a in range(13):
            x, y, z = axes[a, 0], axes[a, 1], axes[a, 2]
            reach = half * (abs(x) + abs(y) + abs(z))
            low[a], high[a] = np.inf, -np.inf
            for corner in range(3):
                along = corners[corner, 0] * x + corners[corner, 1] * y + corners[corner, 2] * z
                low[a], high[a] = min(low[a], along - reach), max(high[a], along + reach)
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
