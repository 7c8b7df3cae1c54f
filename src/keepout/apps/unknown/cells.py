"""The map in cells of 2 x 2 x 2 cubes: free, unknown, near the seen surface, or on it; and how often each was tried."""

from dataclasses import dataclass
from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from keepout.apps.unknown.known_free import KnownFreeMap

ACROSS = 2
"""Cubes along the edge of a cell."""
FREE, SURFACE, EXPLAINED, UNKNOWN, NEARBY, CLOSE = 0, 1, 2, 3, 4, 5
"""Kinds of cells: all cubes free; holds a return; so near a return that it may stay closed; the others not free, far
from every return, nearby one and close to one."""


@dataclass(frozen=True, eq=False)
class Cells:
    """Kinds of cells of `edge` m from corner `origin` (3,) m on."""

    origin: Float[np.ndarray, "3"]
    edge: float
    kinds: UInt8[np.ndarray, "nx ny nz"]

    @classmethod
    def of(cls, known: KnownFreeMap, *, explained: float = 0.35, close: float = 1.6, nearby: float = 4.0) -> "Cells":
        """Sort the cells of a map.

        Args:
            known: the map.
            explained: an unknown cell whose centre is so near (m) to a cell with returns is explained by them.
            close: an unknown cell is close to the seen surface within about so many metres of a return.
            nearby: and nearby within about so many.

        """
        kinds = closed_cells(known.free)
        edge = ACROSS * known.spacing
        holding = cells_of(known.returns, known.origin, edge, kinds.shape)
        holding = holding[kinds[tuple(holding.T)] != FREE]
        _raise_around(kinds, holding, _ball(nearby / edge, 3.0), 3.0, NEARBY)
        _raise_around(kinds, holding, _ball(close / edge, 3.0), 3.0, CLOSE)
        _raise_around(kinds, holding, _ball(explained / edge, 1.0), 1.0, EXPLAINED)
        kinds[tuple(holding.T)] = SURFACE
        return cls(known.origin, edge, kinds)

    def place(self, cells: Int[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Centres of cells, m."""
        return self.origin + self.edge * (np.asarray(cells) + 0.5)


def cells_of(
    points: Float[np.ndarray, "m 3"], origin: Float[np.ndarray, "3"], edge: float, shape: tuple[int, ...]
) -> Int[np.ndarray, "k 3"]:
    """Give the cells inside the box that hold points, each once."""
    place = np.floor((np.asarray(points, dtype=np.float64) - origin) / edge).astype(np.int64)
    place = place[np.all((place >= 0) & (place < shape), axis=1)]
    flat = np.zeros(shape, dtype=np.bool_)
    flat[tuple(place.T)] = True
    return np.argwhere(flat)


def closed_cells(free: Bool[np.ndarray, "mx my mz"]) -> UInt8[np.ndarray, "nx ny nz"]:
    """Say of each cell whether it is `FREE` or holds a cube that is not, `UNKNOWN`."""
    return _closed(free)


@numba.njit(cache=True)
@no_type_check
def _closed(free):
    nx, ny, nz = free.shape
    kinds = np.zeros(((nx + 1) // 2, (ny + 1) // 2, (nz + 1) // 2), dtype=np.uint8)
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                if not free[i, j, k]:
                    kinds[i >> 1, j >> 1, k >> 1] = 3
    return kinds


def _ball(radius: float, coarse: float) -> Int[np.ndarray, "k 3"]:
    """Offsets within `radius`, both in cells, in steps of blocks `coarse` cells wide."""
    reach = int(np.ceil(radius / coarse))
    steps = np.argwhere(np.ones((2 * reach + 1,) * 3, dtype=bool)) - reach
    return steps[np.linalg.norm(steps, axis=1) * coarse <= radius + 1e-9]


def _raise_around(kinds, holding, offsets, coarse: float, kind: int) -> None:
    """Give unknown cells the kind `kind` where a block of `coarse` cells at one of the offsets holds returns."""
    width = int(coarse)
    shape = tuple(-(-n // width) for n in kinds.shape)
    held = np.zeros(shape, dtype=np.bool_)
    held[tuple((holding // width).T)] = True
    _raise(kinds, np.argwhere(held), offsets, width, kind, np.zeros(shape, dtype=np.bool_))


@numba.njit(cache=True)
@no_type_check
def _raise(kinds, blocks, offsets, width, kind, done):
    nx, ny, nz = done.shape
    for b in range(blocks.shape[0]):
        for o in range(offsets.shape[0]):
            i, j, k = blocks[b, 0] + offsets[o, 0], blocks[b, 1] + offsets[o, 1], blocks[b, 2] + offsets[o, 2]
            if 0 <= i < nx and 0 <= j < ny and 0 <= k < nz:
                done[i, j, k] = True
    for i in range(kinds.shape[0]):
        for j in range(kinds.shape[1]):
            for k in range(kinds.shape[2]):
                if kinds[i, j, k] >= 3 and done[i // width, j // width, k // width]:
                    kinds[i, j, k] = kind
