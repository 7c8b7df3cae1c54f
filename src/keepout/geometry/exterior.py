"""Which cells around a target can be reached from outside, by flooding and by walking up the distance."""

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
from jaxtyping import Bool, Float, Int

from keepout.geometry.distance import Distance, Points
from keepout.geometry.octree import SQRT3, Cells, refine
from keepout.progress import Progress

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

    cells, (free,) = refine(origin, side, depth, visit)
    component = _components(cells, free)
    last = (1 << cells.level.astype(np.int64)) - 1
    outer = free & ((cells.index == 0) | (cells.index == last[:, None])).any(axis=1)
    return cells, free, free & np.isin(component, np.unique(component[outer]))


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

    cells, (fate, d, gradient) = refine(lake.origin, lake.side, depth, visit)
    settled = fate
    successor = _successors(cells, fate, d, gradient)
    while True:
        further = successor[successor]
        if (further == successor).all():
            break
        successor = further
    fate = fate[successor]
    ends = np.flatnonzero((successor == np.arange(len(d))) & (fate == _UNDECIDED))
    fate[ends] = _walk(distance, cells, fate, d, ends)
    hidden = fate[successor] != _OPEN
    # In a cell of half-diagonal ρ > offset a point p with d(p) > offset could lie past a surface from the centre q, but
    # only if |p - q| > offset + d(q).
    hidden |= d < cells.half_diagonal - offset
    # A walk may jump over hidden cells, so open cells can be scattered through a gap that is all but sealed: seal it.
    component = _components(cells, ~hidden)
    reached = np.isin(component, np.unique(component[settled == _OPEN]))
    return cells, hidden | ~reached


def _components(cells: Cells, chosen: Bool[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
    """Label every cell with its component among the chosen ones, connected through faces; the others are alone."""
    edges = []
    for _, _, a, b in cells.face_neighbours(chosen):
        both = chosen[b]
        edges.append(np.stack([a[both], b[both]]))
    a, b = np.concatenate(edges, axis=1)
    graph = scipy.sparse.coo_matrix((np.ones(len(a), dtype=np.int8), (a, b)), shape=(len(chosen), len(chosen)))
    return scipy.sparse.csgraph.connected_components(graph, directed=False)[1]


def _successors(cells: Cells, fate: np.ndarray, d: np.ndarray, gradient: np.ndarray) -> np.ndarray:
    """For each undecided cell another one up the distance that its centre sees past no surface; otherwise itself."""
    successor = np.arange(len(d))
    open_ends = np.flatnonzero((fate == _UNDECIDED) & (d > 0.0))
    for jump in _JUMPS:
        start = cells.at(open_ends)
        step = jump * np.maximum(d[open_ends], 2.0 * cells.half_width[open_ends])
        there = cells.locate(start + step[:, None] * gradient[open_ends])
        apart = np.linalg.norm(cells.at(there) - start, axis=1)
        # Both centres lie in the ball of free space round one of them, so no surface is between them.
        seen = (there >= 0) & (d[there] > d[open_ends]) & (apart < np.maximum(d[there], d[open_ends]))
        successor[open_ends[seen]] = there[seen]
        open_ends = open_ends[~seen]
    return successor


def _walk(
    distance: Distance, cells: Cells, fate: Int[np.ndarray, "m"], d: Float[np.ndarray, "m"], ends: Int[np.ndarray, "k"]
) -> Int[np.ndarray, "k"]:
    """Walk up the distance from the centres of some cells, by exact steps, until a cell of known fate; hidden if none.

    Each step stays in the ball of free space round the last point. A walk that climbs less than 2 % in six steps is in
    a gap to be sealed; single steps may climb less, where they cross from the one wall of a corner to the other.
    """
    verdict = np.full(len(ends), _HIDDEN, dtype=np.int8)
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
        open_ended = found == _UNDECIDED
        active, p, before = active[open_ended], p[open_ended], before[open_ended]
        here, gradient = here[open_ended], gradient[open_ended]
    return verdict
