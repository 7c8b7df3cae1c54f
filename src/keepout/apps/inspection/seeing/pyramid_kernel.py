"""Whether triangles reach into the pyramids from places, or the prisms from the sun, to patches: compiled loops.

A place and the sun are one case here: the line of sight at a point x runs along `far * x - q`, with far = 1 and q the
place, or far = 0 and q the direction to the sun. All that makes a triangle pass is a plane that separates it from the
pyramid, checked as it was computed; docs/seeing.md has the theorem.
"""

from typing import no_type_check

import numba
import numpy as np

# `no_type_check` below: run-time shape checks would wrap the functions that numba compiles.
LIFT = 1e-4
"""What lies at most this far above a patch's plane does not block, nor what is as near below the camera's height, m."""
_MARGIN = 1e-9
"""Least distance between a triangle and the pyramid's side that it passes, m; rounding comes on top."""
_ROUNDING = 64 * np.finfo(np.float64).eps
"""Part of the largest coordinate by which rounding moves a point, a distance or a cut: more than it does."""
_REACH = 4.0 / _ROUNDING
"""Farther than a mesh is wide: times what rounding is for its largest coordinate, m."""
_SLIVER = 1e-150
"""A plane whose normal is computed shorter than this is not used."""


@numba.njit(cache=True, nogil=True, inline="always")
@no_type_check
def _ray_meets(corners, t, cx, cy, cz, gx, gy, gz, low, high):
    """Whether the ray c + s g surely meets a triangle at an s between low and high."""
    ax, ay, az = corners[t, 0], corners[t, 1], corners[t, 2]
    ex, ey, ez = corners[t, 3] - ax, corners[t, 4] - ay, corners[t, 5] - az
    fx, fy, fz = corners[t, 6] - ax, corners[t, 7] - ay, corners[t, 8] - az
    kx, ky, kz = gy * fz - gz * fy, gz * fx - gx * fz, gx * fy - gy * fx
    det = ex * kx + ey * ky + ez * kz
    # Edge-on or without area: left to the pyramid.
    if det * det <= 1e-20 * (ex * ex + ey * ey + ez * ez) * (kx * kx + ky * ky + kz * kz):
        return False
    inverse = 1.0 / det
    sx, sy, sz = cx - ax, cy - ay, cz - az
    u = (sx * kx + sy * ky + sz * kz) * inverse
    if u < 0.0 or u > 1.0:
        return False
    lx, ly, lz = sy * ez - sz * ey, sz * ex - sx * ez, sx * ey - sy * ex
    v = (gx * lx + gy * ly + gz * lz) * inverse
    if v < 0.0 or u + v > 1.0:
        return False
    s = (fx * lx + fy * ly + fz * lz) * inverse
    return low < s < high


@numba.njit(cache=True, nogil=True, inline="always")
@no_type_check
def _ray_enters(boxes, node, side, cx, cy, cz, ix, iy, iz, low, high):
    """Whether the ray passes a child's box between low and high."""
    one, other = (boxes[node, side, 0] - cx) * ix, (boxes[node, side, 3] - cx) * ix
    enter, leave = max(low, min(one, other)), min(high, max(one, other))
    one, other = (boxes[node, side, 1] - cy) * iy, (boxes[node, side, 4] - cy) * iy
    enter, leave = max(enter, min(one, other)), min(leave, max(one, other))
    one, other = (boxes[node, side, 2] - cz) * iz, (boxes[node, side, 5] - cz) * iz
    enter, leave = max(enter, min(one, other)), min(leave, max(one, other))
    return enter <= leave


@numba.njit(cache=True, nogil=True)
@no_type_check
def ray_blocker(boxes, children, first, corners, stack, cx, cy, cz, gx, gy, gz, low, high):
    """Give a triangle that the ray c + s g meets between low and high; -1 where none was found."""
    tiny = 1e-200
    ix = 1.0 / (gx if abs(gx) > tiny else tiny)
    iy = 1.0 / (gy if abs(gy) > tiny else tiny)
    iz = 1.0 / (gz if abs(gz) > tiny else tiny)
    stack[0] = 0
    depth = 1
    while depth > 0:
        depth -= 1
        node = stack[depth]
        for side in range(2):
            if not _ray_enters(boxes, node, side, cx, cy, cz, ix, iy, iz, low, high):
                continue
            child = children[node, side]
            if child >= 0:
                stack[depth] = child
                depth += 1
            else:
                for t in range(first[~child], first[~child + 1]):
                    if _ray_meets(corners, t, cx, cy, cz, gx, gy, gz, low, high):
                        return t
    return -1


@numba.njit(cache=True, nogil=True)
@no_type_check
def bounding_planes(patch, count, way, far, qx, qy, qz, reach, planes):
    """Write the planes that bound a pyramid at its sides (unit normal inwards, least value on it); give their number.

    The least value is taken over the computed normal, so that the pyramid is inside whatever rounding did to it.
    """
    number = 0
    for i in range(count):
        j = i + 1 if i + 1 < count else 0
        ex, ey, ez = patch[j, 0] - patch[i, 0], patch[j, 1] - patch[i, 1], patch[j, 2] - patch[i, 2]
        gx, gy, gz = qx - far * patch[i, 0], qy - far * patch[i, 1], qz - far * patch[i, 2]
        mx, my, mz = gy * ez - gz * ey, gz * ex - gx * ez, gx * ey - gy * ex
        length = np.sqrt(mx * mx + my * my + mz * mz)
        if length < _SLIVER:
            continue
        scale = way / length
        mx, my, mz = mx * scale, my * scale, mz * scale
        least = np.inf
        for k in range(count):
            least = min(least, mx * patch[k, 0] + my * patch[k, 1] + mz * patch[k, 2])
        towards = mx * qx + my * qy + mz * qz
        # A prism runs on for as far as the mesh does, along a plane that rounding may have tilted.
        least = min(least, towards) if far > 0.0 else least - abs(towards) * reach
        planes[number, 0], planes[number, 1], planes[number, 2], planes[number, 3] = mx, my, mz, least
        number += 1
    return number


@numba.njit(cache=True, nogil=True)
@no_type_check
def _slab(polygon, heights, count, level, way, out, out_heights):
    """Write the part of a polygon where way * height >= way * level; give its number of corners."""
    kept = 0
    for i in range(count):
        j = i + 1 if i + 1 < count else 0
        here, there = way * (heights[i] - level), way * (heights[j] - level)
        if here >= 0.0:
            out[kept, 0], out[kept, 1], out[kept, 2] = polygon[i, 0], polygon[i, 1], polygon[i, 2]
            out_heights[kept] = heights[i]
            kept += 1
        if (here > 0.0 and there < 0.0) or (here < 0.0 and there > 0.0):
            s = here / (here - there)
            for k in range(3):
                out[kept, k] = polygon[i, k] + s * (polygon[j, k] - polygon[i, k])
            out_heights[kept] = level
            kept += 1
    return kept


@numba.njit(cache=True, nogil=True)
@no_type_check
def _outside_a_side(polygon, count, planes, sides, margin):
    """Whether all of a polygon lies beyond one of the pyramid's sides."""
    for i in range(sides):
        beyond = True
        for k in range(count):
            value = planes[i, 0] * polygon[k, 0] + planes[i, 1] * polygon[k, 1] + planes[i, 2] * polygon[k, 2]
            if value > planes[i, 3] - margin:
                beyond = False
                break
        if beyond:
            return True
    return False


@numba.njit(cache=True, nogil=True)
@no_type_check
def _beside(polygon, count, patch, corners, far, qx, qy, qz, rounding, reach, margin):
    """Whether a plane through the eye and an edge of the polygon has the polygon on one side and the patch beyond."""
    for i in range(count):
        j = i + 1 if i + 1 < count else 0
        vx, vy, vz = polygon[i, 0], polygon[i, 1], polygon[i, 2]
        ex, ey, ez = polygon[j, 0] - vx, polygon[j, 1] - vy, polygon[j, 2] - vz
        gx, gy, gz = qx - far * vx, qy - far * vy, qz - far * vz
        mx, my, mz = gy * ez - gz * ey, gz * ex - gx * ez, gx * ey - gy * ex
        length = np.sqrt(mx * mx + my * my + mz * mz)
        if length < _SLIVER:
            continue
        mx, my, mz = mx / length, my / length, mz / length
        # Values from the eye, or for the sun, which has no place, from the edge.
        ox, oy, oz = (qx, qy, qz) if far > 0.0 else (vx, vy, vz)
        low, high = np.inf, -np.inf
        for k in range(count):
            value = mx * (polygon[k, 0] - ox) + my * (polygon[k, 1] - oy) + mz * (polygon[k, 2] - oz)
            low, high = min(low, value), max(high, value)
        if low < -rounding and high > rounding:
            continue
        least, most = np.inf, -np.inf
        for k in range(corners):
            value = mx * (patch[k, 0] - ox) + my * (patch[k, 1] - oy) + mz * (patch[k, 2] - oz)
            least, most = min(least, value), max(most, value)
        tilt = 0.0 if far > 0.0 else abs(mx * qx + my * qy + mz * qz) * reach
        least, most = least - tilt, most + tilt
        if (low >= -rounding and most <= -margin) or (high <= rounding and least >= margin):
            return True
    return False


@numba.njit(cache=True, nogil=True)
@no_type_check
def _passes(corners, t, patch, count, plane, top, planes, sides, far, qx, qy, qz, rounding, work, heights):
    """Whether a triangle is proved to have no point in the pyramid that counts."""
    one, other = work[0], work[1]
    low, high = np.inf, -np.inf
    for k in range(3):
        one[k, 0], one[k, 1], one[k, 2] = corners[t, 3 * k], corners[t, 3 * k + 1], corners[t, 3 * k + 2]
        z = plane[0] * one[k, 0] + plane[1] * one[k, 1] + plane[2] * one[k, 2] - plane[3]
        heights[0, k] = z
        low, high = min(low, z), max(high, z)
    bottom = LIFT - rounding
    if high <= bottom or low >= top:
        return True
    side_margin = _MARGIN + rounding
    if _outside_a_side(one, 3, planes, sides, side_margin):
        return True
    number = 3
    if low < bottom or high > top:
        number = _slab(one, heights[0], number, bottom, 1.0, other, heights[1])
        number = _slab(other, heights[1], number, top, -1.0, one, heights[0])
        if number == 0 or _outside_a_side(one, number, planes, sides, side_margin):
            return True
    margin = side_margin + (2.0 * rounding * (1.0 + top / LIFT) if far > 0.0 else 0.0)
    return _beside(one, number, patch, count, far, qx, qy, qz, rounding, rounding * _REACH, margin)


@numba.njit(cache=True, nogil=True)
@no_type_check
def pyramid_blocker(
    boxes, children, first, corners, stack, patch, count, plane, top, planes, sides, far, qx, qy, qz, rounding, work,
    heights,
):  # fmt: skip
    """Give a triangle that is not proved to pass the pyramid; -1 where all pass."""
    x0, x1, y0, y1, z0, z1 = np.inf, -np.inf, np.inf, -np.inf, np.inf, -np.inf
    for k in range(count):
        x0, x1 = min(x0, patch[k, 0]), max(x1, patch[k, 0])
        y0, y1 = min(y0, patch[k, 1]), max(y1, patch[k, 1])
        z0, z1 = min(z0, patch[k, 2]), max(z1, patch[k, 2])
    if far > 0.0:
        x0, x1, y0, y1, z0, z1 = min(x0, qx), max(x1, qx), min(y0, qy), max(y1, qy), min(z0, qz), max(z1, qz)
    else:
        x0, x1 = (-np.inf if qx < 0.0 else x0), (np.inf if qx > 0.0 else x1)
        y0, y1 = (-np.inf if qy < 0.0 else y0), (np.inf if qy > 0.0 else y1)
        z0, z1 = (-np.inf if qz < 0.0 else z0), (np.inf if qz > 0.0 else z1)
    margin = _MARGIN + rounding
    x0, x1, y0, y1, z0, z1 = x0 - margin, x1 + margin, y0 - margin, y1 + margin, z0 - margin, z1 + margin
    nx, ny, nz = plane[0], plane[1], plane[2]
    ground = plane[3] + LIFT - rounding
    stack[0] = 0
    depth = 1
    while depth > 0:
        depth -= 1
        node = stack[depth]
        for side in range(2):
            bx0, by0, bz0 = boxes[node, side, 0], boxes[node, side, 1], boxes[node, side, 2]
            bx1, by1, bz1 = boxes[node, side, 3], boxes[node, side, 4], boxes[node, side, 5]
            if bx0 > x1 or bx1 < x0 or by0 > y1 or by1 < y0 or bz0 > z1 or bz1 < z0:
                continue
            if (
                nx * (bx1 if nx > 0.0 else bx0) + ny * (by1 if ny > 0.0 else by0) + nz * (bz1 if nz > 0.0 else bz0)
                <= ground - rounding
            ):
                continue
            out = False
            for i in range(sides):
                mx, my, mz = planes[i, 0], planes[i, 1], planes[i, 2]
                if (
                    mx * (bx1 if mx > 0.0 else bx0) + my * (by1 if my > 0.0 else by0) + mz * (bz1 if mz > 0.0 else bz0)
                    <= planes[i, 3] - margin
                ):
                    out = True
                    break
            if out:
                continue
            child = children[node, side]
            if child >= 0:
                stack[depth] = child
                depth += 1
                continue
            for t in range(first[~child], first[~child + 1]):
                if not _passes(
                    corners, t, patch, count, plane, top, planes, sides, far, qx, qy, qz, rounding, work, heights
                ):
                    return t
    return -1


@numba.njit(cache=True, nogil=True)
@no_type_check
def look(boxes, children, first, corners, depth, patches, counts, centres, normals, eyes, far, units, largest, clear):
    """Say of each pair of an eye and a unit whether the way between them is clear.

    Args:
        boxes: and the next three: of a `RayTree`.
        children: see there.
        first: see there.
        corners: see there.
        depth: levels of the tree, at most.
        patches: (n, most, 3) corners, m.
        counts: (n,) of each.
        centres: (n, 3) a point of each, m.
        normals: (n, 3) unit vectors about which corners run counter-clockwise.
        eyes: (m, 3) or (1, 3) places, m, or unit vectors to the sun.
        far: 1 for places, 0 for the sun.
        units: (m,) 2 patch + side.
        largest: coordinate of mesh and places, m.
        clear: (m,) to be filled.

    """
    stack = np.empty(depth, dtype=np.int64)
    planes, plane = np.empty((patches.shape[1], 4)), np.empty(4)
    work, heights = np.empty((2, 8, 3)), np.empty((2, 8))
    rounding = _ROUNDING * largest
    last = -1
    for pair in range(len(units)):
        i, way = units[pair] >> 1, (-1.0 if units[pair] & 1 else 1.0)
        eye = pair if len(eyes) > 1 else 0
        qx, qy, qz = eyes[eye, 0], eyes[eye, 1], eyes[eye, 2]
        patch, count = patches[i], counts[i]
        nx, ny, nz = way * normals[i, 0], way * normals[i, 1], way * normals[i, 2]
        cx, cy, cz = centres[i, 0], centres[i, 1], centres[i, 2]
        gx, gy, gz = qx - far * cx, qy - far * cy, qz - far * cz
        steep = nx * gx + ny * gy + nz * gz
        clear[pair] = False
        if steep <= (4.0 * LIFT if far > 0.0 else 1e-9):
            continue
        low, high = LIFT / steep, (1.0 - LIFT / steep if far > 0.0 else np.inf)
        if last >= 0 and _ray_meets(corners, last, cx, cy, cz, gx, gy, gz, low, high):
            continue
        found = ray_blocker(boxes, children, first, corners, stack, cx, cy, cz, gx, gy, gz, low, high)
        if found < 0:
            sides = bounding_planes(patch, count, way, far, qx, qy, qz, rounding * _REACH, planes)
            base = -np.inf  # of the patch's plane: the highest corner, so that no corner is above it
            for k in range(count):
                base = max(base, nx * patch[k, 0] + ny * patch[k, 1] + nz * patch[k, 2])
            plane[0], plane[1], plane[2], plane[3] = nx, ny, nz, base
            top = nx * qx + ny * qy + nz * qz - base - LIFT + rounding if far > 0.0 else np.inf
            found = pyramid_blocker(
                boxes, children, first, corners, stack, patch, count, plane, top, planes, sides, far, qx, qy, qz,
                rounding, work, heights,
            )  # fmt: skip
        if found >= 0:
            last = found
        clear[pair] = found < 0
