"""The part of a surface that can be seen from outside at all, and the share of it that was."""

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from keepout.core.geometry.first_hit import FirstHit
from keepout.core.geometry.target import Target

_SAMPLES = 4000
_DIRECTIONS = 64
_LIFT = 1e-3
"""Metres off the surface from which its rays begin."""


def open_surface(target: Target, first_hit: FirstHit, *, seed: int = 0) -> Float[np.ndarray, "m 3"]:
    """Sample the surface evenly by area, and give the points from which some of 64 directions leads out freely, m."""
    corners = target.vertices[target.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = 0.5 * np.linalg.norm(normals, axis=1)
    generator = np.random.default_rng(seed)
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
