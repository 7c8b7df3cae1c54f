"""Which cubes of a grid a mesh meets, triangle by triangle: no line in space parts the two, or they meet."""

from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float, Int

_ROUNDING = 1e-9
"""Metres by which each side of a cube is moved inwards, so that a triangle that only touches it does not count."""


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
    _meet((vertices[faces] - origin) / spacing, 0.5 - _ROUNDING / spacing, met)
    return met


@no_type_check
@numba.njit(cache=True, nogil=True)
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
