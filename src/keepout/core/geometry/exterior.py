"""Which cells around a target can be reached from outside, by flooding and by walking up the distance."""

import numpy as np
from jaxtyping import Bool, Float, Int

from keepout.core.geometry import cell_tree
from keepout.core.geometry.distance import Distance, Points
from keepout.core.geometry.octree import SQRT3, Cells, refine
from keepout.core.progress import Progress

_UNDECIDED, _OPEN, _HIDDEN = 0, 1, 2
_STEPS = 64
_JUMPS = (0.95, 1.5, 2.5, 4.0)
"""Steps of a walk on the octree, in units of the larger of d and the cell's side."""


def flood(
    distance: Distance, origin: Float[np.ndarray, "3"], side: float, depth: int, radius: float, progress: Progress
) -> tuple[Cells, Bool[np.ndarray, "n"], Bool[np.ndarray, "n"]]:
    """Fill from outside, face to face, through cells that lie wholly farther than `radius` from every surface.

    Returns:
        The cells; whether each is free, d > radius throughout; and whether each is flooded: free and connected to the
        outside.

    """

    def visit(centres: Points, half_width: float, level: int) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
        progress(level / (depth + 1), f"flood: level {level} of {depth}")
        d, reach = distance.distance(centres), half_width * SQRT3
        return (d - reach <= radius) & (d + reach > radius), (d - reach > radius,)

    cells, (free,) = refine(origin, side, depth, visit, 1)
    last = (1 << cells.level.astype(np.int32)) - 1
    outer = (cells.index == 0).any(axis=1) | (cells.index == last[:, None]).any(axis=1)
    return cells, free, cells.connected(free, outer)


def hidden_cells(
    distance: Distance,
    lake: Cells,
    free: Bool[np.ndarray, "n"],
    flooded: Bool[np.ndarray, "n"],
    depth: int,
    offset: float,
    progress: Progress,
) -> tuple[Cells, Bool[np.ndarray, "m"]]:
    """Cover the cube with cells that are each open, reachable from the flood, or hidden.

    A cell whose centre is farther from every surface than its half-diagonal lies in one ball of free space, so its
    centre speaks for all of it; others are split down to `depth`, and there too the centre speaks for the cell. A
    centre is open when a walk up the distance, in steps that each stay in one ball without surfaces, ends in the
    flood.
    """

    def visit(centres: Points, half_width: float, level: int) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
        progress(level / (depth + 1), f"cover: level {level} of {depth}")
        holder = lake.locate(centres)
        settled = free[holder] & (lake.level[holder] <= level)
        d, gradient = distance.distance_and_gradient(centres)
        # A centre in free space speaks for its cell, even where the flood's own cells are finer.
        fate = np.where(free[holder], np.where(flooded[holder], _OPEN, _HIDDEN), _UNDECIDED).astype(np.int8)
        return ~settled & (d <= half_width * SQRT3), (fate, d, gradient.astype(np.float32))

    cells, (fate, d, gradient) = refine(lake.origin, lake.side, depth, visit, 3)
    settled_open = fate == _OPEN
    undecided = fate == _UNDECIDED
    end = cell_tree.ends_of_walks(
        cells.child, depth, cells.index, cells.level, undecided, d, gradient, cells.unit, np.array(_JUMPS)
    )
    fate = fate[end]
    ends = np.flatnonzero((fate == _UNDECIDED) & (end == np.arange(len(d), dtype=np.int32)))
    fate[ends] = _walk(distance, cells, fate, d, end, ends)
    hidden = fate[end] != _OPEN
    # In a cell of half-diagonal ρ > offset a point p with d(p) > offset could lie past a surface from the centre q, but
    # only if |p - q| > offset + d(q).
    hidden |= d < cells.half_diagonal - offset
    # A walk may jump over hidden cells, so open cells can be scattered through a gap that is all but sealed: seal it.
    return cells, ~cells.connected(~hidden, settled_open)


def _walk(
    distance: Distance,
    cells: Cells,
    fate: Int[np.ndarray, "m"],
    d: Float[np.ndarray, "m"],
    end: Int[np.ndarray, "m"],
    ends: Int[np.ndarray, "k"],
) -> Int[np.ndarray, "k"]:
    """Walk up the distance from the centres of some cells, by exact steps, until a cell of known fate; hidden if none.

    Each step stays in the ball of free space round the last point. A walk that comes to a cell whose own walk ends
    higher than it began joins that one. A walk that climbs less than 2 % in six steps is in a gap to be sealed; single
    steps may climb less, where they cross from the one wall of a corner to the other.
    """
    verdict = np.full(len(ends), _HIDDEN, dtype=np.int8)
    joined = ends.copy()
    active = np.flatnonzero(d[ends] > 0.0)
    p = cells.at(ends[active])
    here, gradient = distance.distance_and_gradient(p)
    before = np.zeros(len(active))
    for step in range(_STEPS):
        if len(active) == 0:
            break
        if step % 6 == 0:
            climbing = here > 1.02 * before
            active, p, gradient, here = active[climbing], p[climbing], gradient[climbing], here[climbing]
            before = here
        p = p + 0.95 * here[:, None] * gradient
        holder = cells.locate(p)
        here, gradient = distance.distance_and_gradient(p)
        seen = np.linalg.norm(p - cells.at(holder), axis=1) < np.maximum(here, d[holder])
        found = np.where(holder < 0, _OPEN, np.where(seen, fate[holder], _UNDECIDED))
        verdict[active[found != _UNDECIDED]] = found[found != _UNDECIDED]
        higher = seen & (found == _UNDECIDED) & (holder >= 0) & (d[end[holder]] > d[ends[active]])
        joined[active[higher]] = end[holder[higher]]
        going = (found == _UNDECIDED) & ~higher
        active, p, before, here, gradient = active[going], p[going], before[going], here[going], gradient[going]
    # Joined walks begin ever higher, so following them ends.
    place = np.searchsorted(ends, joined)
    while (place[place] != place).any():
        place = place[place]
    return verdict[place]
