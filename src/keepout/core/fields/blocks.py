"""How the blocks of a grid field hang together: what one takes over from the coarser level, and what is its own."""

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from keepout.core.fields.grid import BLOCK, STORED

NODES = np.arange(-1, BLOCK + 2)
"""Numbers of the nodes along a block's edge, from the lower face of its first cell."""
_SUBDIVISION = np.zeros((STORED, 7))
"""Coefficients of a half block of parent cells (nodes -1 to 5) to those of the child block (nodes -1 to 9)."""
for _row, _node in enumerate(NODES):
    _k = _node // 2
    if _node % 2 == 0:
        _SUBDIVISION[_row, _k : _k + 3] = (1 / 8, 6 / 8, 1 / 8)
    else:
        _SUBDIVISION[_row, _k + 1 : _k + 3] = (1 / 2, 1 / 2)


def inherited_coefficients(
    parents: Float[np.ndarray, "m 11 11 11"] | Float32[np.ndarray, "m 11 11 11"], blocks: Int[np.ndarray, "m 3"]
) -> Float[np.ndarray, "m 11 11 11"]:
    """Coefficients on each block's nodes with which it is the spline of its parent, the block of twice the spacing."""
    inherited = np.empty((len(blocks), STORED, STORED, STORED))
    for i, block in enumerate(blocks):
        x, y, z = 4 * (block % 2)
        window = parents[i, x : x + 7, y : y + 7, z : z + 7].astype(np.float64)
        inherited[i] = np.einsum("ai,bj,ck,ijk->abc", _SUBDIVISION, _SUBDIVISION, _SUBDIVISION, window, optimize=True)
    return inherited


def own_nodes(table: Int[np.ndarray, "a b c"], blocks: Int[np.ndarray, "m 3"]) -> Bool[np.ndarray, "m 11 11 11"]:
    """Whether every cell that a node reaches lies in a stored block, so that the node may leave the coarser spline."""
    stored = np.pad(table >= 0, 1)
    offsets = [(-1, 0) if n <= 1 else (0,) if n <= 6 else (0, 1) for n in NODES]
    own = np.ones((len(blocks), STORED, STORED, STORED), dtype=bool)
    near = np.empty((len(blocks), 3, 3, 3), dtype=bool)
    for i in range(3):
        for j in range(3):
            for k in range(3):
                near[:, i, j, k] = stored[blocks[:, 0] + i, blocks[:, 1] + j, blocks[:, 2] + k]
    for a, x in enumerate(offsets):
        for b, y in enumerate(offsets):
            for c, z in enumerate(offsets):
                reached = near[:, np.array(x)[:, None, None] + 1, np.array(y)[:, None] + 1, np.array(z) + 1]
                own[:, a, b, c] = reached.all(axis=(1, 2, 3))
    return own
