"""What is wrong in a known-free map, counted against the true mesh, and how much of what is free it does not know.

A cube is bad where it is said to be free and meets a triangle (`apps/unknown/exploration.py`; touching does not count).
The field f over-states at a point p where f(p) > sqrt(d(p)² + h²), d the exact distance of p to the mesh, h the cubes'
edge: what docs/mapping.md proves not to happen.
"""

import math
from dataclasses import dataclass

import equinox as eqx
import jax
import numba
import numpy as np

from keepout.apps.led.first_hit import FirstHit
from keepout.apps.unknown.exploration import cubes_met
from keepout.core.fields.field import Field
from keepout.core.geometry.level_set import sharp_points, surface_points
from keepout.core.geometry.target import Target

BAND = 1.2
"""Metres from the surface within which points are drawn."""
THIN = 0.1
"""Metres of solid behind a point below which it is on a thin part."""
STEPS = 20
"""Of an ascent; each visits a point that counts."""
_FIRST_STEP, _SHORTER = 0.08, 0.85
_BATCH = 50_000
_POOL = 4
"""Points tried for each that an ascent begins from."""


def meeting(target, known):
    """Say which cubes of a map's grid meet a triangle."""
    return cubes_met(target.vertices, target.faces, known.origin, known.spacing, len(known.free))


def bad_cubes(known, met):
    """Give the indices (m, 3) of the cubes of a map that are said to be free and meet the mesh, as `meeting` says."""
    return np.argwhere(met & known.free)


@dataclass
class OverStatements:
    """Points looked at, over-statements found, and the largest f - sqrt(d² + h²) met, m (below 0: none)."""

    random: int = 0
    by_ascent: int = 0
    found: int = 0
    largest_excess: float = -math.inf

    def count(self, excess, allowed):
        """Count points by how far f is above its bound; `allowed` is what rounding explains."""
        self.found += int((excess > allowed).sum())
        self.largest_excess = max(self.largest_excess, float(excess.max(initial=-math.inf)))


@eqx.filter_jit
def _evaluated(field, points):
    return field.value_and_gradient(points)


class _Excess:
    """f - sqrt(d² + h²) and its gradient."""

    def __init__(self, field: Field, target: Target, spacing: float):
        self.field, self.distance, self.spacing = field, target.distance, spacing

    def __call__(self, points):
        f, slope = (np.asarray(a) for a in jax.block_until_ready(_evaluated(self.field, points)))
        d, closest, _ = self.distance.closest(points)
        bound = np.sqrt(d * d + self.spacing**2)
        return f - bound, slope - (points - closest) / bound[:, None]


def over_statements(field, target, spacing, points, generator, *, allowed=0.0):
    """Look at so many points, half of them random, half sought by ascent from the worst near edges and thin parts.

    Args:
        field: with `value_and_gradient`, a distance in m.
        target: the true mesh.
        spacing: h, m.
        points: in all, rounded up to whole batches.
        generator: of random numbers.
        allowed: what rounding explains, m.

    """
    found, excess = OverStatements(), _Excess(field, target, spacing)
    starts = _BATCH // STEPS
    thin = _thin_points(target, generator)
    while found.random + found.by_ascent < points:
        # The worst of all drawn in a round become the starts of its ascents.
        near = [surface_points(target.distance, _BATCH - _POOL * starts, generator, by_area=0.5)]
        near.append(sharp_points(target.distance, (_POOL - 2) * starts, generator))
        near.append(thin[generator.integers(len(thin), size=2 * starts)] if len(thin) else near[0][: 2 * starts])
        drawn = np.concatenate(near)
        reach = np.concatenate([np.full(len(near[0]), BAND), np.full(_POOL * starts, 0.5 * BAND)])
        drawn += (reach * generator.random(len(drawn)))[:, None] * _directions(len(drawn), generator)
        value, slope = excess(drawn)
        found.count(value, allowed)
        found.random += len(drawn)
        worst = np.argsort(value)[-starts:]
        at, slope, step = drawn[worst], slope[worst], _FIRST_STEP
        ended = np.concatenate([at] * STEPS)
        for i in range(STEPS):
            length = np.linalg.norm(slope, axis=1, keepdims=True)
            at = at + step * slope / np.where(length > 0.0, length, 1.0)
            value, slope = excess(at)
            found.count(value, allowed)
            ended[i * starts : (i + 1) * starts] = at
            step *= _SHORTER
        found.by_ascent += len(ended)
    return found


def _directions(count, generator):
    ways = generator.normal(size=(count, 3))
    return ways / np.linalg.norm(ways, axis=1, keepdims=True)


def _thin_points(target, generator, count=20_000):
    """Points of the surface with less than THIN of solid behind them, or nothing behind them that faces away."""
    points = surface_points(target.distance, count, generator, by_area=0.5)
    normal = normals(target)[target.distance.closest(points)[2]]
    points, normal = points[normal.any(axis=1)], normal[normal.any(axis=1)]
    behind = FirstHit(target.vertices, target.faces).ranges(points - 1e-5 * normal, -normal, 10.0 * THIN)
    return points[behind < THIN]


def normals(target):
    """Give the unit normals of the faces; zeros for a face without area."""
    return FirstHit(target.vertices, target.faces).normals


@dataclass(frozen=True)
class SeenSurface:
    """Points of the surface that some view saw from near enough, and the normal on the side that it saw."""

    points: np.ndarray
    normals: np.ndarray


def seen_surface(target, first_hit, camera, poses, generator, *, within=5.0, count=20_000):
    """Draw points evenly from the surface, and keep those seen by a view from `within` m: in its image, not hidden.

    Args:
        target: the true mesh.
        first_hit: of it.
        camera: `Pinhole`.
        poses: true place and axes of each view.
        generator: of random numbers.
        within: m.
        count: points drawn.

    """
    points = surface_points(target.distance, count, generator)
    normal = first_hit.normals[target.distance.closest(points)[2]]
    seen, side = np.zeros(len(points), bool), np.ones(len(points))
    for place, axes in poses:
        x, y, z = ((points - place) @ axes).T
        inside = (z > 0.0) & (np.abs(x) * camera.focal < 0.5 * camera.width * z)
        inside &= (np.abs(y) * camera.focal < 0.5 * camera.height * z) & ~seen & normal.any(axis=1)
        chosen = np.flatnonzero(inside)
        away = np.linalg.norm(points[chosen] - place, axis=1)
        chosen, away = chosen[away <= within], away[away <= within]
        if len(chosen) == 0:
            continue
        hit = first_hit.ranges(place[None], points[chosen] - place)
        chosen = chosen[hit >= away * (1.0 - 1e-6)]
        seen[chosen] = True
        side[chosen] = np.sign(np.einsum("ni,ni->n", normal[chosen], place - points[chosen]))
    return SeenSurface(points[seen], (normal * side[:, None])[seen])


@numba.njit(cache=True, nogil=True)
def _gaps(points, normals, free, origin, spacing, farthest, gaps):
    span = math.ceil(farthest / spacing) + 1
    for n in range(len(points)):
        best = farthest * farthest
        cell = np.floor((points[n] - origin) / spacing)
        for i in range(max(int(cell[0]) - span, 0), min(int(cell[0]) + span + 1, free.shape[0])):
            for j in range(max(int(cell[1]) - span, 0), min(int(cell[1]) + span + 1, free.shape[1])):
                for k in range(max(int(cell[2]) - span, 0), min(int(cell[2]) + span + 1, free.shape[2])):
                    if not free[i, j, k]:
                        continue
                    ahead, square = 0.0, 0.0
                    for axis, index in ((0, i), (1, j), (2, k)):
                        offset = origin[axis] + spacing * (index + 0.5) - points[n, axis]
                        ahead += offset * normals[n, axis]
                        square += max(abs(offset) - 0.5 * spacing, 0.0) ** 2
                    if ahead > 0.0:
                        best = min(best, square)
        gaps[n] = math.sqrt(best)


def gaps(known, seen: SeenSurface, farthest=1.5):
    """Distance (n,) m of each seen point to the nearest free cube on the side it was seen from; at most `farthest`."""
    answer = np.empty(len(seen.points))
    _gaps(seen.points, seen.normals, known.free, known.origin, known.spacing, farthest, answer)
    return answer


def under_statements(field, target, seen: SeenSurface, out=1.0):
    """Distance less field (n,) m at `out` metres from seen points along the normal, where these are the nearest."""
    points = seen.points + out * seen.normals
    distance = target.distance.distance(points)
    points, distance = points[distance > out - 1e-6], distance[distance > out - 1e-6]
    return distance - np.asarray(field.value(jax.numpy.asarray(points)))
