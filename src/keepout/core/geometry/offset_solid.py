"""The offset solid: everything a chaser cannot reach from outside, with a conservative signed distance to it.

The obstacle is the complement of the exterior of {d > offset}, where d is the unsigned distance to the surfaces. It
needs no orientation and no watertight mesh, and gives a sheet the thickness 2 offset. Gaps narrower than twice the
closing radius are sealed. Every doubt falls to "occupied".
"""

import functools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from keepout.core.errors import MeshError
from keepout.core.geometry.distance import Distance, Points
from keepout.core.geometry.octree import SQRT3, Cells, Hiding, refine
from keepout.core.progress import Progress, part_of, silent

_SURFACE_CELLS = 7e5
"""The default leaf grows so that about this many leaves lie on the surfaces: seconds and a few hundred megabytes."""
_FLOOD_CELLS = 5.0
"""Flood cells are at most this many to the closing radius, or the leaf if that is larger."""

_ASIDE, _WALK, _STRIDE = 1e-3, 24, 0.95
"""Metres that a walk from a surface starts aside of it; its steps; and what share of the distance to the nearest
surface a step may take: less than all, so that no walk passes through one."""
_PATIENCE, _CLIMB = 6, 1.02
"""Steps in which a walk must come so many times as far from every surface, or it is in a gap, and ends. Single steps
may climb less, where they cross from the one wall of a corner to the other."""

_UNDECIDED, _FREE, _HIDDEN = 0, 1, 2
_STEPS = 64
_JUMPS = (0.95, 1.5, 2.5, 4.0)
"""Steps of a walk on the octree, in units of the larger of d and the cell's side."""


@dataclass(frozen=True, eq=False)
class OffsetSolid:
    """The complement of the exterior of {d > offset}, and a signed distance to it.

    The exterior is found in two octrees. The first floods cells that are wholly farther than the closing radius from
    every surface, face to face from outside. The second covers what is left with cells that are either *open* (their
    centre can walk up the distance, staying off every surface, into the flood) or *hidden*. A point is exterior when it
    is farther than the offset from every surface and not in a hidden cell. The signed distance is

        g(p) = min(d(p) - offset, signed distance from p to the union H of the hidden cells).

    Both terms are 1-Lipschitz, so g is, across sealed mouths too. Nowhere is it more than d - offset. With ρ the leaf's
    half-diagonal, a hidden cell next to a surface reaches past it by at most ρ where ρ ≤ offset, and 2 ρ - offset
    otherwise: outside, away from sealed gaps, g ≥ d - `envelope`, with g = d - offset where ρ ≤ offset. Inside, -g
    never overstates the way out by more than the closing of gaps makes it longer, and understates it by at most offset
    + ρ.

    "Connected" is tested by walks that may pass closer to a surface than the offset, never through one. So a point
    behind a pinch narrower than 2 offset counts as exterior only where its own leaf reaches through the pinch.
    """

    distance: Distance
    offset: float
    closing_radius: float
    _cells: Cells
    _hidden: Bool[np.ndarray, "n"]

    @classmethod
    def build(
        cls,
        distance: Distance,
        *,
        offset: float = 0.03,
        closing_radius: float = 0.25,
        leaf: float | None = None,
        progress: Progress = silent,
    ) -> "OffsetSolid":
        """Build the solid from an exact distance.

        Args:
            distance: exact unsigned distance to the surfaces.
            offset: metres; every surface gets this thickness on both sides.
            closing_radius: metres, at least the offset; a gap that a ball of this radius cannot pass is sealed. Choose
                the chaser's radius, or 0.25 m if that is less.
            leaf: side of the smallest cells, metres. Default: 2 offset / √3, which makes ρ = offset, but at least 0.03
                m, and more where the surfaces are large: 0.04 m for a comsat, 0.12 m for the ISS.
            progress: called as the build advances.

        Raises:
            MeshError: an offset that is not positive, a closing radius below the offset, or a leaf that is not
                positive.

        """
        extent = float((distance.upper - distance.lower).max())
        if leaf is None:
            leaf = max(2.0 * offset / SQRT3, 0.03, float(np.sqrt(distance.area / _SURFACE_CELLS)))
        if not offset > 0.0:
            raise MeshError(f"offset: {offset} m; it must be positive")
        if not closing_radius >= offset:
            raise MeshError(f"closing_radius: {closing_radius} m; it must be at least the offset, {offset} m")
        if not leaf > 0.0:
            raise MeshError(f"leaf: {leaf} m; it must be positive")

        depth = max(1, int(np.ceil(np.log2((extent + 2.0 * closing_radius + 8.0 * leaf) / leaf))))
        side = leaf * 2.0**depth
        origin = 0.5 * (distance.lower + distance.upper) - 0.5 * side
        coarser = max(0, int(np.log2(closing_radius / (_FLOOD_CELLS * leaf)) + 1.0)) if closing_radius > leaf else 0
        lake, free, flooded = _flood(
            distance, origin, side, depth - coarser, closing_radius, part_of(progress, 0.0, 0.5)
        )
        cells, hidden = _hidden_cells(distance, lake, free, flooded, depth, offset, part_of(progress, 0.5, 1.0))
        progress(1.0, f"{int(hidden.sum())} hidden cells")
        return cls(distance, offset, closing_radius, cells, hidden)

    def is_exterior(self, points: Points, d: Float[np.ndarray, "n"] | None = None) -> Bool[np.ndarray, "n"]:
        """Whether each point can be reached from outside: True where the signed distance is positive.

        Args:
            points: (n, 3) metres.
            d: `distance` there, metres, where that is known; else it is asked.

        """
        points = np.ascontiguousarray(points, dtype=np.float64)
        cell = self._cells.locate(points)
        exterior = (cell < 0) | ~self._hidden[cell]
        exterior[exterior] = (self.distance.distance(points[exterior]) if d is None else d[exterior]) > self.offset
        return exterior

    def signed_distance(self, points: Points, d: Float[np.ndarray, "n"] | None = None) -> Float[np.ndarray, "n"]:
        """Signed distance in metres to the complement of the exterior of {d > offset}; see the class.

        Args:
            points: (n, 3) metres.
            d: `distance` there, metres, where that is known; else it is asked.

        """
        points = np.ascontiguousarray(points, dtype=np.float64)
        signed = (self.distance.distance(points) if d is None else d) - self.offset
        cell = self._cells.locate(points)
        inside = (cell >= 0) & self._hidden[cell]
        depth = self._hiding.nearest(False, points[inside], np.full(int(inside.sum()), np.inf))
        signed[inside] = np.minimum(signed[inside], -depth)
        outside = np.flatnonzero(~inside & (signed > 0.0))
        signed[outside] = self._hiding.nearest(True, points[outside], signed[outside])
        return signed

    def is_reachable(self, points: Points, d: Float[np.ndarray, "n"] | None = None) -> Bool[np.ndarray, "n"]:
        """Whether a walk up the distance from each point, of `envelope` at most, comes out into the exterior.

        True for the exterior, and for what lies between it and the surface beside it: the skin of thickness `offset`
        and the cells that cover it. From a point on a surface the walk goes to both sides.

        Args:
            points: (n, 3) metres.
            d: `distance` there, metres, where that is known; else it is asked.

        """
        points = np.ascontiguousarray(points, dtype=np.float64)
        d = self.distance.distance(points) if d is None else d
        reachable = self.is_exterior(points, d)
        undecided = np.flatnonzero(~reachable & (d < self.envelope))
        d = d[undecided]
        # Away from the nearest surface; on a surface, to the one side and, where that leads nowhere, to the other.
        aside = np.random.default_rng(0).normal(size=(len(undecided), 3))
        aside *= (_ASIDE * (d < _ASIDE) / np.linalg.norm(aside, axis=1))[:, None]
        for side in (1.0, -1.0):
            walkers, going, before = points[undecided] + side * aside, np.arange(len(undecided)), np.zeros(len(d))
            for step in range(_WALK):
                here, gradient = self.distance.distance_and_gradient(walkers[going])
                stride = np.clip(1.1 * self.envelope - here, 0.0, _STRIDE * here)
                walkers[going] += stride[:, None] * gradient
                on = stride > 0.0
                if step % _PATIENCE == _PATIENCE - 1:
                    on &= here > _CLIMB * before[going]
                    before[going] = here
                going = going[on]
            reachable[undecided] = self.is_exterior(walkers)
            again = ~reachable[undecided] & (d < _ASIDE)
            undecided, aside, d = undecided[again], aside[again], d[again]
        return reachable

    @property
    def envelope(self) -> float:
        """Metres: the most that an exterior point's signed distance lies below d, away from sealed gaps."""
        reach = SQRT3 * 0.5 * self._cells.side / 2**self._cells.depth
        return self.offset if reach <= self.offset else 2.0 * reach - self.offset

    @functools.cached_property
    def sealed_volume(self) -> float:
        """Cubic metres of the sealed solid: the hidden cells. The skin of thickness `offset` is not counted."""
        return float(((2.0 * self._cells.half_width[self._hidden]) ** 3).sum())

    @functools.cached_property
    def _hiding(self) -> Hiding:
        return Hiding(self._cells, self._hidden)


def _flood(
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


def _hidden_cells(
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
        fate = np.where(free[holder], np.where(flooded[holder], _FREE, _HIDDEN), _UNDECIDED).astype(np.int8)
        return ~settled & (d <= half_width * SQRT3), (fate, d, gradient.astype(np.float32))

    cells, (fate, d, gradient) = refine(lake.origin, lake.side, depth, visit, 3)
    settled_open = fate == _FREE
    undecided = fate == _UNDECIDED
    end = cells.ends_of_walks(undecided, d, gradient, _JUMPS)
    fate = fate[end]
    ends = np.flatnonzero((fate == _UNDECIDED) & (end == np.arange(len(d), dtype=np.int32)))
    fate[ends] = _walk(distance, cells, fate, d, end, ends)
    hidden = fate[end] != _FREE
    # In a cell of half-diagonal ρ > offset a point p with d(p) > offset could lie past a surface from the centre q, but
    # only if |p - q| > offset + d(q).
    hidden |= d < SQRT3 * cells.half_width - offset
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
    higher than it began joins that one. A walk that hardly climbs is in a gap to be sealed.
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
        if step % _PATIENCE == 0:
            climbing = here > _CLIMB * before
            active, p, gradient, here = active[climbing], p[climbing], gradient[climbing], here[climbing]
            before = here
        p = p + 0.95 * here[:, None] * gradient
        holder = cells.locate(p)
        here, gradient = distance.distance_and_gradient(p)
        seen = np.linalg.norm(p - cells.at(holder), axis=1) < np.maximum(here, d[holder])
        found = np.where(holder < 0, _FREE, np.where(seen, fate[holder], _UNDECIDED))
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
