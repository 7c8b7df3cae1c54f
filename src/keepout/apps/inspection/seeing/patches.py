"""The surface in patches: convex plane pieces of a mesh, each with two sides that are seen apart.

A mesh is cut along its plane regions: faces that hang together across edges and lie in one plane. A grid in each plane
cuts the region into cells, and the pieces of a cell are put together to few convex ones. Closed parts of a mesh know
which side of a face is outside, sheets do not.
"""

import functools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.sparse.csgraph
from jaxtyping import Bool, Float, Int

from keepout.apps.inspection.seeing.polygons import copy_corners, double_area, outline, simplified
from keepout.core.cores import kernel
from keepout.core.errors import InspectionError
from keepout.core.geometry.distance import Points
from keepout.core.geometry.target import Target, weld, zero_area
from keepout.core.progress import Progress, silent

Units = Int[np.ndarray, " _"]
"""Some units by their numbers."""
Marks = Bool[np.ndarray, " units"]
"""What is said of every unit: yes or no."""
Areas = Float[np.ndarray, " units"]
"""Of every unit, m²."""
FLAT = 2e-5
"""How far from the region's plane a corner of its faces may lie, m; well below the lift of sight lines."""
_ALIKE = 0.999
"""Least cosine between the normals of a region's faces."""
MOST_PATCHES = 3_000_000
"""More than these are refused: their corners alone take half a gigabyte."""
_LEAST_SHARE = 1e-11
"""Pieces below this share of a full cell's area are left out: they are what rounding leaves along the lines."""
_PIECE_CORNERS = 8
"""Room for the corners of a piece: a triangle cut by two pairs of lines has at most 7."""
_MOST_CORNERS = 8
"""Corners of a patch, at most."""
_GAP = 2e-7
"""Pieces are put together where the hull has at most this times its circumference more area than they have, m."""


class Shapes(NamedTuple):
    """Convex plane polygons as the compiled loops take them; see `Patches`."""

    corners: Float[np.ndarray, "n most 3"]
    counts: Int[np.ndarray, " n"]
    centres: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]


@dataclass(frozen=True, eq=False)
class Patches:
    """Convex plane pieces of a mesh, none wider than `size` along either axis of its plane's grid.

    Each has two *units*: unit 2 i is patch i from the side that its normal points to, unit 2 i + 1 from the other.

    Attributes:
        corners: (n, most, 3) m, body frame, counter-clockwise about the normal; the last corner repeated to fill up.
        counts: (n,) corners of each.
        normals: (n, 3) unit vectors.
        areas: (n,) m².
        centres: (n, 3) centroids, m.
        faces: (n,) a face of the mesh that the patch lies on.
        counted: (2 n,) whether a unit is one that anybody asks to see: not the inner side of a closed part.
        size: edge of the grid that cut them, m.

    """

    corners: Float[np.ndarray, "n most 3"]
    counts: Int[np.ndarray, " n"]
    normals: Float[np.ndarray, "n 3"]
    areas: Float[np.ndarray, " n"]
    centres: Float[np.ndarray, "n 3"]
    faces: Int[np.ndarray, " n"]
    counted: Marks
    size: float

    @functools.cached_property
    def shapes(self) -> Shapes:
        """All of them, for compiled loops."""
        corners, centres, normals = map(np.ascontiguousarray, (self.corners, self.centres, self.normals))
        return Shapes(corners, np.ascontiguousarray(self.counts, np.int64), centres, normals)

    @property
    def units(self) -> int:
        """Two for each patch."""
        return 2 * len(self.areas)

    def unit_normals(self) -> Float[np.ndarray, "units 3"]:
        """Give the unit vectors out of each unit's side."""
        return np.stack([self.normals, -self.normals], axis=1).reshape(-1, 3)

    def unit_areas(self) -> Areas:
        """Area of each unit, m²; 0 for those that are not counted."""
        return np.repeat(self.areas, 2) * self.counted

    def corners_of(self, units: Units) -> Float[np.ndarray, "corners 3"]:
        """Give all corners of some units' patches, m."""
        corners = self.corners[units // 2]
        return corners[np.arange(corners.shape[1]) < self.counts[units // 2][:, None]]

    def coverage(self, seen: Marks) -> float:
        """Give the share, 0 to 1, that the units seen have of the area counted."""
        areas = self.unit_areas()
        return float(areas[seen].sum() / areas.sum())


def neighbours(welded: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, "f 3"]:
    """Give the one face on the other side of each edge (corner k to corner k + 1); -1 where there are none or several.

    The other face must run through the edge the other way round: then both have the same side up.
    """
    count = len(welded)
    start, end = welded.reshape(-1), np.roll(welded, -1, axis=1).reshape(-1)
    low, high = np.minimum(start, end), np.maximum(start, end)
    order = np.lexsort((high, low))
    same = (low[order][1:] == low[order][:-1]) & (high[order][1:] == high[order][:-1])
    first = np.flatnonzero(np.concatenate([[True], ~same]))
    alone = np.diff(np.append(first, 3 * count)) == 2
    one, other = order[first[alone]], order[first[alone] + 1]
    opposite = (start[one] == end[other]) & (start[one] != end[one])
    one, other = one[opposite], other[opposite]
    across = np.full(3 * count, -1, dtype=np.int64)
    across[one], across[other] = other // 3, one // 3
    return across.reshape(count, 3)


def closed_parts(
    vertices: Points, faces: Int[np.ndarray, "f 3"]
) -> tuple[Bool[np.ndarray, " f"], Bool[np.ndarray, " f"]]:
    """Say of each face whether it belongs to a closed part, and whether its normal then points into that part.

    A part is all faces that hang together by edges of two faces with the same side up. It is closed if each of its
    edges has as many of its faces running one way as the other; the sign of its volume says which side is outside.

    Returns:
        (f,) closed, and (f,) inward.

    """
    welded = weld(vertices, faces)
    across = neighbours(welded)
    count = len(faces)
    face = np.repeat(np.arange(count), 3)
    joined = across.reshape(-1) >= 0
    graph = scipy.sparse.coo_matrix(
        (np.ones(int(joined.sum()), dtype=np.int8), (face[joined], across.reshape(-1)[joined])), shape=(count, count)
    )
    parts, part = scipy.sparse.csgraph.connected_components(graph, directed=False)
    start, end = welded.reshape(-1), np.roll(welded, -1, axis=1).reshape(-1)
    # Runs of each edge of each part one way less those the other way.
    low, high, way = np.minimum(start, end), np.maximum(start, end), np.sign(end - start)
    order = np.lexsort((high, low, part[face]))
    keys = np.stack([part[face], low, high])[:, order]
    first = np.flatnonzero(np.concatenate([[True], (keys[:, 1:] != keys[:, :-1]).any(axis=0)]))
    balance = np.add.reduceat(way[order], first)
    closed = np.ones(parts, dtype=bool)
    closed[keys[0, first[balance != 0]]] = False
    a, b, c = np.moveaxis(vertices[faces] - vertices[faces].mean(axis=(0, 1)), 1, 0)
    volume = np.bincount(part, weights=np.einsum("fi,fi->f", a, np.cross(b, c)), minlength=parts)
    area = np.bincount(part, weights=np.linalg.norm(np.cross(b - a, c - a), axis=1), minlength=parts)
    closed &= np.abs(volume) > 1e-9 * area**1.5
    return closed[part], closed[part] & (volume[part] < 0.0)


class Regions(NamedTuple):
    """Each region's plane with a grid's axes in it, and the region of each face.

    Attributes:
        region: -1 for faces without area.
        origin: a corner of the grid, m.
        axes: rows: along the region's longest border, across it, normal.
        extent: the region's size along the first two axes, m.

    """

    region: Int[np.ndarray, " f"]
    origin: Float[np.ndarray, "regions 3"]
    axes: Float[np.ndarray, "regions 3 3"]
    extent: Float[np.ndarray, "regions 2"]


def regions(vertices: Points, faces: Int[np.ndarray, "f 3"]) -> Regions:
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


@kernel()
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
                    dx, dy, dz = triangles[other, k, 0] - x, triangles[other, k, 1] - y, triangles[other, k, 2] - z
                    flat = flat and abs(dx * nx + dy * ny + dz * nz) <= FLAT
                if flat:
                    region[other] = count
                    waiting[depth] = other
                    depth += 1
        count += 1
    return region, count


def cut(target: Target, size: float, *, progress: Progress = silent) -> Patches:
    """Cut a target's surface into convex plane patches.

    Faces that hang together in one plane are taken as one region. A grid in that plane, along the region's longest
    border, cuts it into cells of at most `size`; the pieces of a cell are put together to as few convex patches as a
    greedy search finds. The areas of all patches sum to the area of the mesh.

    Args:
        target: the mesh; a point cloud has no surface to cut.
        size: edge of the cells, m.
        progress: told how far the work is.

    Raises:
        InspectionError: a point cloud, a mesh without area, a size that is not above 0, or more than `MOST_PATCHES`
            patches.

    """
    if target.ball_radius > 0.0:
        raise InspectionError(f"{target.name}: a point cloud has no surface to be seen; a mesh or a map has")
    if not 0.0 < size < math.inf:
        raise InspectionError(f"patch size is {size:g} m; it must be a number above 0")
    vertices, faces = np.asarray(target.vertices, dtype=np.float64), np.array(target.faces, dtype=np.int64)
    progress(0.0, "finding plane regions")
    closed, inward = closed_parts(vertices, faces)
    faces[inward] = faces[inward][:, ::-1]
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    face_areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    if not face_areas.sum() > 0.0:
        raise InspectionError(f"{target.name}: its {len(faces)} faces have no area; there is nothing to be seen")
    _refuse_many(target, size, float(face_areas.sum()) / size**2)
    found = regions(vertices, faces)
    progress(0.3, f"cutting {len(found.extent)} plane regions")
    cells = np.maximum(np.ceil(found.extent / size - 1e-9), 1.0).astype(np.int64)
    steps = found.extent / cells
    inside = np.maximum(found.region, 0)
    flat = np.einsum("fij,fkj->fki", found.axes[inside][:, :2], vertices[faces] - found.origin[inside][:, None])
    least = _LEAST_SHARE * size**2
    grid = np.ascontiguousarray(flat), found.region, steps, cells, least
    number = int(_pieces(*grid, _room_for(0)))
    _refuse_many(target, size, number / 8.0)  # pieces, of which several make a patch
    pieces = _room_for(number)
    _pieces(*grid, pieces)
    corners, counts, areas, cell, face = pieces
    progress(0.6, f"putting {number} pieces together")
    order = np.lexsort((cell, found.region[face]))
    corners, counts, areas, cell, face = corners[order], counts[order], areas[order], cell[order], face[order]
    # A face may lean in its region's plane: its pieces count with the area that they have on the mesh.
    in_plane = np.bincount(face, weights=areas, minlength=len(face_areas))
    true_areas = areas * face_areas[face] / in_plane[face]
    new = (np.diff(found.region[face], prepend=-1) != 0) | (np.diff(cell, prepend=-1) != 0)
    begin = np.append(np.flatnonzero(new), number)
    kept = _merged(corners, counts, areas, true_areas, face, begin)
    _refuse_many(target, size, float(kept.sum()))
    patches = _placed(found, closed, (corners[kept], counts[kept], true_areas[kept], face[kept]), size)
    progress(1.0, f"{len(patches.areas)} patches")
    return patches


def _placed(found: Regions, closed: np.ndarray, pieces: tuple[np.ndarray, ...], size: float) -> Patches:
    flat, counts, areas, faces = pieces
    last = np.minimum(np.arange(int(counts.max())), counts[:, None] - 1)
    flat = np.take_along_axis(flat, last[:, :, None], axis=1)
    x, y = flat[..., 0] - flat[:, :1, 0], flat[..., 1] - flat[:, :1, 1]
    wedge = x[:, :-1] * y[:, 1:] - x[:, 1:] * y[:, :-1]
    total = wedge.sum(axis=1)
    moments = [((each[:, :-1] + each[:, 1:]) * wedge).sum(axis=1) for each in (x, y)]
    centre = flat[:, 0] + np.stack(moments, axis=1) / (3.0 * total[:, None])
    region = found.region[faces]
    origin, axes = found.origin[region], found.axes[region]
    return Patches(
        corners=origin[:, None] + np.einsum("nkc,ncj->nkj", flat, axes[:, :2]),
        counts=counts,
        normals=np.ascontiguousarray(axes[:, 2]),
        areas=areas,
        centres=origin + np.einsum("nc,ncj->nj", centre, axes[:, :2]),
        faces=faces,
        counted=np.stack([np.ones(len(areas), dtype=bool), ~closed[faces]], axis=1).reshape(-1),
        size=float(size),
    )


def _refuse_many(target: Target, size: float, patches: float) -> None:
    if patches > MOST_PATCHES:
        raise InspectionError(
            f"{target.name}: patches of {size:g} m are at least {patches:.0f}; at most {MOST_PATCHES} are taken: "
            f"a size of about {size * math.sqrt(patches / MOST_PATCHES) * 1.2:.2g} m would do"
        )


def _room_for(count: int) -> tuple[np.ndarray, ...]:
    """Give room for pieces: corners (m), how many, area (m²), cell within its region's grid, and triangle."""
    counts, cell, face = np.zeros((3, count), dtype=np.int64)
    return np.zeros((count, _PIECE_CORNERS, 2)), counts, np.zeros(count), cell, face


@kernel()
def _keep(polygon, count, axis, line, sign, out):
    """Write the part of a polygon where sign * coordinate >= sign * line; give its number of corners."""
    kept = 0
    for i in range(count):
        j = i + 1 if i + 1 < count else 0
        here, there = sign * (polygon[i, axis] - line), sign * (polygon[j, axis] - line)
        if here >= 0.0:
            out[kept, 0], out[kept, 1] = polygon[i, 0], polygon[i, 1]
            kept += 1
        if (here > 0.0 and there < 0.0) or (here < 0.0 and there > 0.0):
            # From the inner end, so that both sides of the line get the same point.
            s, e, t = (i, j, here / (here - there)) if here > 0.0 else (j, i, there / (there - here))
            if sign < 0.0:
                s, e, t = e, s, 1.0 - t
            out[kept, axis] = line
            out[kept, 1 - axis] = polygon[s, 1 - axis] + t * (polygon[e, 1 - axis] - polygon[s, 1 - axis])
            kept += 1
    return kept


@kernel()
def _span(polygon, count, axis, step, cells):
    """Give the first cell and the one after the last along an axis that a polygon may meet."""
    low, high = np.inf, -np.inf
    for i in range(count):
        low, high = min(low, polygon[i, axis]), max(high, polygon[i, axis])
    first = min(max(int(np.floor(low / step)) - 1, 0), cells - 1)
    last = min(max(int(np.floor(high / step)) + 1, 0), cells - 1)
    while first < last and (first + 1) * step <= low:
        first += 1
    while last > first and last * step >= high:
        last -= 1
    return first, last + 1


@kernel()
def _pieces(triangles, region, steps, cells, least, out):
    """Cut triangles along their regions' grids.

    Args:
        triangles: (f, 3, 2) m, from the corner of each one's grid, counter-clockwise.
        region: (f,) of each; those below 0 are left out.
        steps: (regions, 2) size of a cell, m.
        cells: (regions, 2) numbers of cells.
        least: area of the smallest piece that is kept, m².
        out: room for pieces, to be filled; without room for any they are counted only.

    Returns:
        The number of pieces.

    """
    corners, counts, areas, cell, face = out
    number = 0
    one, column, other, piece = np.empty((8, 2)), np.empty((8, 2)), np.empty((8, 2)), np.empty((8, 2))
    for f in range(len(triangles)):
        r = region[f]
        if r < 0:
            continue
        dx, dy, nx, ny = steps[r, 0], steps[r, 1], cells[r, 0], cells[r, 1]
        first_x, end_x = _span(triangles[f], 3, 0, dx, nx)
        for i in range(first_x, end_x):
            # The outermost cells take all that rounding puts outside.
            some = _keep(triangles[f], 3, 0, i * dx if i > 0 else -np.inf, 1.0, one)
            wide = _keep(one, some, 0, (i + 1) * dx if i + 1 < nx else np.inf, -1.0, column)
            if wide < 3:
                continue
            first_y, end_y = _span(column, wide, 1, dy, ny)
            for j in range(first_y, end_y):
                some = _keep(column, wide, 1, j * dy if j > 0 else -np.inf, 1.0, other)
                count = _keep(other, some, 1, (j + 1) * dy if j + 1 < ny else np.inf, -1.0, piece)
                area = 0.5 * double_area(piece, count)
                if count < 3 or area <= least:
                    continue
                if len(counts) > 0:
                    copy_corners(piece, count, corners[number], 0)
                    counts[number], areas[number] = count, area
                    cell[number], face[number] = i * ny + j, f
                number += 1
    return number


@kernel()
def _merged(corners, counts, areas, true_areas, face, begin):
    """Put the pieces of each cell together as far as they stay convex and have few corners.

    The pieces of a cell do not overlap: where the hull of two has no more area than both, they fill it.

    Args:
        corners: (n, _PIECE_CORNERS, 2) of pieces, cell by cell; overwritten.
        counts: (n,) corners of each; overwritten.
        areas: (n,) m² in the plane; overwritten.
        true_areas: (n,) m² of the mesh; overwritten.
        face: (n,) the face of each; the one of the largest piece stays; overwritten.
        begin: (cells + 1,) the first piece of each cell.

    Returns:
        (n,) whether a place of the arrays holds a polygon of the answer.

    """
    n = len(counts)
    kept = np.zeros(n, dtype=np.bool_)
    largest = 0
    for c in range(len(begin) - 1):
        largest = max(largest, begin[c + 1] - begin[c])
    room = max(largest * corners.shape[1], 2 * _MOST_CORNERS)
    points, hull = np.empty((room, 2)), np.empty((room + 1, 2))
    work = np.empty(room, dtype=np.int64), np.empty(2 * room + 2, dtype=np.int64), hull
    biggest = areas.copy()
    for c in range(len(begin) - 1):
        start, end = begin[c], begin[c + 1]
        for i in range(start, end):
            counts[i] = simplified(corners[i], counts[i])
            kept[i] = True
        if end - start > 1:
            number, total = 0, 0.0
            for i in range(start, end):
                total += areas[i]
                copy_corners(corners[i], counts[i], points, number)
                number += counts[i]
            size, area, around = outline(points, number, work)
            if size <= _MOST_CORNERS and area - total <= _GAP * around:
                best = start
                for i in range(start + 1, end):
                    best = i if areas[i] > areas[best] else best
                    true_areas[start] += true_areas[i]
                    kept[i] = False
                face[start], areas[start], counts[start] = face[best], total, size
                copy_corners(hull, size, corners[start], 0)
                continue
        again = end - start > 1
        while again:
            again = False
            for i in range(start, end):
                if not kept[i]:
                    continue
                j = start
                while j < end:
                    if j == i or not kept[j]:
                        j += 1
                        continue
                    number = counts[i] + counts[j]
                    copy_corners(corners[i], counts[i], points, 0)
                    copy_corners(corners[j], counts[j], points, counts[i])
                    size, area, around = outline(points, number, work)
                    if size <= _MOST_CORNERS and area - areas[i] - areas[j] <= _GAP * around:
                        if biggest[j] > biggest[i]:
                            face[i], biggest[i] = face[j], biggest[j]
                        areas[i] += areas[j]
                        true_areas[i] += true_areas[j]
                        copy_corners(hull, size, corners[i], 0)
                        counts[i] = size
                        kept[j] = False
                        again = True
                        j = start
                    else:
                        j += 1
    return kept
