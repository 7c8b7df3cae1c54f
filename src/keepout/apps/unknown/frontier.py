"""Where known-free room ends at cells that nothing seen explains: what is still worth seeing."""

from dataclasses import dataclass
from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Float, Int

from keepout.apps.unknown.cells import EXPLAINED, FREE, Cells


@dataclass(frozen=True, eq=False)
class Frontier:
    """Unknown cells beside free ones, not explained by returns, in clusters that share a block of room."""

    cells: Int[np.ndarray, "n 3"]
    cluster: Int[np.ndarray, " n"]
    """Which cluster each cell belongs to."""
    centres: Float[np.ndarray, "c 3"]
    """Mean place of each cluster's cells, m."""
    normals: Float[np.ndarray, "c 3"]
    """Mean direction of each cluster into free room, a unit vector; zero where its cells disagree."""
    sizes: Int[np.ndarray, " c"]
    """Cells of each cluster."""


def frontier(cells: Cells, *, across: float = 1.6) -> Frontier:
    """Collect the frontier and divide it by blocks of `across` metres."""
    found, outward = _frontier(cells.kinds)
    if len(found) == 0:
        none = np.zeros((0, 3))
        return Frontier(found, np.zeros(0, dtype=np.int64), none, none, np.zeros(0, dtype=np.int64))
    block = found // max(1, round(across / cells.edge))
    shape = block.max(axis=0) + 1
    _, cluster = np.unique(np.ravel_multi_index(tuple(block.T), tuple(shape)), return_inverse=True)
    sizes = np.bincount(cluster)
    centres = np.stack([np.bincount(cluster, weights=p) for p in cells.place(found).T], axis=1) / sizes[:, None]
    normals = np.stack([np.bincount(cluster, weights=o) for o in outward.astype(float).T], axis=1)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return Frontier(found, cluster, centres, np.divide(normals, length, where=length > 1e-9, out=normals * 0.0), sizes)


@numba.njit(cache=True)
@no_type_check
def _frontier(kinds):
    nx, ny, nz = kinds.shape
    count = 0
    found = np.empty((1024, 3), dtype=np.int64)
    outward = np.empty((1024, 3), dtype=np.int64)
    for i in range(1, nx - 1):
        for j in range(1, ny - 1):
            for k in range(1, nz - 1):
                if kinds[i, j, k] <= EXPLAINED:
                    continue
                x = (kinds[i + 1, j, k] == FREE) * 1 - (kinds[i - 1, j, k] == FREE) * 1
                y = (kinds[i, j + 1, k] == FREE) * 1 - (kinds[i, j - 1, k] == FREE) * 1
                z = (kinds[i, j, k + 1] == FREE) * 1 - (kinds[i, j, k - 1] == FREE) * 1
                beside = x != 0 or y != 0 or z != 0
                if not beside and not (
                    kinds[i + 1, j, k] == FREE or kinds[i, j + 1, k] == FREE or kinds[i, j, k + 1] == FREE
                ):
                    continue
                if count == found.shape[0]:
                    more = np.empty((2 * count, 3), dtype=np.int64)
                    more[:count] = found
                    found = more
                    more = np.empty((2 * count, 3), dtype=np.int64)
                    more[:count] = outward
                    outward = more
                found[count, 0], found[count, 1], found[count, 2] = i, j, k
                outward[count, 0], outward[count, 1], outward[count, 2] = x, y, z
                count += 1
    return found[:count].copy(), outward[:count].copy()
