"""Where the surface that was seen departs from the mesh that a mission expected.

Both findings are theorems under the sensor's promises (docs/explore.md): what is reported is surely not as expected.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from keepout.apps.led.camera import Pinhole
from keepout.apps.unknown.known_free import LATTICE, KnownFreeMap
from keepout.core.geometry.level_set import surface_points
from keepout.core.geometry.target import Target

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
