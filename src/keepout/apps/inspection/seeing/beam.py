"""How near a camera may come along a beam of directions from a patch: where the room and the rules first allow it."""

from typing import NamedTuple, no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float, Int

from keepout.core.geometry.distance import box_distance_squared, on_triangle

# `no_type_check` below: run-time shape checks would wrap the functions that numba compiles.
_STEPS = 2000
"""Along a beam, at most; where they are used up the height reached so far stands."""
_FINENESS = 2e-4
"""Part of the stand-off, or of a height, to which the least height is found."""
_COARSENESS = 0.1
"""Part of the beam's width to which it is found where that is more."""


class Limits(NamedTuple):
    """What bounds the places of a camera, as the compiled loops take it."""

    lower: Float[np.ndarray, "nodes 3"]
    """This and the next five: of a `Tree`."""
    upper: Float[np.ndarray, "nodes 3"]
    right: Int[np.ndarray, " nodes"]
    first: Int[np.ndarray, " nodes"]
    amount: Int[np.ndarray, " nodes"]
    triangles: Float[np.ndarray, "f 3 3"]
    plane: Float[np.ndarray, "f 9"]
    child: Int[np.ndarray, "nodes 8"]
    """Of the room's octree; see `Cells.child`."""
    possible: Bool[np.ndarray, " cells"]
    """Cells that may hold a place of the room."""
    origin: Float[np.ndarray, " 3"]
    depth: int
    unit: float
    """Side of the octree's smallest cells, m."""
    stand_off: float
    """m, positive."""
    least_range: float
    greatest_range: float
    spread: float
    """Tangent of the greatest incidence."""
    finest: float
    """Greatest square of the range over the height, m."""


@numba.njit(cache=True, nogil=True)
@no_type_check
def _distance(limits, x, y, z, stack, bounds):
    """Distance from a point to the mesh."""
    lower, upper = limits.lower, limits.upper
    best = np.inf
    stack[0], bounds[0] = 0, 0.0
    depth = 1
    while depth > 0:
        depth -= 1
        if bounds[depth] >= best:
            continue
        node = stack[depth]
        while node >= 0 and limits.amount[node] == 0:
            near, far = node + 1, limits.right[node]
            near_bound = box_distance_squared(lower, upper, near, x, y, z)
            far_bound = box_distance_squared(lower, upper, far, x, y, z)
            if far_bound < near_bound:
                near, far = far, near
                near_bound, far_bound = far_bound, near_bound
            if far_bound < best:
                stack[depth], bounds[depth] = far, far_bound
                depth += 1
            node = near if near_bound < best else -1
        if node >= 0:
            for t in range(limits.first[node], limits.first[node] + limits.amount[node]):
                best = min(best, on_triangle(limits.triangles, limits.plane, t, x, y, z)[0])
    return np.sqrt(best)


@numba.njit(cache=True, nogil=True)
@no_type_check
def meets(child, levels, possible, origin, unit, box, stack, corners):
    """Whether a box (lower corner, upper corner; m) meets a cell of possible room, or leaves the cube."""
    whole = float(1 << levels)
    x0, x1 = (box[0] - origin[0]) / unit, (box[3] - origin[0]) / unit
    y0, y1 = (box[1] - origin[1]) / unit, (box[4] - origin[1]) / unit
    z0, z1 = (box[2] - origin[2]) / unit, (box[5] - origin[2]) / unit
    if min(x0, y0, z0) < 0.0 or max(x1, y1, z1) > whole:
        return True
    stack[0] = 0
    corners[0, 0], corners[0, 1], corners[0, 2], corners[0, 3] = 0.0, 0.0, 0.0, whole
    waiting = 1
    while waiting > 0:
        waiting -= 1
        node, half = stack[waiting], 0.5 * corners[waiting, 3]
        x, y, z = corners[waiting, 0], corners[waiting, 1], corners[waiting, 2]
        for k in range(8):
            cx, cy, cz = x + (k & 1) * half, y + ((k >> 1) & 1) * half, z + ((k >> 2) & 1) * half
            if x1 < cx or x0 > cx + half or y1 < cy or y0 > cy + half or z1 < cz or z0 > cz + half:
                continue
            entry = child[node, k]
            if entry >= 0:
                stack[waiting] = entry
                corners[waiting, 0], corners[waiting, 1], corners[waiting, 2] = cx, cy, cz
                corners[waiting, 3] = half
                waiting += 1
            elif possible[~entry]:
                return True
    return False


@numba.njit(cache=True, nogil=True)
@no_type_check
def boxes_meet(child, levels, possible, origin, unit, boxes):
    """Whether each box (n, 6) meets a chosen cell; see `meets`."""
    answer = np.empty(len(boxes), dtype=np.bool_)
    stack, corners = np.empty(192, dtype=np.int64), np.empty((192, 4))
    for i in range(len(boxes)):
        answer[i] = meets(child, levels, possible, origin, unit, boxes[i], stack, corners)
    return answer


@numba.njit(cache=True, nogil=True)
@no_type_check
def _in_room(limits, box, stack, corners):
    return meets(limits.child, limits.depth, limits.possible, limits.origin, limits.unit, box, stack, corners)


@numba.njit(cache=True, nogil=True)
@no_type_check
def least_height(limits, frame, outline, count, wx, wy, half, height, stack, bounds, corners, box):
    """Give a height below which no place in a square of directions is allowed; inf where none is at any height.

    Args:
        limits: what bounds the places.
        frame: (4, 3) the patch's centre, two axes in its plane, and the normal of the unit.
        outline: (k, 2) corners of the patch in these axes, m.
        count: how many.
        wx: middle of the square.
        wy: the same.
        half: half its side.
        height: below which none is allowed, as known, m.
        stack: and the next three: room to work in.
        bounds: see there.
        corners: see there.
        box: (6,).

    """
    nearest = max(abs(wx) - half, 0.0) ** 2 + max(abs(wy) - half, 0.0) ** 2
    slant, across = np.sqrt(1.0 + wx * wx + wy * wy), half * np.sqrt(2.0)
    fastest = slant + across
    for _ in range(_STEPS):
        if height * np.sqrt(1.0 + nearest) >= limits.greatest_range or height * (1.0 + nearest) > limits.finest:
            return np.inf
        # A corner a is seen at the tangent |w - a / height|, at most `spread`, and at height * (1 + tangent²)^(1/2).
        raised = height
        for j in range(count):
            dx, dy = abs(wx - outline[j, 0] / height), abs(wy - outline[j, 1] / height)
            least, most = max(dx - half, 0.0) ** 2 + max(dy - half, 0.0) ** 2, (dx + half) ** 2 + (dy + half) ** 2
            excess, reach = np.sqrt(least) - limits.spread, np.sqrt(outline[j, 0] ** 2 + outline[j, 1] ** 2)
            if excess > 0.0:
                inverse = 1.0 / height - excess / reach
                if inverse <= 1e-9:
                    return np.inf
                raised = max(raised, 1.0 / inverse)
            # Distances change by at most `fastest` a metre of height.
            far, near = height * np.sqrt(1.0 + least), height * np.sqrt(1.0 + most)
            raised = max(raised, height + (far - limits.greatest_range) / fastest)
            raised = max(raised, height + (limits.least_range - near) / fastest)
            if limits.finest < np.inf:
                raised = max(
                    raised, height + (far * far - limits.finest * height) / (2.0 * far * fastest + limits.finest)
                )
        if raised > height * (1.0 + max(_FINENESS, _COARSENESS * across)):
            height += (raised - height) * (1.0 - 1e-9)
            continue
        x = frame[0, 0] + height * (wx * frame[1, 0] + wy * frame[2, 0] + frame[3, 0])
        y = frame[0, 1] + height * (wx * frame[1, 1] + wy * frame[2, 1] + frame[3, 1])
        z = frame[0, 2] + height * (wx * frame[1, 2] + wy * frame[2, 2] + frame[3, 2])
        # Places nearer to this one than that are nearer to the mesh than the stand-off.
        ball = limits.stand_off - _distance(limits, x, y, z, stack, bounds) - height * across
        if ball > max(_FINENESS * limits.stand_off, _COARSENESS * height * across):
            height += ball * (1.0 - 1e-9) / fastest
            continue
        if height * across > 4.0 * limits.unit:
            return height
        moved = False
        for step in (8.0 * limits.unit, 2.0 * limits.unit, 0.5 * limits.unit):
            wide = (height + step) * half
            for k in range(3):
                along = step * (wx * frame[1, k] + wy * frame[2, k] + frame[3, k])
                here = x if k == 0 else (y if k == 1 else z)
                beside = wide * (abs(frame[1, k]) + abs(frame[2, k])) + 1e-9
                box[k], box[3 + k] = here + min(along, 0.0) - beside, here + max(along, 0.0) + beside
            if not _in_room(limits, box, stack, corners):
                height += step
                moved = True
                break
        if not moved:
            return height
    return height


@numba.njit(cache=True, nogil=True)
@no_type_check
def first_place(limits, frame, outline, count, wx, wy, height, stack, bounds, corners, box):
    """Give the least height found, from one on, at which a place in one direction keeps room and rules; inf if none."""
    slant = np.sqrt(1.0 + wx * wx + wy * wy)
    for _ in range(_STEPS):
        if height * slant >= limits.greatest_range:
            return np.inf
        farthest, nearest = 0.0, np.inf
        for j in range(count):
            square = (wx - outline[j, 0] / height) ** 2 + (wy - outline[j, 1] / height) ** 2
            farthest, nearest = max(farthest, square), min(nearest, square)
        if farthest > (limits.spread * (1.0 - 1e-9)) ** 2:
            height *= 1.01
            continue
        if height * (1.0 + farthest) > limits.finest or height * np.sqrt(1.0 + nearest) <= limits.least_range:
            height *= 1.01
            continue
        if height * np.sqrt(1.0 + farthest) >= limits.greatest_range:
            return np.inf
        x = frame[0, 0] + height * (wx * frame[1, 0] + wy * frame[2, 0] + frame[3, 0])
        y = frame[0, 1] + height * (wx * frame[1, 1] + wy * frame[2, 1] + frame[3, 1])
        z = frame[0, 2] + height * (wx * frame[1, 2] + wy * frame[2, 2] + frame[3, 2])
        short = limits.stand_off + 1e-6 - _distance(limits, x, y, z, stack, bounds)
        if short > 0.0:
            height += max(short / slant, _FINENESS * limits.stand_off)
            continue
        box[0], box[1], box[2], box[3], box[4], box[5] = x, y, z, x, y, z
        if _in_room(limits, box, stack, corners):
            return height
        height += 0.5 * limits.unit
    return np.inf
