"""Where rays first meet a triangle mesh: exact triangles, both sides, in compiled float64 loops.

A ray that meets an edge or a corner meets every triangle that has it: no ray slips between two triangles. The test is
that of Woop, Benthin and Wald, "Watertight Ray/Triangle Intersection" (2013): corners are sheared so that the ray is
the third axis, and three signs say whether the ray passes through the triangle. Rounding moves a corner by the same
amount in all triangles that share it, and the sign of a difference of two rounded products is right or zero; zero
counts as met.
"""

import functools
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from keepout.core.cores import kernel
from keepout.core.errors import MeshError
from keepout.core.geometry.distance import DEEPEST, Points, TriangleSoup, tree_over

Origins = Float[np.ndarray, "#n 3"]

_ROUNDING = 32 * np.finfo(np.float64).eps
"""Part of the largest coordinate by which boxes are widened: more than what rounding moves a corner or a box by."""
_SMALLEST = 1e-200
"""Components of a direction nearer to zero than this count as this, so that no quotient is 0/0."""
_NOTHING = np.iinfo(np.int64).min
"""In place of a child: the ray enters neither."""


class FirstHit(TriangleSoup):
    """The first place where a ray meets a mesh; triangles have two sides, and need not close anything.

    A triangle that a ray runs along is met where the ray enters it; one without area is met as the segment or point
    that it is, where the ray meets that exactly.

    Args:
        vertices: (V, 3) positions in metres.
        faces: (F, 3) vertex indices; at least one.

    Raises:
        MeshError: no faces, an index outside the vertices, or a vertex that is not finite.

    """

    @functools.cached_property
    def normals(self) -> Float[np.ndarray, "f 3"]:
        """Unit normals of the faces; zeros for a face without area."""
        a, b, c = np.moveaxis(self.vertices[self.faces], 1, 0)
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        return normal / np.where(length > 0.0, length, 1.0)

    @functools.cached_property
    def _tree(self) -> "RayTree":
        return build_tree(self.vertices[self.faces])

    def ranges(self, origins: Origins, directions: Points, greatest: float = np.inf) -> Float[np.ndarray, " n"]:
        """Give the distance in metres to the first hit of each ray, `inf` where there is none within `greatest`.

        Args:
            origins: (n, 3), or (1, 3) for rays from one place, m.
            directions: (n, 3), of any length but zero. Rays that are neighbours in the list had better be neighbours
                in space: each starts with the triangle that the last one met.
            greatest: the farthest hit that counts, m.

        Raises:
            MeshError: a ray that is not finite, a direction of length zero, or a `greatest` that is not above 0.

        """
        return self.cast(origins, directions, greatest)[0]

    def cast(
        self, origins: Origins, directions: Points, greatest: float = np.inf
    ) -> tuple[Float[np.ndarray, " n"], Int[np.ndarray, " n"]]:
        """Give ranges as `ranges` does, and the face that each ray meets; -1 where there is none.

        On an edge it is any of the faces that have it.
        """
        # Not the view that may not be written: the kernel would be compiled for it once more.
        origins = np.array(np.broadcast_to(origins, directions.shape), dtype=np.float64, order="C")
        directions = np.ascontiguousarray(directions, dtype=np.float64)
        lengths = np.sqrt(np.einsum("ni,ni->n", directions, directions))
        if not (np.isfinite(origins).all() and np.isfinite(lengths).all()):
            raise MeshError("rays: an origin or a direction is not finite; every coordinate must be a number")
        if len(lengths) and lengths.min() < np.sqrt(_SMALLEST):
            raise MeshError(f"rays: a direction has the length {lengths.min():g}; it must be above 0")
        if not greatest > 0.0:
            raise MeshError(f"rays: greatest is {greatest:g} m; it must be above 0")
        ranges, faces = np.empty(len(lengths)), np.empty(len(lengths), dtype=np.int64)
        largest = max(float(np.abs(self.lower).max()), float(np.abs(self.upper).max()))
        _cast(self._tree, origins, directions, lengths, float(greatest), largest, ranges, faces)
        return ranges, faces


@kernel()
def _seen_edge_on(ax, ay, az, bx, by, bz, cx, cy, cz):
    """Give the least third coordinate, at least 0, at which a triangle seen edge-on meets the third axis; or `inf`.

    Its projection is a segment. It meets the axis between the least and the greatest place where an edge does, and an
    edge does where the projections of its ends are on opposite sides.
    """
    low, high = np.inf, -np.inf
    for _ in range(3):
        if ax * bx + ay * by <= 0.0:
            first, second = np.hypot(ax, ay), np.hypot(bx, by)
            if first + second > 0.0:
                z = (az * second + bz * first) / (first + second)
                low, high = min(low, z), max(high, z)
            else:
                low, high = min(low, az, bz), max(high, az, bz)
        ax, ay, az, bx, by, bz, cx, cy, cz = bx, by, bz, cx, cy, cz, ax, ay, az
    return max(low, 0.0) if high >= 0.0 else np.inf


@kernel(inline="always")
def _on_triangle(corners, triangle, ox, oy, oz, kx, ky, kz, Sx, Sy, Sz):
    """Give the multiple of the direction at which a ray meets a triangle; `inf` where it does not.

    U, V, W are twice the areas of the projected triangles that each edge makes with the ray; t weighs the corners by
    them, so that it is never outside the triangle.
    """
    az = corners[triangle, kz] - oz
    bz = corners[triangle, 3 + kz] - oz
    cz = corners[triangle, 6 + kz] - oz
    ax, ay = (corners[triangle, kx] - ox) - Sx * az, (corners[triangle, ky] - oy) - Sy * az
    bx, by = (corners[triangle, 3 + kx] - ox) - Sx * bz, (corners[triangle, 3 + ky] - oy) - Sy * bz
    cx, cy = (corners[triangle, 6 + kx] - ox) - Sx * cz, (corners[triangle, 6 + ky] - oy) - Sy * cz
    U, V, W = cx * by - cy * bx, ax * cy - ay * cx, bx * ay - by * ax
    if (U < 0.0 or V < 0.0 or W < 0.0) and (U > 0.0 or V > 0.0 or W > 0.0):
        return np.inf
    det = U + V + W
    if det == 0.0:
        return _seen_edge_on(ax, ay, Sz * az, bx, by, Sz * bz, cx, cy, Sz * cz)
    t = Sz * ((U / det) * az + (V / det) * bz + (W / det) * cz)
    return t if t >= 0.0 else np.inf


@kernel(inline="always")
def _entered(boxes, node, side, limit, ix, iy, iz, sx, sy, sz, near_x, near_y, near_z, far_x, far_y, far_z):
    """Give the multiple of the direction at which a ray enters a child's box; `inf` where it does not within `limit`.

    `s` is the place of the near plane of each axis, 0 or 3, and the other one is that of the far plane.
    """
    enter = (boxes[node, side, sx] - near_x) * ix
    enter_y = (boxes[node, side, 1 + sy] - near_y) * iy
    enter_z = (boxes[node, side, 2 + sz] - near_z) * iz
    leave = (boxes[node, side, 3 - sx] - far_x) * ix
    leave_y = (boxes[node, side, 4 - sy] - far_y) * iy
    leave_z = (boxes[node, side, 5 - sz] - far_z) * iz
    enter = enter if enter > enter_y else enter_y
    enter = enter if enter > enter_z else enter_z
    enter = enter if enter > 0.0 else 0.0
    leave = leave if leave < leave_y else leave_y
    leave = leave if leave < leave_z else leave_z
    leave = leave if leave < limit else limit
    return enter if enter <= leave else np.inf


@kernel()
def _inverse(component):
    if abs(component) > _SMALLEST:
        return 1.0 / component
    return -1.0 / _SMALLEST if component < 0.0 else 1.0 / _SMALLEST


@kernel()
def _cast(tree, origins, directions, lengths, greatest, largest, ranges, faces):
    boxes, children, first, corners, face = tree
    stack, bounds = np.empty(DEEPEST, dtype=np.int64), np.empty(DEEPEST)
    last = -1
    for i in range(len(lengths)):
        px, py, pz = origins[i, 0], origins[i, 1], origins[i, 2]
        dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        # The third axis is the one of the direction's longest component.
        if abs(dx) > abs(dy) and abs(dx) > abs(dz):
            kx, ky, kz = 1, 2, 0
        elif abs(dy) > abs(dz):
            kx, ky, kz = 2, 0, 1
        else:
            kx, ky, kz = 0, 1, 2
        ox, oy, oz = origins[i, kx], origins[i, ky], origins[i, kz]
        Sz = 1.0 / directions[i, kz]
        Sx, Sy = directions[i, kx] * Sz, directions[i, ky] * Sz
        ix, iy, iz = _inverse(dx), _inverse(dy), _inverse(dz)
        # A box is entered at its near planes and left at its far ones, both moved outwards.
        wide = _ROUNDING * (max(max(abs(px), abs(py)), abs(pz)) + largest)
        sx, sy, sz = (0 if ix > 0.0 else 3), (0 if iy > 0.0 else 3), (0 if iz > 0.0 else 3)
        wx, wy, wz = (wide if ix > 0.0 else -wide), (wide if iy > 0.0 else -wide), (wide if iz > 0.0 else -wide)
        nx, ny, nz = px + wx, py + wy, pz + wz
        fx, fy, fz = px - wx, py - wy, pz - wz
        limit = greatest / lengths[i]
        best, hit = np.inf, -1
        if last >= 0:
            t = _on_triangle(corners, last, ox, oy, oz, kx, ky, kz, Sx, Sy, Sz)
            if t < best and t <= limit:
                best, limit, hit = t, t, last
        stack[0], bounds[0] = 0, 0.0
        depth = 1
        while depth > 0:
            depth -= 1
            if bounds[depth] > limit:
                continue
            node = stack[depth]
            while node >= 0:
                near, far = children[node, 0], children[node, 1]
                one = _entered(boxes, node, 0, limit, ix, iy, iz, sx, sy, sz, nx, ny, nz, fx, fy, fz)
                other = _entered(boxes, node, 1, limit, ix, iy, iz, sx, sy, sz, nx, ny, nz, fx, fy, fz)
                if other < one:
                    near, far, one, other = far, near, other, one
                if other < np.inf:
                    stack[depth], bounds[depth] = far, other
                    depth += 1
                node = near if one < np.inf else _NOTHING
            if node == _NOTHING:
                continue
            for triangle in range(first[~node], first[~node + 1]):
                t = _on_triangle(corners, triangle, ox, oy, oz, kx, ky, kz, Sx, Sy, Sz)
                if t < best and t <= limit:
                    best, limit, hit = t, t, triangle
        ranges[i] = best * lengths[i]
        faces[i] = face[hit] if hit >= 0 else -1
        if hit >= 0:
            last = hit


class RayTree(NamedTuple):
    """A binary tree of boxes over triangles, split where rays are expected to cost least.

    Inner nodes stand in depth-first order; each holds the boxes of its two children.

    Attributes:
        boxes: lower corner and upper corner of each child's box, metres.
        children: a node, or below 0 a leaf: its triangles are `first[~child]` to `first[~child + 1]`.
        first: first triangle of each leaf, in the tree's order; one more entry than leaves.
        corners: of the triangles in the tree's order.
        face: original index of each triangle in the tree's order.

    """

    boxes: Float[np.ndarray, "nodes 2 6"]
    children: Int[np.ndarray, "nodes 2"]
    first: Int[np.ndarray, " leaves"]
    corners: Float[np.ndarray, "f 9"]
    face: Int[np.ndarray, " f"]


def build_tree(triangles: Float[np.ndarray, "f 3 3"]) -> RayTree:
    """Give the tree that distances are asked of as rays go through it, for one triangle (corner, axis), m, or more."""
    tree, count = tree_over(triangles), len(triangles)
    leaf = tree.amount > 0
    child = np.where(leaf, ~(np.cumsum(leaf) - 1), np.cumsum(~leaf) - 1)
    box = np.column_stack([tree.lower, tree.upper])
    inner = np.flatnonzero(~leaf)
    both = np.stack([inner + 1, tree.right[inner]], axis=1)
    boxes, children = box[both], child[both]
    if len(inner) == 0:  # one leaf is all there is: a node whose second child is empty
        boxes, children = np.stack([box, 0.0 * box + np.repeat([np.inf, -np.inf], 3)], axis=1), child[[[0, 0]]]
    first = np.append(tree.first[leaf], count)
    corners = np.ascontiguousarray(triangles[tree.face].reshape(count, 9))
    return RayTree(boxes, children, first, corners, tree.face)
