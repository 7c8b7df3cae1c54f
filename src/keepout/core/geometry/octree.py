"""Octrees over a cube: cells refined level by level, a block of cells at once, and walks on them in compiled loops.

The terminal cells stay in flat arrays in Morton order; the tree over them is one table of eight children a node. The
walks are short and branch at every step, which is the wrong shape for array code: in NumPy the neighbours alone took
most of the time and memory of an offset solid.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from keepout.core.cores import kernel, share_among_cores
from keepout.core.errors import MeshError
from keepout.core.geometry.distance import Distance, Points, morton

SQRT3 = float(np.sqrt(3.0))
DEEPEST_LEVEL = 20  # three interleaved coordinates of 20 bits fit a signed 64-bit code
_BLOCK = 1 << 16
"""Cells at once: bounds the memory of a level."""
CORNERS = np.array([(i, j, k) for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)], dtype=np.float64)
"""Of a cube, from its centre, in half widths."""
_CHILDREN = ((CORNERS + 1.0) / 2.0).astype(np.int32)
_STACK = 8 * 21 + 8
_HIDDEN, _OPEN = 1, 2


@dataclass(frozen=True, eq=False)
class Cells:
    """Terminal cells of an octree over a cube, in Morton order; `index` is a cell's place among those of its level."""

    origin: Float[np.ndarray, "3"]
    side: float
    depth: int
    level: Int[np.ndarray, "n"]
    index: Int[np.ndarray, "n 3"]

    @property
    def half_width(self) -> Float[np.ndarray, "n"]:
        """Half the side of each cell, metres."""
        return 0.5 * self.side * 0.5 ** self.level.astype(np.float64)

    def at(self, chosen: Int[np.ndarray, "m"]) -> Float[np.ndarray, "m 3"]:
        """Centres of chosen cells, metres."""
        half_width = 0.5 * self.side * 0.5 ** self.level[chosen].astype(np.float64)
        return self.origin + (2.0 * self.index[chosen] + 1.0) * half_width[:, None]

    def locate(self, points: Points) -> Int[np.ndarray, "m"]:
        """Find the cell that holds each point, or -1 outside the cube."""
        return _locate(self.child, self.depth, self.scaled(points))

    def scaled(self, points: Points) -> Points:
        """Express points from the cube's lowest corner, in sides of the deepest level's cells."""
        return (points - self.origin) / self.unit

    @property
    def unit(self) -> float:
        """Side of the deepest level's cells, metres."""
        return self.side / 2.0**self.depth

    @functools.cached_property
    def child(self) -> Int[np.ndarray, "nodes 8"]:
        """Children of every node above the cells: a node, or ~i for the terminal cell i.

        Nodes come before their children; node 0 is the whole cube.
        """
        level = self.level
        child = np.empty(((len(level) - 1) // 7 + (len(level) == 1), 8), dtype=np.int32)
        if len(level) == 1:
            child[:] = ~0
        else:
            _fill(level, child)
        return child

    def connected(self, chosen: Bool[np.ndarray, "n"], seeds: Bool[np.ndarray, "n"]) -> Bool[np.ndarray, "n"]:
        """Chosen cells connected to a chosen seed through faces of chosen cells."""
        return _connected(self.child, self.depth, self.index, self.level, chosen, seeds)

    def ends_of_walks(
        self,
        undecided: Bool[np.ndarray, "n"],
        d: Float[np.ndarray, "n"],
        gradient: Float[np.ndarray, "n 3"],
        jumps: tuple[float, ...],
    ) -> Int[np.ndarray, "n"]:
        """Cell in which the walk from each cell's centre up the distance ends; decided cells end in themselves.

        A step is one of `jumps` times the larger of d and the cell's side, and leads from a cell to another one up the
        distance that its centre sees past no surface.
        """
        return _ends_of_walks(
            self.child, self.depth, self.index, self.level, undecided, d, gradient, self.unit, np.array(jumps)
        )


class Hiding:
    """Distances to the hidden cells of an octree, and to the open ones."""

    def __init__(self, cells: Cells, hidden: Bool[np.ndarray, "n"]):
        self._cells, self._hidden = cells, hidden
        self._contents = _contents(cells.child, hidden)

    def nearest(self, hidden: bool, points: Points, bound: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Distance to the hidden, or the open, cells in metres, or the bound if less."""
        cells = self._cells
        scaled, limit = cells.scaled(points), bound / cells.unit
        near = np.empty(len(points))

        def work(part: slice) -> None:
            near[part] = _nearest(
                cells.child, cells.depth, self._contents, self._hidden, hidden, scaled[part], limit[part]
            )

        share_among_cores(work, len(points))
        # Bounds that hold come back untouched by rounding.
        return np.where(near < limit, near * cells.unit, bound)


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


def straddling_cells(distance: Distance, level: float, *, leaf: float) -> tuple[Points, Float[np.ndarray, "n"]]:
    """Cubes that together cover {d = level}, each possibly meeting it.

    A cube of centre c and half-diagonal ρ is dropped only when |d(c) - level| > ρ, which a 1-Lipschitz distance makes
    a proof that it does not meet the level set.

    Args:
        distance: exact unsigned distance.
        level: the distance whose level set is covered, metres, zero or more.
        leaf: sides are at most this, metres.

    Returns:
        Centres (N, 3) and half widths (N,), metres.

    Raises:
        MeshError: a leaf that is not positive.

    """
    if not leaf > 0.0:
        raise MeshError(f"leaf: {leaf} m; it must be positive")
    pad = level + leaf
    lower, upper = distance.lower - pad, distance.upper + pad
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


@kernel()
def _fill(level, child):
    node, slot = np.zeros(24, dtype=np.int64), np.zeros(24, dtype=np.int64)
    depth, used, cell = 0, 1, 0
    while depth >= 0:
        if slot[depth] == 8:
            depth -= 1
            continue
        here = slot[depth]
        slot[depth] += 1
        if level[cell] == depth + 1:
            child[node[depth], here] = ~cell
            cell += 1
        else:
            child[node[depth], here] = used
            depth += 1
            node[depth], slot[depth] = used, 0
            used += 1


@kernel(inline="always")
def _descend(child, depth, x, y, z, stop):
    """Entry that holds a position on the grid of the deepest level: a cell ~i, or the node at level `stop`."""
    entry = 0
    for bit in range(depth - 1, depth - 1 - stop, -1):
        entry = child[entry, ((x >> bit) & 1) | (((y >> bit) & 1) << 1) | (((z >> bit) & 1) << 2)]
        if entry < 0:
            break
    return entry


@kernel()
def _locate(child, depth, scaled):
    """Cell of each point, given in units of the deepest level's cells from the cube's corner; -1 outside the cube."""
    found = np.full(len(scaled), -1, dtype=np.int64)
    size = 1 << depth
    for i in range(len(scaled)):
        x, y, z = np.floor(scaled[i, 0]), np.floor(scaled[i, 1]), np.floor(scaled[i, 2])
        if x >= 0 and y >= 0 and z >= 0 and x < size and y < size and z < size:
            found[i] = ~_descend(child, depth, int(x), int(y), int(z), depth)
    return found


@kernel(inline="always")
def _root(parent, i):
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@kernel()
def _connected(child, depth, index, level, chosen, seeds):
    """Chosen cells that are connected to a chosen seed through faces of chosen cells: union-find with path halving."""
    parent = np.empty(len(level), dtype=np.int32)
    for a in range(len(level)):
        parent[a] = a
    for a in range(len(level)):
        if not chosen[a]:
            continue
        size = 1 << (depth - level[a])
        for axis in range(3):
            for step in (-1, size):
                x, y, z = index[a, 0] * size, index[a, 1] * size, index[a, 2] * size
                if axis == 0:
                    x += step
                elif axis == 1:
                    y += step
                else:
                    z += step
                if min(x, y, z) < 0 or max(x, y, z) >= 1 << depth:
                    continue
                # Smaller neighbours find this cell from their side.
                entry = _descend(child, depth, x, y, z, level[a])
                if entry < 0 and chosen[~entry]:
                    one, other = _root(parent, a), _root(parent, ~entry)
                    if one < other:
                        parent[other] = one
                    else:
                        parent[one] = other
    wet = np.zeros(len(level), dtype=np.bool_)
    for a in range(len(level)):
        if chosen[a] and seeds[a]:
            wet[_root(parent, a)] = True
    for a in range(len(level)):
        wet[a] = chosen[a] and wet[_root(parent, a)]
    return wet


@kernel()
def _ends_of_walks(child, depth, index, level, undecided, d, gradient, unit, jumps):
    """See `Cells.ends_of_walks`; `unit` is the side of the deepest level's cells in metres."""
    end = np.empty(len(level), dtype=np.int32)
    for a in range(len(level)):
        end[a] = a
    limit = 1 << depth
    for a in range(len(level)):
        if not undecided[a] or d[a] <= 0.0:
            continue
        size = float(1 << (depth - level[a]))
        x, y, z = (index[a, 0] + 0.5) * size, (index[a, 1] + 0.5) * size, (index[a, 2] + 0.5) * size
        for jump in jumps:
            step = jump * max(d[a] / unit, size)
            px = np.floor(x + step * gradient[a, 0])
            py = np.floor(y + step * gradient[a, 1])
            pz = np.floor(z + step * gradient[a, 2])
            if min(px, py, pz) < 0 or max(px, py, pz) >= limit:
                continue
            b = ~_descend(child, depth, int(px), int(py), int(pz), depth)
            there = float(1 << (depth - level[b]))
            apart = np.sqrt(
                ((index[b, 0] + 0.5) * there - x) ** 2
                + ((index[b, 1] + 0.5) * there - y) ** 2
                + ((index[b, 2] + 0.5) * there - z) ** 2
            )
            # Both centres lie in the ball of free space round one of them, so no surface is between them.
            if d[b] > d[a] and apart * unit < d[b]:
                end[a] = b
                break
    for a in range(len(level)):
        last = a
        while end[last] != last:
            last = end[last]
        here = a
        while end[here] != last:
            end[here], here = last, end[here]
    return end


@kernel()
def _contents(child, hidden):
    """Whether hidden (bit 0) and open (bit 1) cells are under each node."""
    holds = np.zeros(len(child), dtype=np.int8)
    for node in range(len(child) - 1, -1, -1):
        for k in range(8):
            entry = child[node, k]
            if entry >= 0:
                holds[node] |= holds[entry]
            else:
                holds[node] |= _HIDDEN if hidden[~entry] else _OPEN
    return holds


@kernel()
def _nearest(child, depth, holds, hidden, wanted, scaled, bound):
    """Distance from each point to the cells that are hidden (or, if `wanted` is False, open), or the bound if less.

    Branch and bound, near children first; points and distances are in units of the deepest level's cells, in which the
    corners of cells are exact.
    """
    answer = bound.copy()
    kind = _HIDDEN if wanted else _OPEN
    entries = np.empty(_STACK, dtype=np.int64)
    sizes = np.empty(_STACK)
    corners = np.empty((_STACK, 3))
    bounds = np.empty(_STACK)
    for i in range(len(scaled)):
        px, py, pz = scaled[i, 0], scaled[i, 1], scaled[i, 2]
        best = bound[i] * bound[i]
        improved = False
        entries[0], sizes[0], bounds[0] = 0, float(1 << depth), 0.0
        corners[0] = 0.0
        waiting = 1
        while waiting > 0:
            waiting -= 1
            if bounds[waiting] >= best:
                continue
            node, half = entries[waiting], 0.5 * sizes[waiting]
            x, y, z = corners[waiting, 0], corners[waiting, 1], corners[waiting, 2]
            near = (px >= x + half) | ((py >= y + half) << 1) | ((pz >= z + half) << 2)
            # Pushed from far to near, so that the nearest child comes off first.
            for turn in (7, 6, 5, 3, 4, 2, 1, 0):
                k = near ^ turn
                entry = child[node, k]
                if entry < 0:
                    if hidden[~entry] != wanted:
                        continue
                elif holds[entry] & kind == 0:
                    continue
                cx, cy, cz = x + (k & 1) * half, y + ((k >> 1) & 1) * half, z + ((k >> 2) & 1) * half
                dx = max(max(cx - px, px - cx - half), 0.0)
                dy = max(max(cy - py, py - cy - half), 0.0)
                dz = max(max(cz - pz, pz - cz - half), 0.0)
                squared = dx * dx + dy * dy + dz * dz
                if squared >= best:
                    continue
                if entry < 0 or holds[entry] == kind:
                    best = squared
                    improved = True
                else:
                    entries[waiting], sizes[waiting], bounds[waiting] = entry, half, squared
                    corners[waiting, 0], corners[waiting, 1], corners[waiting, 2] = cx, cy, cz
                    waiting += 1
        if improved:
            answer[i] = np.sqrt(best)
    return answer
