"""The part of a cube where the distance has one value: how large a linear function can be there.

A cube that meets {d = R} also holds points up to its diagonal off that surface, and a bound over the whole cube pays
for them. Every triangle's own distance d_T is convex, so d_T(p) ≥ d_T(c) + g·(p - c) with g its gradient at the cube's
centre c; where d(p) = R some triangle has d_T(p) = R, hence g·(p - c) ≤ R - d_T(c). The level set inside the cube lies
in the union of these half-spaces, over the triangles that come near enough.
"""

from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Float

from keepout.core.geometry import bvh
from keepout.core.geometry.distance import ExactDistance

_SLACK = 1e-9
"""Metres. Far above the rounding of the distances, far below any length that matters."""


def largest_on_level(
    distance: ExactDistance,
    level: float,
    centres: Float[np.ndarray, "n 3"],
    half_widths: Float[np.ndarray, "n"],
    slopes: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, "n"]:
    """Upper bound of slope·(p - c) over the points p of each cube with d(p) = level.

    Args:
        distance: exact unsigned distance to triangles.
        level: metres, positive.
        centres: c of each cube, metres.
        half_widths: of each cube, metres.
        slopes: of the linear function of each cube.

    Returns:
        The bound; minus infinity where the cube provably does not meet the level set.

    """
    answer = np.empty(len(centres))
    tree = distance.tree

    def work(part: slice) -> None:
        _largest(
            tree.lower,
            tree.upper,
            tree.right,
            tree.first,
            tree.amount,
            tree.corners,
            tree.plane,
            level,
            centres[part],
            half_widths[part],
            slopes[part],
            answer[part],
        )

    bvh.share_among_cores(work, len(centres))
    return answer


@numba.njit(cache=True, nogil=True)
@no_type_check
def _over_cut(v, g, half, limit):
    """Max v·q over |q_i| ≤ half, g·q ≤ limit: by duality the least over λ ≥ 0 of λ limit + half Σ|v_i - λ g_i|."""
    reach = half * (abs(g[0]) + abs(g[1]) + abs(g[2]))
    if -reach > limit:
        return -np.inf
    best = half * (abs(v[0]) + abs(v[1]) + abs(v[2]))
    for axis in range(3):
        if g[axis] != 0.0:
            factor = v[axis] / g[axis]
            if factor > 0.0:
                value = factor * limit
                for other in range(3):
                    value += half * abs(v[other] - factor * g[other])
                best = min(best, value)
    return best


@numba.njit(cache=True, nogil=True)
@no_type_check
def _largest(lower, upper, right, first, amount, corners, plane, level, centres, half_widths, slopes, answer):
    stack = np.empty(128, dtype=np.int64)
    g = np.empty(3)
    for i in range(len(centres)):
        x, y, z = centres[i, 0], centres[i, 1], centres[i, 2]
        half = half_widths[i]
        v = slopes[i]
        whole = half * (abs(v[0]) + abs(v[1]) + abs(v[2]))
        far = level + np.sqrt(3.0) * half + _SLACK
        best = -np.inf
        depth = 1
        stack[0] = 0
        while depth > 0 and best < whole:
            depth -= 1
            node = stack[depth]
            if bvh.box_distance_squared(lower, upper, node, x, y, z) > far * far:
                continue
            if amount[node] == 0:
                stack[depth] = right[node]
                stack[depth + 1] = node + 1
                depth += 2
                continue
            for triangle in range(first[node], first[node] + amount[node]):
                squared, qx, qy, qz = bvh.on_triangle(corners, plane, triangle, x, y, z)
                if squared > far * far:
                    continue
                d = np.sqrt(squared)
                if d < 1e-6:  # no gradient to speak of
                    best = whole
                    break
                g[0], g[1], g[2] = (x - qx) / d, (y - qy) / d, (z - qz) / d
                best = max(best, _over_cut(v, g, half, level - d + _SLACK))
        answer[i] = best
