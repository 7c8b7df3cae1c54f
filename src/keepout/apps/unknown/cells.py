"""The map in cells of 2 x 2 x 2 cubes: of which kind each is, which are worth seeing, and how often each was tried."""

import math
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from keepout.apps.led.camera import Pinhole
from keepout.apps.unknown.known_free import KnownFreeMap, Seen, whole_blocks
from keepout.apps.unknown.view import View
from keepout.core.cores import kernel

ACROSS = 2
"""Cubes along the edge of a cell."""
FREE, SURFACE, EXPLAINED, UNKNOWN, NEARBY, CLOSE = 0, 1, 2, 3, 4, 5
"""Kinds of cells: all cubes free; holds a return; so near a return that it may stay closed; the others not free, far
from every return, nearby one and close to one."""
_AROUND = ((NEARBY, 4.0, 3), (CLOSE, 1.6, 3), (EXPLAINED, 0.35, 1))
"""Metres from a return within which an unknown cell is of a kind, about: by blocks so many cells wide."""
_BLOCK = 1.6
"""Metres across the blocks of room that divide the frontier into clusters."""


@dataclass(frozen=True, eq=False)
class Cells:
    """Kinds of cells of `edge` m from corner `origin` (3,) m on."""

    origin: Float[np.ndarray, "3"]
    edge: float
    kinds: UInt8[np.ndarray, "nx ny nz"]

    @classmethod
    def of(cls, known: KnownFreeMap) -> "Cells":
        """Sort the cells of a map: what is not free is unknown, or said of by how near it is to a cell with returns."""
        kinds = closed_cells(known.free)
        edge = ACROSS * known.spacing
        place = np.floor((known.returns.astype(np.float64) - known.origin) / edge).astype(np.int64)
        place = place[np.all((place >= 0) & (place < kinds.shape), axis=1)]
        holding = np.zeros(kinds.shape, dtype=np.bool_)
        holding[tuple(place.T)] = True
        holding &= kinds != FREE
        for kind, radius, width in _AROUND:
            kinds[_around(holding, radius / edge, width) & (kinds >= UNKNOWN)] = kind
        kinds[holding] = SURFACE
        return cls(known.origin, edge, kinds)

    def place(self, cells: Int[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Centres of cells, m."""
        return self.origin + self.edge * (np.asarray(cells) + 0.5)


def closed_cells(free: Bool[np.ndarray, "mx my mz"]) -> UInt8[np.ndarray, "nx ny nz"]:
    """Say of each cell whether it is `FREE` or holds a cube that is not, `UNKNOWN`."""
    return np.where(whole_blocks(free, ACROSS), FREE, UNKNOWN).astype(np.uint8)


def _around(holding: Bool[np.ndarray, "nx ny nz"], radius: float, width: int) -> Bool[np.ndarray, "nx ny nz"]:
    """Say which cells lie in a block, `width` cells wide, that is within `radius` cells of one with holding cells."""
    held = ~whole_blocks(~holding, width)
    reach = int(np.ceil(radius / width))
    offsets = np.argwhere(np.ones((2 * reach + 1,) * 3, dtype=np.bool_))
    padded, near = np.pad(held, reach), np.zeros_like(held)
    for offset in offsets[np.linalg.norm(offsets - reach, axis=1) * width <= radius + 1e-9]:
        near |= padded[tuple(slice(first, first + n) for first, n in zip(offset, held.shape, strict=True))]
    return np.kron(near, np.ones((width,) * 3, dtype=np.bool_))[tuple(slice(n) for n in holding.shape)]


@dataclass(frozen=True, eq=False)
class Frontier:
    """Where known-free room ends at cells that nothing seen explains: what is still worth seeing.

    These are unknown cells beside free ones, not explained by returns, in clusters that share a block of room.
    """

    cells: Int[np.ndarray, "n 3"]
    cluster: Int[np.ndarray, " n"]
    """Which cluster each cell belongs to."""
    centres: Float[np.ndarray, "c 3"]
    """Mean place of each cluster's cells, m."""
    normals: Float[np.ndarray, "c 3"]
    """Mean direction of each cluster into free room, a unit vector; zero where its cells disagree."""
    sizes: Int[np.ndarray, " c"]
    """Cells of each cluster."""

    @classmethod
    def of(cls, cells: Cells) -> "Frontier":
        """Collect the frontier and divide it by blocks of room."""
        free, inner = cells.kinds == FREE, slice(1, -1)
        after = [free[2:, inner, inner], free[inner, 2:, inner], free[inner, inner, 2:]]
        before = [free[:-2, inner, inner], free[inner, :-2, inner], free[inner, inner, :-2]]
        beside = np.logical_or.reduce([*after, *before]) & (cells.kinds[inner, inner, inner] > EXPLAINED)
        found = np.argwhere(beside) + 1
        outward = [one[beside].astype(float) - other[beside] for one, other in zip(after, before, strict=True)]
        if len(found) == 0:
            none = np.zeros((0, 3))
            return cls(found, np.zeros(0, dtype=np.int64), none, none, np.zeros(0, dtype=np.int64))
        block = found // max(1, round(_BLOCK / cells.edge))
        _, cluster = np.unique(np.ravel_multi_index(tuple(block.T), tuple(block.max(axis=0) + 1)), return_inverse=True)
        sizes = np.bincount(cluster)
        centres = np.stack([np.bincount(cluster, weights=p) for p in cells.place(found).T], axis=1) / sizes[:, None]
        normals = np.stack([np.bincount(cluster, weights=o) for o in outward], axis=1)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        return cls(found, cluster, centres, np.divide(normals, length, where=length > 1e-9, out=normals * 0.0), sizes)


PATIENCE, MOST_PATIENCE = 3, 7
SAME_PLACE, SAME_DIRECTION = 0.3, math.cos(math.radians(10.0))
"""Metres, and cosine of an angle, within which two views count as one."""
_RAYS = (48, 64)


@dataclass(eq=False)
class Tried:
    """Memory of the views taken so far; it grows by `note` after each."""

    patience: int
    """Failures after which nothing more is hoped of a cell."""
    failures: UInt8[np.ndarray, "nx ny nz"]
    """For every cell, views from different directions that looked at it through free room and left it closed."""
    positions: list[Float[np.ndarray, "3"]] = field(default_factory=list)
    axes: list[Float[np.ndarray, "3 3"]] = field(default_factory=list)

    @classmethod
    def nothing(cls, known: KnownFreeMap) -> "Tried":
        """Begin with no view.

        Where no return says nothing, a cell opens only in front of a surface, so more directions are worth trying.
        """
        patience = PATIENCE if known.bounds.sure_empty_range > 0.0 else MOST_PATIENCE
        return cls(patience, np.zeros(tuple((n + ACROSS - 1) // ACROSS for n in known.free.shape), dtype=np.uint8))

    @classmethod
    def of_map(cls, known: KnownFreeMap, camera: Pinhole) -> "Tried":
        """Remember the views that a map took, for one that was read from a file.

        What a view could look at is judged by the map as it is now, so at least as many failures are counted as by
        `note` after each view.
        """
        tried = cls.nothing(known)
        for seen in known.seen:
            tried.note(known, camera, seen)
        return tried

    def note(self, known: KnownFreeMap, camera: Pinhole, seen: View | Seen) -> None:
        """Remember a view that the map has seen: what lies first on its rays and is closed has failed once more.

        Views from within 0.3 m and 10 degrees of an earlier one count once: another try is another direction.
        """
        position, axes = seen.position, seen.axes
        repeated = any(
            np.linalg.norm(position - earlier) < SAME_PLACE and axes[:, 2] @ turned[:, 2] > SAME_DIRECTION
            for earlier, turned in zip(self.positions, self.axes, strict=True)
        )
        self.positions.append(position.copy())
        self.axes.append(axes.copy())
        if repeated:
            return
        bounds = known.bounds
        edge = ACROSS * known.spacing
        ball = 0.5 * math.sqrt(3.0) * known.spacing + bounds.surely_returned_width + bounds.position_error
        rays = _rays(camera)
        found = np.empty((len(rays), 3), dtype=np.int64)
        first_closed(
            closed_cells(known.free),
            (position - known.origin) / edge,
            (rays / np.linalg.norm(rays, axis=1, keepdims=True)) @ axes.T,
            (bounds.least_range + ball) / edge,
            (bounds.usable_range(camera) - ball) / edge - 1.0,
            found,
        )
        found, rays = found[found[:, 0] >= 0], rays[found[:, 0] >= 0]
        if len(found) == 0:
            return
        # Cells whose window may reach beyond the image were not tried.
        apart = np.linalg.norm(known.origin + edge * (found + 0.5) - position, axis=1)
        window = (ball + known.spacing + bounds.attitude_error * apart) / apart
        whole = np.ones(len(found), dtype=bool)
        for axis, pixels in ((0, camera.width), (1, camera.height)):
            half = math.atan(0.5 * pixels / camera.focal)
            whole &= np.arctan(np.abs(rays[:, axis])) + window < half
        index = tuple(np.unique(found[whole], axis=0).T)
        self.failures[index] = np.minimum(self.failures[index].astype(np.int64) + 1, 255).astype(np.uint8)


def _rays(camera: Pinhole) -> Float[np.ndarray, "n 3"]:
    """Rays evenly over the image, in camera axes, 1 along the boresight."""
    rows, columns = ((np.arange(count) + 0.5) / count - 0.5 for count in _RAYS)
    down, across = np.meshgrid(rows, columns, indexing="ij")
    rays = [across * camera.width / camera.focal, down * camera.height / camera.focal, np.ones_like(down)]
    return np.stack(rays, axis=-1).reshape(-1, 3)


@kernel()
def first_closed(codes, place, rays, nearest, farthest, found):
    """Write into `found` (m, 3) the first cell not free on each ray within the ranges, -1 where there is none."""
    nx, ny, nz = codes.shape
    for r in range(rays.shape[0]):
        found[r, 0] = -1
        for step in range(1, int(farthest) + 1):
            x, y, z = place[0] + step * rays[r, 0], place[1] + step * rays[r, 1], place[2] + step * rays[r, 2]
            i, j, k = int(x), int(y), int(z)
            if x < 0.0 or y < 0.0 or z < 0.0 or i >= nx or j >= ny or k >= nz:
                break
            if codes[i, j, k] != 0:
                if step >= nearest:
                    found[r, 0], found[r, 1], found[r, 2] = i, j, k
                break
