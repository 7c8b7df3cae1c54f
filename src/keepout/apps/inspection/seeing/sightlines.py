"""Sight lines: whether nothing of a mesh stands between a camera, or the sun, and the whole of a patch.

A place and the sun are one case in the compiled loops: the line of sight at a point x runs along `far * x - q`, with
far = 1 and q the place, or far = 0 and q the direction to the sun. All that makes a triangle pass is a plane that
separates it from the pyramid, checked as it was computed; docs/seeing.md has the theorem.
"""

from collections import namedtuple
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from keepout.apps.inspection.seeing.patches import Patches
from keepout.apps.led.first_hit import build_tree
from keepout.core.cores import kernel
from keepout.core.errors import InspectionError
from keepout.core.geometry.distance import DEEPEST, Point, Points, TriangleSoup

FARTHEST = 1e5
"""Places may have coordinates up to this, m: beyond it rounding comes near the margins."""
LIFT = 1e-4
"""What lies at most this far above a patch's plane does not block, nor what is as near below the camera's height, m."""
_MARGIN = 1e-9
"""Least distance between a triangle and the pyramid's side that it passes, m; rounding comes on top."""
ROUNDING = 64 * np.finfo(np.float64).eps
"""Part of the largest coordinate by which rounding moves a point, a distance or a cut: more than it does."""
_REACH = 4.0 / ROUNDING
"""Farther than a mesh is wide: times what rounding is for its largest coordinate, m."""
_SLIVER = 1e-150
"""A plane whose normal is computed shorter than this is not used."""
Ray = namedtuple("Ray", "cx cy cz gx gy gz low high")
"""The places c + s g with s between `low` and `high`, m."""


class Sightlines:
    """The pyramids from places, and the prisms from the sun, to a mesh's patches.

    A pair is called clear only if for every triangle of the mesh a plane is found that separates it from the pyramid,
    of which the part at most `LIFT` above the patch's plane, and that at most `LIFT` below the camera's height, do
    not count. So no straight line from the place to any point of the patch meets the mesh between these two heights.
    The other way round a pair may be called blocked that is clear by less than rounding. docs/seeing.md has the proof.

    Args:
        vertices: (V, 3) of the mesh, m.
        faces: (F, 3) vertex indices; all of them block.
        patches: the units.

    Attributes:
        patches: as given.
        tree: of the mesh's triangles, for rays.

    Raises:
        MeshError: no faces, an index outside the vertices, or a vertex that is not finite.

    """

    def __init__(self, vertices: Points, faces: Int[np.ndarray, "f 3"], patches: Patches):
        soup = TriangleSoup(vertices, faces)
        self.patches = patches
        self.tree = build_tree(soup.vertices[soup.faces])
        self._largest = float(max(np.abs(soup.lower).max(), np.abs(soup.upper).max()))

    def clear(self, places: Float[np.ndarray, "#m 3"], units: Int[np.ndarray, " m"]) -> Bool[np.ndarray, " m"]:
        """Say of each pair whether nothing stands between the place and the whole of the unit.

        A place behind the unit's plane, or less than a few `LIFT` above it, sees nothing of it.

        Args:
            places: (m, 3), or (1, 3) for one place, m, body frame. Pairs that are neighbours in the list had better
                be neighbours in space: each looks first at what blocked the one before.
            units: (m,) 2 i + side.

        Raises:
            InspectionError: a place that is not finite or farther than `FARTHEST`, or a unit that there is not.

        """
        places = np.ascontiguousarray(places, dtype=np.float64)
        if not (np.isfinite(places).all() and np.abs(places).max(initial=0.0) <= FARTHEST):
            raise InspectionError(f"sight lines: a place is not finite or has a coordinate beyond {FARTHEST:g} m")
        largest = max(self._largest, float(np.abs(places).max(initial=0.0)))
        return self._look(places, 1.0, units, largest)

    def lit(self, sun: Point, units: Int[np.ndarray, " m"]) -> Bool[np.ndarray, " m"]:
        """Say of each unit whether nothing stands between the whole of it and the sun, taken as infinitely far.

        Args:
            sun: (3,) towards the sun, of any length but zero, body frame.
            units: (m,) 2 i + side.

        Raises:
            InspectionError: a direction that is not finite or zero, or a unit that there is not.

        """
        sun = np.asarray(sun, dtype=np.float64)
        length = float(np.linalg.norm(sun))
        if not 0.0 < length < np.inf:
            raise InspectionError(f"sight lines: the direction to the sun is {sun.tolist()}; it must not be zero")
        return self._look((sun / length)[None], 0.0, units, self._largest)

    def _look(
        self, eyes: Float[np.ndarray, "#m 3"], far: float, units: Int[np.ndarray, " m"], largest: float
    ) -> Bool[np.ndarray, " m"]:
        units = np.ascontiguousarray(units, dtype=np.int64)
        if len(units) and (units.min() < 0 or units.max() >= self.patches.units):
            raise InspectionError(
                f"sight lines: unit {units.min()} or {units.max()} is outside 0 to {self.patches.units - 1}"
            )
        clear = np.empty(len(units), dtype=bool)
        _look(self.tree, self.patches.shapes, eyes, far, units, largest, clear)
        return clear


class Eye(NamedTuple):
    """A place, or the direction to the sun, and by how much rounding moves what is computed from it.

    Attributes:
        far: 1 for a place, 0 for the sun.
        rounding: m.

    """

    x: float
    y: float
    z: float
    far: float
    rounding: float


class Work(NamedTuple):
    """Room for the compiled loops to work in."""

    stack: Int[np.ndarray, " deep"]
    planes: Float[np.ndarray, "sides 4"]
    plane: Float[np.ndarray, " 4"]
    polygons: Float[np.ndarray, "2 8 3"]
    heights: Float[np.ndarray, "2 8"]


@kernel()
def workspace(most_corners):
    """Give room to work in, for patches of so many corners at most."""
    planes, polygons = np.empty((most_corners, 4)), np.empty((2, 8, 3))
    return Work(np.empty(DEEPEST, dtype=np.int64), planes, np.empty(4), polygons, np.empty((2, 8)))


@kernel(inline="always")
def _ray_meets(corners, t, ray):
    """Whether a ray surely meets a triangle."""
    cx, cy, cz, gx, gy, gz, low, high = ray
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


@kernel(inline="always")
def _ray_enters(boxes, node, side, ray, ix, iy, iz):
    """Whether a ray passes a child's box."""
    one, other = (boxes[node, side, 0] - ray.cx) * ix, (boxes[node, side, 3] - ray.cx) * ix
    enter, leave = max(ray.low, min(one, other)), min(ray.high, max(one, other))
    one, other = (boxes[node, side, 1] - ray.cy) * iy, (boxes[node, side, 4] - ray.cy) * iy
    enter, leave = max(enter, min(one, other)), min(leave, max(one, other))
    one, other = (boxes[node, side, 2] - ray.cz) * iz, (boxes[node, side, 5] - ray.cz) * iz
    enter, leave = max(enter, min(one, other)), min(leave, max(one, other))
    return enter <= leave


@kernel()
def ray_blocker(tree, stack, ray):
    """Give a triangle that a ray meets; -1 where none was found."""
    boxes, children, first, corners = tree.boxes, tree.children, tree.first, tree.corners
    tiny = 1e-200
    ix = 1.0 / (ray.gx if abs(ray.gx) > tiny else tiny)
    iy = 1.0 / (ray.gy if abs(ray.gy) > tiny else tiny)
    iz = 1.0 / (ray.gz if abs(ray.gz) > tiny else tiny)
    stack[0] = 0
    depth = 1
    while depth > 0:
        depth -= 1
        node = stack[depth]
        for side in range(2):
            if not _ray_enters(boxes, node, side, ray, ix, iy, iz):
                continue
            child = children[node, side]
            if child >= 0:
                stack[depth] = child
                depth += 1
            else:
                for t in range(first[~child], first[~child + 1]):
                    if _ray_meets(corners, t, ray):
                        return t
    return -1


@kernel()
def _bounding_planes(patch, way, eye, planes):
    """Write the planes that bound a pyramid at its sides (unit normal inwards, least value on it); give their number.

    The least value is taken over the computed normal, so that the pyramid is inside whatever rounding did to it.
    """
    number, far, reach = 0, eye.far, eye.rounding * _REACH
    for i in range(len(patch)):
        j = i + 1 if i + 1 < len(patch) else 0
        ex, ey, ez = patch[j, 0] - patch[i, 0], patch[j, 1] - patch[i, 1], patch[j, 2] - patch[i, 2]
        gx, gy, gz = eye.x - far * patch[i, 0], eye.y - far * patch[i, 1], eye.z - far * patch[i, 2]
        mx, my, mz = gy * ez - gz * ey, gz * ex - gx * ez, gx * ey - gy * ex
        length = np.sqrt(mx * mx + my * my + mz * mz)
        if length < _SLIVER:
            continue
        scale = way / length
        mx, my, mz = mx * scale, my * scale, mz * scale
        least = np.inf
        for k in range(len(patch)):
            least = min(least, mx * patch[k, 0] + my * patch[k, 1] + mz * patch[k, 2])
        towards = mx * eye.x + my * eye.y + mz * eye.z
        # A prism runs on for as far as the mesh does, along a plane that rounding may have tilted.
        least = min(least, towards) if far > 0.0 else least - abs(towards) * reach
        planes[number, 0], planes[number, 1], planes[number, 2], planes[number, 3] = mx, my, mz, least
        number += 1
    return number


@kernel()
def slab(polygon, heights, count, level, way, out, out_heights):
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


@kernel()
def _outside_a_side(polygon, planes, margin):
    """Whether all of a polygon lies beyond one of the pyramid's sides."""
    for i in range(len(planes)):
        beyond = True
        for k in range(len(polygon)):
            value = planes[i, 0] * polygon[k, 0] + planes[i, 1] * polygon[k, 1] + planes[i, 2] * polygon[k, 2]
            if value > planes[i, 3] - margin:
                beyond = False
                break
        if beyond:
            return True
    return False


@kernel()
def _beside(polygon, patch, eye, margin):
    """Whether a plane through the eye and an edge of the polygon has the polygon on one side and the patch beyond."""
    far, rounding, reach = eye.far, eye.rounding, eye.rounding * _REACH
    for i in range(len(polygon)):
        j = i + 1 if i + 1 < len(polygon) else 0
        vx, vy, vz = polygon[i, 0], polygon[i, 1], polygon[i, 2]
        ex, ey, ez = polygon[j, 0] - vx, polygon[j, 1] - vy, polygon[j, 2] - vz
        gx, gy, gz = eye.x - far * vx, eye.y - far * vy, eye.z - far * vz
        mx, my, mz = gy * ez - gz * ey, gz * ex - gx * ez, gx * ey - gy * ex
        length = np.sqrt(mx * mx + my * my + mz * mz)
        if length < _SLIVER:
            continue
        mx, my, mz = mx / length, my / length, mz / length
        # Values from the eye, or for the sun, which has no place, from the edge.
        ox, oy, oz = (eye.x, eye.y, eye.z) if far > 0.0 else (vx, vy, vz)
        low, high = np.inf, -np.inf
        for k in range(len(polygon)):
            value = mx * (polygon[k, 0] - ox) + my * (polygon[k, 1] - oy) + mz * (polygon[k, 2] - oz)
            low, high = min(low, value), max(high, value)
        if low < -rounding and high > rounding:
            continue
        least, most = np.inf, -np.inf
        for k in range(len(patch)):
            value = mx * (patch[k, 0] - ox) + my * (patch[k, 1] - oy) + mz * (patch[k, 2] - oz)
            least, most = min(least, value), max(most, value)
        tilt = 0.0 if far > 0.0 else abs(mx * eye.x + my * eye.y + mz * eye.z) * reach
        least, most = least - tilt, most + tilt
        if (low >= -rounding and most <= -margin) or (high <= rounding and least >= margin):
            return True
    return False


@kernel()
def _passes(corners, t, patch, top, planes, eye, work):
    """Whether a triangle is proved to have no point in the pyramid that counts."""
    one, other, heights, plane, rounding = work.polygons[0], work.polygons[1], work.heights, work.plane, eye.rounding
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
    if _outside_a_side(one[:3], planes, side_margin):
        return True
    number = 3
    if low < bottom or high > top:
        number = slab(one, heights[0], number, bottom, 1.0, other, heights[1])
        number = slab(other, heights[1], number, top, -1.0, one, heights[0])
        if number == 0 or _outside_a_side(one[:number], planes, side_margin):
            return True
    margin = side_margin + (2.0 * rounding * (1.0 + top / LIFT) if eye.far > 0.0 else 0.0)
    return _beside(one[:number], patch, eye, margin)


@kernel(inline="always")
def _farthest_along(box, nx, ny, nz):
    """Give the greatest value of a direction over a box."""
    x, y, z = box[3 if nx > 0.0 else 0], box[4 if ny > 0.0 else 1], box[5 if nz > 0.0 else 2]
    return nx * x + ny * y + nz * z


@kernel()
def pyramid_blocker(tree, patch, normal, way, eye, spare, work):
    """Give a triangle that is not proved to pass the pyramid from an eye to a patch; -1 where all pass.

    Args:
        tree: a `RayTree` of the mesh.
        patch: (k, 3) corners, m.
        normal: (3,) about which they run counter-clockwise, a unit vector.
        way: 1 to look at that side, -1 to look at the other.
        eye: where from.
        spare: above `LIFT` below the eye's height, up to which triangles count, m.
        work: room to work in.

    """
    qx, qy, qz, rounding, plane, stack = eye.x, eye.y, eye.z, eye.rounding, work.plane, work.stack
    planes = work.planes[: _bounding_planes(patch, way, eye, work.planes)]
    nx, ny, nz = way * normal[0], way * normal[1], way * normal[2]
    x0, x1, y0, y1, z0, z1 = np.inf, -np.inf, np.inf, -np.inf, np.inf, -np.inf
    base = -np.inf  # of the patch's plane: the highest corner, so that no corner is above it
    for k in range(len(patch)):
        base = max(base, nx * patch[k, 0] + ny * patch[k, 1] + nz * patch[k, 2])
        x0, x1 = min(x0, patch[k, 0]), max(x1, patch[k, 0])
        y0, y1 = min(y0, patch[k, 1]), max(y1, patch[k, 1])
        z0, z1 = min(z0, patch[k, 2]), max(z1, patch[k, 2])
    plane[0], plane[1], plane[2], plane[3] = nx, ny, nz, base
    if eye.far > 0.0:
        top = nx * qx + ny * qy + nz * qz - base - LIFT + spare
        x0, x1, y0, y1, z0, z1 = min(x0, qx), max(x1, qx), min(y0, qy), max(y1, qy), min(z0, qz), max(z1, qz)
    else:
        top = np.inf
        x0, x1 = (-np.inf if qx < 0.0 else x0), (np.inf if qx > 0.0 else x1)
        y0, y1 = (-np.inf if qy < 0.0 else y0), (np.inf if qy > 0.0 else y1)
        z0, z1 = (-np.inf if qz < 0.0 else z0), (np.inf if qz > 0.0 else z1)
    margin = _MARGIN + rounding
    x0, x1, y0, y1, z0, z1 = x0 - margin, x1 + margin, y0 - margin, y1 + margin, z0 - margin, z1 + margin
    ground = base + LIFT - rounding
    stack[0] = 0
    depth = 1
    while depth > 0:
        depth -= 1
        node = stack[depth]
        for side in range(2):
            box = tree.boxes[node, side]
            if box[0] > x1 or box[3] < x0 or box[1] > y1 or box[4] < y0 or box[2] > z1 or box[5] < z0:
                continue
            if _farthest_along(box, nx, ny, nz) <= ground - rounding:
                continue
            out = False
            for i in range(len(planes)):
                if _farthest_along(box, planes[i, 0], planes[i, 1], planes[i, 2]) <= planes[i, 3] - margin:
                    out = True
                    break
            if out:
                continue
            child = tree.children[node, side]
            if child >= 0:
                stack[depth] = child
                depth += 1
                continue
            for t in range(tree.first[~child], tree.first[~child + 1]):
                if not _passes(tree.corners, t, patch, top, planes, eye, work):
                    return t
    return -1


@kernel()
def _look(tree, shapes, eyes, far, units, largest, clear):
    """Say of each pair of an eye and a unit whether the way between them is clear.

    Args:
        tree: a `RayTree` of the mesh.
        shapes: of the patches.
        eyes: (m, 3) or (1, 3) places, m, or unit vectors to the sun.
        far: 1 for places, 0 for the sun.
        units: (m,) 2 patch + side.
        largest: coordinate of mesh and places, m.
        clear: (m,) to be filled.

    """
    patches, counts, centres, normals = shapes
    work = workspace(patches.shape[1])
    last = -1
    for pair in range(len(units)):
        i, way = units[pair] >> 1, (-1.0 if units[pair] & 1 else 1.0)
        at = eyes[pair if len(eyes) > 1 else 0]
        eye = Eye(at[0], at[1], at[2], far, ROUNDING * largest)
        cx, cy, cz = centres[i, 0], centres[i, 1], centres[i, 2]
        gx, gy, gz = eye.x - far * cx, eye.y - far * cy, eye.z - far * cz
        steep = way * normals[i, 0] * gx + way * normals[i, 1] * gy + way * normals[i, 2] * gz
        clear[pair] = False
        if steep <= (4.0 * LIFT if far > 0.0 else 1e-9):
            continue
        ray = Ray(cx, cy, cz, gx, gy, gz, LIFT / steep, (1.0 - LIFT / steep if far > 0.0 else np.inf))
        if last >= 0 and _ray_meets(tree.corners, last, ray):
            continue
        found = ray_blocker(tree, work.stack, ray)
        if found < 0:
            found = pyramid_blocker(tree, patches[i][: counts[i]], normals[i], way, eye, eye.rounding, work)
        if found >= 0:
            last = found
        clear[pair] = found < 0
