"""Plane regions of a mesh: faces that hang together across edges and lie in one plane."""

from typing import NamedTuple, no_type_check

import numba
import numpy as np
from jaxtyping import Float, Int

from keepout.apps.inspection.seeing.sides import neighbours
from keepout.core.geometry.mesh_report import weld, zero_area

# `no_type_check` below: run-time shape checks would wrap the functions that numba compiles.
FLAT = 2e-5
"""How far from the region's plane a corner of its faces may lie, m; well below the lift of sight lines."""
_ALIKE = 0.999
"""Least cosine between the normals of a region's faces."""


class Regions(NamedTuple):
    """Each region's plane with a grid's axes in it, and the region of each face."""

    region: Int[np.ndarray, " f"]
    """-1 for faces without area."""
    origin: Float[np.ndarray, "regions 3"]
    """A corner of the grid, m."""
    axes: Float[np.ndarray, "regions 3 3"]
    """Rows: along the region's longest border, across it, normal."""
    extent: Float[np.ndarray, "regions 2"]
    """The region's size along the first two axes, m."""


def regions(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Regions:
    """Grow regions from the largest face on; a region's plane is that of the face that it began with."""
    triangles = vertices[faces]
    a, b, c = np.moveaxis(triangles, 1, 0)
    normal = np.cross(b - a, c - a)
    double_area = np.linalg.norm(normal, axis=1)
    degenerate = zero_area(triangles)
    normal /= np.where(double_area > 0.0, double_area, 1.0)[:, None]
    across = neighbours(weld(vertices, faces))
    order = np.argsort(-double_area, kind="stable")
    region, count = _grow(np.ascontiguousarray(triangles), normal, degenerate, across, order[~degenerate[order]])
    seed = np.full(count, -1, dtype=np.int64)
    seed[region[order[::-1]]] = order[::-1]
    # The border: edges whose other face is of another region.
    border = np.where(across >= 0, region[across] != region[:, None], True) & (region >= 0)[:, None]
    face, corner = np.nonzero(border)
    along = triangles[face, (corner + 1) % 3] - triangles[face, corner]
    along -= np.einsum("ei,ei->e", along, normal[seed[region[face]]])[:, None] * normal[seed[region[face]]]
    shortest_first = np.argsort(np.linalg.norm(along, axis=1), kind="stable")
    first_axis = np.zeros((count, 3))
    first_axis[region[face[shortest_first]]] = along[shortest_first]
    first_axis /= np.linalg.norm(first_axis, axis=1, keepdims=True)
    third = normal[seed]
    axes = np.stack([first_axis, np.cross(third, first_axis), third], axis=1)
    of_region = np.flatnonzero(region >= 0)
    base = a[seed]
    local = np.einsum("fij,fkj->fki", axes[region[of_region]], triangles[of_region] - base[region[of_region]][:, None])
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    np.minimum.at(low, region[of_region], local[..., :2].min(axis=1))
    np.maximum.at(high, region[of_region], local[..., :2].max(axis=1))
    origin = base + np.einsum("ri,rij->rj", low, axes[:, :2])
    return Regions(np.where(degenerate, -1, region), origin, axes, high - low)


@numba.njit(cache=True, nogil=True)
@no_type_check
def _grow(triangles, normal, degenerate, across, seeds):
    region = np.full(len(triangles), -1, dtype=np.int64)
    waiting = np.empty(len(triangles), dtype=np.int64)
    count = 0
    for seed in seeds:
        if region[seed] >= 0:
            continue
        nx, ny, nz = normal[seed, 0], normal[seed, 1], normal[seed, 2]
        x, y, z = triangles[seed, 0, 0], triangles[seed, 0, 1], triangles[seed, 0, 2]
        region[seed] = count
        waiting[0] = seed
        depth = 1
        while depth > 0:
            depth -= 1
            face = waiting[depth]
            for side in range(3):
                other = across[face, side]
                if other < 0 or region[other] >= 0:
                    continue
                if not degenerate[other]:
                    alike = normal[other, 0] * nx + normal[other, 1] * ny + normal[other, 2] * nz
                    if alike < _ALIKE:
                        continue
                flat = True
                for k in range(3):
                    height = (
                        (triangles[other, k, 0] - x) * nx
                        + (triangles[other, k, 1] - y) * ny
                        + (triangles[other, k, 2] - z) * nz
                    )
                    flat = flat and abs(height) <= FLAT
                if flat:
                    region[other] = count
                    waiting[depth] = other
                    depth += 1
        count += 1
    return region, count
