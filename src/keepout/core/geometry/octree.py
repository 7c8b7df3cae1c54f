"""Linear octrees over a cube: cells refined level by level, a block of cells at once."""

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from keepout.core.errors import MeshError
from keepout.core.geometry import cell_tree
from keepout.core.geometry.distance import Distance

SQRT3 = float(np.sqrt(3.0))
DEEPEST_LEVEL = 20  # three interleaved coordinates of 20 bits fit a signed 64-bit code
_BLOCK = 1 << 16
"""Cells at once: bounds the memory of a level."""
CORNERS = np.array([(i, j, k) for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)], dtype=np.float64)
"""Of a cube, from its centre, in half widths."""
_CHILDREN = ((CORNERS + 1.0) / 2.0).astype(np.int32)


@dataclass(frozen=True, eq=False)
class Cells:
    """Terminal cells of an octree over a cube, in Morton order."""

    origin: Float[np.ndarray, "3"]
    side: float
    depth: int
    level: Int[np.ndarray, "n"]
    index: Int[np.ndarray, "n 3"]
    """Integer position at the cell's own level."""

    @property
    def half_width(self) -> Float[np.ndarray, "n"]:
        """Half the side of each cell, metres."""
        return 0.5 * self.side * 0.5 ** self.level.astype(np.float64)

    @property
    def half_diagonal(self) -> Float[np.ndarray, "n"]:
        """From the centre of each cell to its corners, metres."""
        return SQRT3 * self.half_width

    def at(self, chosen: Int[np.ndarray, "m"]) -> Float[np.ndarray, "m 3"]:
        """Centres of chosen cells, metres."""
        half_width = 0.5 * self.side * 0.5 ** self.level[chosen].astype(np.float64)
        return self.origin + (2.0 * self.index[chosen] + 1.0) * half_width[:, None]

    def locate(self, points: Float[np.ndarray, "m 3"]) -> Int[np.ndarray, "m"]:
        """Find the cell that holds each point, or -1 outside the cube."""
        return cell_tree.locate(self.child, self.depth, self.scaled(points))

    def scaled(self, points: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "m 3"]:
        """Express points from the cube's lowest corner, in sides of the deepest level's cells."""
        return (points - self.origin) / self.unit

    @property
    def unit(self) -> float:
        """Side of the deepest level's cells, metres."""
        return self.side / 2.0**self.depth

    @functools.cached_property
    def child(self) -> cell_tree.Child:
        """Children of the nodes above the cells; see `cell_tree.build`."""
        return cell_tree.build(self.level)

    def connected(self, chosen: Bool[np.ndarray, "n"], seeds: Bool[np.ndarray, "n"]) -> Bool[np.ndarray, "n"]:
        """Chosen cells connected to a chosen seed through faces of chosen cells."""
        return cell_tree.connected(self.child, self.depth, self.index, self.level, chosen, seeds)


def morton(index: Int[np.ndarray, "n 3"]) -> Int[np.ndarray, "n"]:
    """Interleave three coordinates of up to 20 bits into one code (Morton 1966)."""
    return _spread(index[:, 0]) | (_spread(index[:, 1]) << 1) | (_spread(index[:, 2]) << 2)


def _spread(x: Int[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
    """Move bit i to bit 3 i."""
    x = x & 0x1FFFFF
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        x = (x | (x << shift)) & mask
    return x


def refine(
    origin: Float[np.ndarray, "3"],
    side: float,
    depth: int,
    visit: Callable[[Float[np.ndarray, "n 3"], float, int], tuple[Bool[np.ndarray, "n"], tuple[np.ndarray, ...]]],
    rows: int,
) -> tuple[Cells, tuple[np.ndarray, ...]]:
    """Split the cube until `visit` says no or a cell is `depth` halvings deep.

    Args:
        origin: lowest corner of the cube, metres.
        side: of the cube, metres.
        depth: of the smallest cells.
        visit: called for every level with blocks of its cells as `visit(centres, half_width, level)`; answers which of
            them to split (disregarded at `depth`) and arrays of figures, one row a cell.
        rows: how many arrays of figures `visit` answers.

    Returns:
        The terminal cells, and the figures of each.

    Raises:
        MeshError: deeper than 20 levels, where positions no longer fit the code.

    """
    if depth > DEEPEST_LEVEL:
        raise MeshError(f"octree: {depth} levels asked; a leaf of at least 1e-6 of the target's size needs 20 or fewer")
    index = np.zeros((1, 3), dtype=np.int32)
    codes, levels, indices = [], [], []
    figures: list[list[np.ndarray]] = [[] for _ in range(rows)]
    for level in range(depth + 1):
        half_width = 0.5 * side / 2**level
        children = []
        for start in range(0, len(index), _BLOCK):
            block = index[start : start + _BLOCK]
            wanted, answers = visit(origin + (2.0 * block + 1.0) * half_width, half_width, level)
            if level == depth:
                wanted = np.zeros(len(block), dtype=bool)
            done = block[~wanted]
            codes.append(morton(done.astype(np.int64) << (depth - level)))
            levels.append(np.full(len(done), level, dtype=np.int8))
            indices.append(done)
            for row, answer in zip(figures, answers):
                row.append(answer[~wanted])
            children.append((2 * block[wanted][:, None, :] + _CHILDREN).reshape(-1, 3))
        index = np.concatenate(children)
        if len(index) == 0:
            break
    # Each list is emptied as it is joined: at this point they are most of the memory.
    order = np.argsort(_joined(codes))
    cells = Cells(origin, side, depth, _joined(levels)[order], _joined(indices)[order])
    return cells, tuple(_joined(row)[order] for row in figures)


def _joined(blocks: list[np.ndarray]) -> np.ndarray:
    whole = np.concatenate(blocks)
    blocks.clear()
    return whole


def straddling_cells(
    distance: Distance,
    level: float,
    *,
    leaf: float,
    lower: Float[np.ndarray, "3"],
    upper: Float[np.ndarray, "3"],
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]]:
    """Cubes that together cover {d = level} inside a box, each possibly meeting it.

    A cube of centre c and half-diagonal ρ is dropped only when |d(c) - level| > ρ, which a 1-Lipschitz distance makes
    a proof that it does not meet the level set.

    Args:
        distance: exact unsigned distance.
        level: the distance whose level set is covered, metres, zero or more.
        leaf: sides are at most this, metres.
        lower: corner of the box, metres.
        upper: opposite corner of the box, metres.

    Returns:
        Centres (N, 3) and half widths (N,), metres.

    Raises:
        MeshError: a leaf that is not positive, or a box without volume.

    """
    lower, upper = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
    if not leaf > 0.0:
        raise MeshError(f"leaf: {leaf} m; it must be positive")
    if not (upper > lower).all():
        raise MeshError(f"box: lower {lower} and upper {upper}; every upper coordinate must exceed the lower one")
    half_width = 0.5 * float((upper - lower).min())
    counts = np.ceil((upper - lower) / (2.0 * half_width) - 1e-9).astype(int)
    steps = [np.arange(n) for n in counts]
    grid = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)
    centres = lower + (2.0 * grid + 1.0) * half_width
    while True:
        meets_box = (centres - half_width <= upper).all(axis=1)
        centres = centres[meets_box]
        # The slack covers rounding of the distance and of the centres, far below any leaf.
        keep = np.abs(distance.distance(centres) - level) <= half_width * SQRT3 * (1.0 + 1e-9) + 1e-9
        centres = centres[keep]
        if 2.0 * half_width <= leaf * (1.0 + 1e-12) or len(centres) == 0:
            return centres, np.full(len(centres), half_width)
        half_width *= 0.5
        centres = (centres[:, None, :] + CORNERS * half_width).reshape(-1, 3)
