"""Linear octrees over a cube: cells refined level by level, all cells of a level at once."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from keepout.errors import MeshError
from keepout.geometry.distance import Distance

SQRT3 = float(np.sqrt(3.0))
DEEPEST_LEVEL = 20  # three interleaved coordinates of 20 bits fit a signed 64-bit code
_CORNERS = np.array([(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)], dtype=np.int64)


class Cells(NamedTuple):
    """Terminal cells of an octree over a cube, in Morton order, so that a point is located by binary search."""

    origin: Float[np.ndarray, "3"]
    side: float
    depth: int
    code: Int[np.ndarray, "n"]
    """Morton code of each cell's lowest corner on the grid of the deepest level."""
    level: Int[np.ndarray, "n"]
    index: Int[np.ndarray, "n 3"]
    """Integer position at the cell's own level."""

    @property
    def half_width(self) -> Float[np.ndarray, "n"]:
        """Half the side of each cell, metres."""
        return 0.5 * self.side / 2.0**self.level

    @property
    def centre(self) -> Float[np.ndarray, "n 3"]:
        """Centres, metres."""
        return self.origin + (2.0 * self.index + 1.0) * self.half_width[:, None]

    def locate(self, points: Float[np.ndarray, "m 3"]) -> Int[np.ndarray, "m"]:
        """The cell that holds each point, or -1 outside the cube."""
        scaled = np.floor((points - self.origin) * (2.0**self.depth / self.side))
        inside = ((scaled >= 0) & (scaled < 2**self.depth)).all(axis=1)
        found = np.full(len(points), -1, dtype=np.int64)
        found[inside] = self.locate_grid(scaled[inside].astype(np.int64))
        return found

    def locate_grid(self, grid: Int[np.ndarray, "m 3"]) -> Int[np.ndarray, "m"]:
        """The cell that holds each integer position of the deepest level; positions must lie in the cube."""
        return np.searchsorted(self.code, morton(grid), side="right") - 1


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
    split: Callable[[Float[np.ndarray, "n 3"], float, int], Bool[np.ndarray, "n"]],
) -> Cells:
    """Split the cube until `split(centres, half_width, level)` says no or a cell is `depth` halvings deep.

    `split` sees every cell of every level down to and including `depth`, and its answer at `depth` is ignored.

    Raises:
        MeshError: deeper than 20 levels, where positions no longer fit the code.

    """
    if depth > DEEPEST_LEVEL:
        raise MeshError(f"octree: {depth} levels asked; a leaf of at least 1e-6 of the target's size needs 20 or fewer")
    index = np.zeros((1, 3), dtype=np.int64)
    codes, levels, indices = [], [], []
    for level in range(depth + 1):
        half_width = 0.5 * side / 2**level
        wanted = split(origin + (2.0 * index + 1.0) * half_width, half_width, level)
        if level == depth:
            wanted = np.zeros(len(index), dtype=bool)
        done = index[~wanted]
        codes.append(morton(done << (depth - level)))
        levels.append(np.full(len(done), level, dtype=np.int64))
        indices.append(done)
        index = (2 * index[wanted][:, None, :] + _CORNERS).reshape(-1, 3)
        if len(index) == 0:
            break
    code, level, index = np.concatenate(codes), np.concatenate(levels), np.concatenate(indices)
    order = np.argsort(code)
    return Cells(origin, side, depth, code[order], level[order], index[order])


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
    corners = 2.0 * _CORNERS - 1.0
    while True:
        meets_box = (centres - half_width <= upper).all(axis=1)
        centres = centres[meets_box]
        # The slack covers rounding of the distance and of the centres, far below any leaf.
        keep = np.abs(distance.distance(centres) - level) <= half_width * SQRT3 * (1.0 + 1e-9) + 1e-9
        centres = centres[keep]
        if 2.0 * half_width <= leaf * (1.0 + 1e-12) or len(centres) == 0:
            return centres, np.full(len(centres), half_width)
        half_width *= 0.5
        centres = (centres[:, None, :] + corners * half_width).reshape(-1, 3)
