"""The one C² spline that a grid field's blocks stand for, and how far the stored coefficients are from it.

A block beside a coarser one stores the coarser spline's coefficients there, rounded to float32, so that the field as
stored jumps at a block's face by what was rounded. Leave out the rounding: take f*, on the coarsest level the spline
of the stored coefficients, and on each finer level

    f*_ℓ = f*_{ℓ+1} + Σ_i e_i B_i,     e_i what the stored coefficient adds to the coarser spline's own,

over the nodes i whose B-spline lies in the blocks stored on that level. Every B_i is C², so f* is. In a block, f* is
the spline of coefficients c*, and the weights of a spline are at least 0 and sum to 1; so |f̃ - f*| ≤ max |c - c*|
everywhere.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from keepout.core.errors import FieldError
from keepout.core.fields.blocks import NODES, inherited_coefficients, own_nodes
from keepout.core.fields.grid import BLOCK, STORED, GridField


class JoinedSpline(NamedTuple):
    """f*, block by block.

    Attributes:
        coefficients: c*, metres.
        spacing: of each block's level, metres.
        block: each block's place in the grid of blocks of its level.
        used: by octant, whether no finer block lies there, so that the field is this block's spline.
        difference: max |c - c*|, metres.

    """

    coefficients: Float[np.ndarray, "blocks 11 11 11"]
    spacing: Float[np.ndarray, "blocks"]
    block: Int[np.ndarray, "blocks 3"]
    used: Bool[np.ndarray, "blocks 2 2 2"]
    difference: float


def joined_spline(field: GridField) -> JoinedSpline:
    """Return the C² spline f* of a grid field.

    Raises:
        FieldError: its coarsest level has holes, or a block lies outside the next coarser level's.

    """
    stored = np.asarray(field.coefficients, np.float64).reshape(-1, STORED, STORED, STORED)
    joined = stored.copy()
    spacing, block = np.zeros(len(stored)), np.zeros((len(stored), 3), np.int64)
    used = np.ones((len(stored), 2, 2, 2), bool)
    tables = [np.asarray(table) for table in field.tables]
    if (tables[-1] < 0).any():
        raise FieldError("grid field: its coarsest level has holes; every block of that level must be stored")
    for level in range(len(tables) - 1, -1, -1):
        table = tables[level]
        blocks = np.argwhere(table >= 0)
        numbers = table[tuple(blocks.T)]
        spacing[numbers], block[numbers] = float(field.spacing) * 2**level, blocks
        if level < len(tables) - 1:
            parents = tables[level + 1][tuple((blocks // 2).T)]
            if (parents < 0).any():
                raise FieldError(f"grid field: a block of level {level} lies outside the blocks of level {level + 1}")
            used[(parents, *(blocks % 2).T)] = False
            joined[numbers] = np.where(
                own_nodes(table, blocks), stored[numbers], inherited_coefficients(joined[parents], blocks)
            )
        joined[numbers] = _one_value_a_node(joined[numbers], blocks)
    return JoinedSpline(joined, spacing, block, used, float(np.abs(joined - stored).max()))


def _one_value_a_node(
    coefficients: Float[np.ndarray, "m 11 11 11"], blocks: Int[np.ndarray, "m 3"]
) -> Float[np.ndarray, "m 11 11 11"]:
    """Give a node that several blocks share the value that the first of them has."""
    extent = BLOCK * (int(blocks.max(initial=0)) + 1) + STORED
    x, y, z = (BLOCK * blocks[:, axis, None] + NODES + 1 for axis in range(3))
    code = (x[:, :, None, None] * extent + y[:, None, :, None]) * extent + z[:, None, None, :]
    _, first, back = np.unique(code.reshape(-1), return_index=True, return_inverse=True)
    return coefficients.reshape(-1)[first][back].reshape(coefficients.shape)
