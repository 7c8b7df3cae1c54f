"""Distance from each corner node of the cubes to the nearest cube that is not free: exact, capped, made anew locally.

The point of a cube nearest to a node is a corner of the cube, because nodes and corners are whole numbers of cells. So
the distance to the nearest cube that is not free is the distance to the nearest node that is a corner of one. Its
square is a whole number, found axis by axis: min over (dx, dy, dz) of dx² + dy² + dz². Tiles of 32 x 32 x 32 nodes are
made from the nodes within the cap of them, which is all that their values depend on: the answer is that of the whole
grid, bit for bit.
"""

import numpy as np
from jaxtyping import Bool, UInt16

from keepout.core.cores import kernel

TILE = 32
"""Nodes across a tile."""


@kernel()
def _lower(values, others, add):
    """Lower each value to the other's plus a number: 16-bit lanes."""
    for p in range(len(values)):
        other = np.uint16(others[p] + add)
        values[p] = other if other < values[p] else values[p]


@kernel()
def _blocked(free, i, j, first, line):
    """Set 1 in `line` for the nodes (i, j, first + p) that are a corner of a cube that is not free, else 0."""
    n = free.shape[0]
    line[:] = 0
    low, high = max(first, 0), min(first + len(line), n)
    for a in range(max(i - 1, 0), min(i + 1, n)):
        for b in range(max(j - 1, 0), min(j + 1, n)):
            row = free[a, b, low:high]
            here = line[low - first : high - first]
            for p in range(len(row)):
                here[p] |= np.uint8(0) if row[p] else np.uint8(1)
    # So far of the cube after each node; a node is also a corner of the cube before it.
    for p in range(len(line) - 1, 0, -1):
        line[p] |= line[p - 1]


@kernel()
def _tile(free, squares, start, cap, near, columns, out, line):
    """Make one tile of nodes anew; returns nothing, writes into `squares`.

    Args:
        free: (n, n, n) bool.
        squares: (n + 1, n + 1, n + 1) uint16.
        start: first node of the tile on each axis.
        cap: in cells.
        near: flat uint16 for (wide, wide, wide) nodes, wide = TILE + 2 cap.
        columns: flat uint16 for (TILE * wide + 2 cap) nodes; the `cap` at each end are for shifts.
        out: flat uint16 for (TILE * wide) nodes.
        line: uint8 for `wide` + 1 nodes.

    """
    nodes = squares.shape[0]
    wide = TILE + 2 * cap
    plane = wide * wide
    top = np.uint16(cap * cap)
    far = np.uint16(cap)
    seeds = 0
    # Along x: cells to the nearest blocked node, forwards, then backwards.
    for i in range(wide):
        here = near[i * plane : (i + 1) * plane]
        if i == 0:
            here[:] = far
        else:
            before = near[(i - 1) * plane : i * plane]
            for p in range(plane):
                value = np.uint16(before[p] + 1)
                here[p] = value if value < far else far
        node_i = start[0] - cap + i
        if node_i < 0 or node_i >= nodes:
            continue
        for j in range(wide):
            node_j = start[1] - cap + j
            if node_j < 0 or node_j >= nodes:
                continue
            # One node more before the first, for the cube before it.
            _blocked(free, node_i, node_j, start[2] - cap - 1, line)
            row = here[j * wide : (j + 1) * wide]
            for p in range(wide):
                seeds += line[p + 1]
                row[p] = np.uint16(0) if line[p + 1] else row[p]
    ends = min(start[0] + TILE, nodes), min(start[1] + TILE, nodes), min(start[2] + TILE, nodes)
    if seeds == 0:
        squares[start[0] : ends[0], start[1] : ends[1], start[2] : ends[2]] = top
        return
    for i in range(wide - 2, cap - 1, -1):
        _lower(near[i * plane : (i + 1) * plane], near[(i + 1) * plane : (i + 2) * plane], 1)
    for i in range(ends[0] - start[0]):
        here = near[(cap + i) * plane : (cap + i + 1) * plane]
        for p in range(plane):
            here[p] = np.uint16(here[p] * here[p])
        # Along y, for all z at once: rows are `wide` apart.
        body = columns[cap : cap + TILE * wide]
        body[:] = here[cap * wide : (cap + TILE) * wide]
        for shift in range(1, cap):
            _lower(body, here[(cap - shift) * wide : (cap - shift + TILE) * wide], shift * shift)
            _lower(body, here[(cap + shift) * wide : (cap + shift + TILE) * wide], shift * shift)
        # Along z; what a shift takes from a neighbouring row lands in the margins, which are not read.
        out[:] = body
        for shift in range(1, cap):
            _lower(out, columns[cap - shift : cap - shift + TILE * wide], shift * shift)
            _lower(out, columns[cap + shift : cap + shift + TILE * wide], shift * shift)
        for j in range(ends[1] - start[1]):
            made = squares[start[0] + i, start[1] + j, start[2] : ends[2]]
            made[:] = out[j * wide + cap : j * wide + cap + len(made)]


@kernel()
def _make(free, squares, cap, wanted):
    wide = TILE + 2 * cap
    near = np.empty(wide * wide * wide, dtype=np.uint16)
    columns = np.full(TILE * wide + 2 * cap, cap * cap, dtype=np.uint16)
    out = np.empty(TILE * wide, dtype=np.uint16)
    line = np.empty(wide + 1, dtype=np.uint8)
    made = 0
    for a in range(wanted.shape[0]):
        for b in range(wanted.shape[1]):
            for c in range(wanted.shape[2]):
                if not wanted[a, b, c]:
                    continue
                _tile(free, squares, (a * TILE, b * TILE, c * TILE), cap, near, columns, out, line)
                made += 1
    return made


def squares_of(free: Bool[np.ndarray, "n n n"], cap: int) -> UInt16[np.ndarray, "m m m"]:
    """Give the squared distance of each node to the nearest cube that is not free, in cells, capped at `cap` cells.

    Args:
        free: whether each cube is free; outside the grid everything is free.
        cap: in cells, at least 1.

    """
    nodes = free.shape[0] + 1
    squares = np.empty((nodes, nodes, nodes), dtype=np.uint16)
    tiles = -(-nodes // TILE)
    _make(free, squares, cap, np.ones((tiles, tiles, tiles), dtype=np.bool_))
    return squares


def renew(
    free: Bool[np.ndarray, "n n n"],
    squares: UInt16[np.ndarray, "m m m"],
    cap: int,
    changed: Bool[np.ndarray, "b b b"],
    block: int,
) -> int:
    """Bring `squares` up to date, in place, after cubes became free.

    Args:
        free: whether each cube is free now.
        squares: as they were before.
        cap: in cells.
        changed: blocks of which a cube became free.
        block: cubes across a block.

    Returns:
        How many tiles were made anew.

    """
    nodes = len(squares)
    # Of each block along an axis, the tiles that its change can reach; and so of all blocks.
    blocks, tiles = np.arange(len(changed)), np.arange(-(-nodes // TILE))[:, None]
    first, last = np.maximum(blocks * block - cap, 0) // TILE, np.minimum((blocks + 1) * block + cap, nodes - 1) // TILE
    reached = ((first <= tiles) & (tiles <= last)).astype(np.float32)
    wanted = np.einsum("ia,jb,kc,abc->ijk", *[reached] * 3, changed.astype(np.float32), optimize=True) > 0.0
    for tile in np.argwhere(wanted):
        # What is at the cap throughout stays so.
        made = squares[tuple(slice(TILE * place, TILE * (place + 1)) for place in tile)]
        wanted[tuple(tile)] = made.min() < cap * cap
    return _make(free, squares, cap, wanted)
