"""Branch and bound over the directions from a patch: a place that sees it, or the proof that there is none."""

from typing import no_type_check

import numba
import numpy as np

from keepout.apps.inspection.seeing import pyramid_kernel
from keepout.apps.inspection.seeing.beam import first_place, least_height
from keepout.apps.inspection.seeing.pyramid_kernel import LIFT
from keepout.apps.inspection.seeing.shadow import MOST_EDGES, covers, shadow

# `no_type_check` below: run-time shape checks would wrap the functions that numba compiles.
SEEN, NONE, OPEN = 0, 1, 2
"""What a search ends with: a place, the proof that there is none, or neither."""
_KEPT = 96
"""Shadows that are tried before a ray is sent."""
_SMALLEST = 1e-9
"""Half the side of a square of directions that is not split further."""


@numba.njit(cache=True, nogil=True)
@no_type_check
def _blocker(tree, depth_stack, frame, patch, count, wx, wy, height, rounding, planes, plane, work, heights):
    """Give a triangle that may stand between a place and the whole of a patch; -1 where all are proved to pass."""
    gx = height * (wx * frame[1, 0] + wy * frame[2, 0] + frame[3, 0])
    gy = height * (wx * frame[1, 1] + wy * frame[2, 1] + frame[3, 1])
    gz = height * (wx * frame[1, 2] + wy * frame[2, 2] + frame[3, 2])
    cx, cy, cz = frame[0, 0], frame[0, 1], frame[0, 2]
    low = LIFT / height
    found = pyramid_kernel.ray_blocker(
        tree.boxes, tree.children, tree.first, tree.corners, depth_stack, cx, cy, cz, gx, gy, gz, low, 1.0 - low
    )
    if found >= 0:
        return found
    qx, qy, qz = cx + gx, cy + gy, cz + gz
    # The patch runs counter-clockwise about the unit's normal: its way is 1.
    sides = pyramid_kernel.bounding_planes(patch, count, 1.0, 1.0, qx, qy, qz, 0.0, planes)
    base = -np.inf
    for k in range(count):
        base = max(base, frame[3, 0] * patch[k, 0] + frame[3, 1] * patch[k, 1] + frame[3, 2] * patch[k, 2])
    plane[0], plane[1], plane[2], plane[3] = frame[3, 0], frame[3, 1], frame[3, 2], base
    top = frame[3, 0] * qx + frame[3, 1] * qy + frame[3, 2] * qz - base - LIFT
    return pyramid_kernel.pyramid_blocker(
        tree.boxes, tree.children, tree.first, tree.corners, depth_stack, patch, count, plane, top, planes, sides, 1.0,
        qx, qy, qz, rounding, work, heights,
    )  # fmt: skip


@numba.njit(cache=True, nogil=True)
@no_type_check
def search(tree, deepest, limits, frames, outlines, patches, counts, heights, largest, most, ends, places, looked):
    """Search for each unit.

    Args:
        tree: a `RayTree` of the mesh.
        deepest: its levels, at most.
        limits: what bounds the places.
        frames: (m, 4, 3) centre, two axes in the plane, normal of each unit.
        outlines: (m, k, 2) corners in these axes about the centre, counter-clockwise about the normal, m.
        patches: (m, k, 3) the same corners in the body frame, m.
        counts: (m,) of each.
        heights: (m,) below which no place is allowed, m.
        largest: coordinate of the mesh and the places, m.
        most: squares of directions looked at, a unit.
        ends: (m,) SEEN, NONE or OPEN, to be filled.
        places: (m, 3) from which the unit is seen, to be filled where there is one.
        looked: (m,) squares looked at, to be filled.

    """
    stack, bounds = np.empty(192, dtype=np.int64), np.empty(192)
    corners, box = np.empty((192, 4)), np.empty(6)
    ray_stack = np.empty(deepest, dtype=np.int64)
    planes, plane = np.empty((patches.shape[1], 4)), np.empty(4)
    polygons, levels = np.empty((2, 8, 3)), np.empty((2, 8))
    edges, numbers, made = np.empty((_KEPT, MOST_EDGES, 3)), np.zeros(_KEPT, dtype=np.int64), np.empty(_KEPT)
    work, spare = np.empty((8, 3)), np.empty((8, 3))
    points, chain = np.empty((MOST_EDGES, 3)), np.empty(2 * MOST_EDGES, dtype=np.int64)
    queue = np.empty((4 * most + 8, 4))
    reach = 1.5 * limits.spread
    rounding = 64 * np.finfo(np.float64).eps * largest
    for m in range(len(ends)):
        frame, outline, patch, count = frames[m], outlines[m], patches[m], counts[m]
        kept, latest = 0, 0
        queue[0, 0], queue[0, 1], queue[0, 2], queue[0, 3] = 0.0, 0.0, limits.spread, heights[m]
        head, tail = 0, 1
        ends[m] = NONE
        while head < tail:
            if head >= most:
                ends[m] = OPEN
                break
            x, y, half, height = queue[head, 0], queue[head, 1], queue[head, 2], queue[head, 3]
            head += 1
            if max(abs(x) - half, 0.0) ** 2 + max(abs(y) - half, 0.0) ** 2 > limits.spread**2:
                continue
            done = False
            for turn in range(2):
                for k in range(kept):
                    slot = (latest - k) % _KEPT
                    if made[slot] <= height and numbers[slot] > 0 and covers(edges[slot], numbers[slot], x, y, half):
                        done = True
                        break
                if done or turn == 1:
                    break
                raised = least_height(limits, frame, outline, count, x, y, half, height, stack, bounds, corners, box)
                if raised == np.inf:
                    done = True
                if done or raised == height:
                    break
                height = raised
            if done:
                continue
            found = _blocker(
                tree, ray_stack, frame, patch, count, x, y, height, rounding, planes, plane, polygons, levels
            )
            if found < 0:
                # What is blocked at a height is blocked at every greater one, so only the first place is asked for.
                first = np.inf
                if x * x + y * y < limits.spread**2:
                    first = first_place(limits, frame, outline, count, x, y, height, stack, bounds, corners, box)
                if first < np.inf:
                    found = _blocker(
                        tree, ray_stack, frame, patch, count, x, y, first, rounding, planes, plane, polygons, levels
                    )
                    if found < 0:
                        for k in range(3):
                            places[m, k] = frame[0, k] + first * (x * frame[1, k] + y * frame[2, k] + frame[3, k])
                        ends[m] = SEEN
                        break
            if found >= 0:
                latest = (latest + 1) % _KEPT
                kept = min(kept + 1, _KEPT)
                made[latest] = height
                numbers[latest] = shadow(
                    tree.corners, found, frame, outline, count, height, reach, largest, edges[latest], work, spare,
                    points, chain,
                )  # fmt: skip
                if numbers[latest] > 0 and covers(edges[latest], numbers[latest], x, y, half):
                    continue
            if half < _SMALLEST:
                ends[m] = OPEN
                break
            for k in range(4):
                queue[tail, 0] = x + (0.5 if k & 1 else -0.5) * half
                queue[tail, 1] = y + (0.5 if k & 2 else -0.5) * half
                queue[tail, 2], queue[tail, 3] = 0.5 * half, height
                tail += 1
        looked[m] = head


@numba.njit(cache=True, nogil=True)
@no_type_check
def all_blocked(tree, deepest, frames, rays, blocked):
    """Say of units whether all rays from their middle meet the mesh.

    Args:
        tree: a `RayTree` of the mesh.
        deepest: its levels, at most.
        frames: (m, 4, 3) centre, two axes in the plane, normal of each unit.
        rays: (k, 3) unit vectors in these axes, above the plane or along it.
        blocked: (m,) to be filled.

    """
    stack = np.empty(deepest, dtype=np.int64)
    for m in range(len(blocked)):
        f = frames[m]
        x, y, z = f[0, 0] + LIFT * f[3, 0], f[0, 1] + LIFT * f[3, 1], f[0, 2] + LIFT * f[3, 2]
        blocked[m] = True
        for k in range(len(rays)):
            gx = rays[k, 0] * f[1, 0] + rays[k, 1] * f[2, 0] + rays[k, 2] * f[3, 0]
            gy = rays[k, 0] * f[1, 1] + rays[k, 1] * f[2, 1] + rays[k, 2] * f[3, 1]
            gz = rays[k, 0] * f[1, 2] + rays[k, 1] * f[2, 2] + rays[k, 2] * f[3, 2]
            found = pyramid_kernel.ray_blocker(
                tree.boxes, tree.children, tree.first, tree.corners, stack, x, y, z, gx, gy, gz, 0.0, np.inf
            )
            if found < 0:
                blocked[m] = False
                break
