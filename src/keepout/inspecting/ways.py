"""Ways between places that keep the stand-off: their lengths on a grid of exact distances, and their courses.

The distance d to the mesh is 1-Lipschitz: on a straight piece of half length h about its middle m it is nowhere below
d(m) − h. A piece is *clear* where bisection proves d ≥ stand-off on all of it by that; nothing is sampled.
"""

import functools
import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from keepout.control.guidance.fast_marching import travel_time
from keepout.geometry.distance import Distance

MOST_NODES = 400_000
"""A grid takes the spacing, not below `_FINEST`, at which it has about so many nodes."""
_FINEST = 0.25
_SHORTEST = 0.004
"""Half length, m, of a piece that bisection gives up at: it counts as not clear."""
_NEAR = 2.5
"""Grid spacings about a place within which nodes are joined to it by straight pieces."""
_SWEEPS = 6
_PULLS = (1.0, 0.5, 0.25, 0.1)
_BATCH = 200_000


Node = tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Ways:
    """Ways in {d ≥ stand-off}; make one with `Ways.build`.

    Attributes:
        distance: to the mesh.
        stand_off: that a way keeps, m.
        origin: of node (0, 0, 0), m.
        spacing: of the nodes, m.
        open: nodes with d ≥ stand-off.
        walls: walls[a, i, j, k] closes the edge from node (i, j, k) to the next along axis a: it is not proved clear.

    """

    distance: Distance
    stand_off: float
    origin: Float[np.ndarray, "3"]
    spacing: float
    open: Bool[np.ndarray, "nx ny nz"]
    walls: Bool[np.ndarray, "3 nx ny nz"]

    @classmethod
    def build(
        cls,
        distance: Distance,
        stand_off: float,
        lower: Float[np.ndarray, "3"],
        upper: Float[np.ndarray, "3"],
        *,
        most_nodes: int = MOST_NODES,
    ) -> "Ways":
        """Lay the grid over a box (m) and find what is open.

        Args:
            distance: to the mesh.
            stand_off: that every way keeps, m.
            lower: corner of the box.
            upper: corner of the box; the places of all ways lie in it.
            most_nodes: about; the spacing follows.

        """
        lower, upper = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
        spacing = max(_FINEST, float(np.prod(upper - lower) / most_nodes) ** (1.0 / 3.0))
        shape = np.maximum(np.ceil((upper - lower) / spacing).astype(int) + 1, 3)
        origin = 0.5 * (lower + upper) - 0.5 * (shape - 1) * spacing
        nodes = origin + spacing * np.argwhere(np.ones(tuple(shape), dtype=bool))
        away = np.concatenate([distance.distance(part) for part in np.array_split(nodes, len(nodes) // _BATCH + 1)])
        away = away.reshape(tuple(shape))
        free = away >= stand_off
        ways = cls(distance, stand_off, origin, spacing, free, np.ones((3, *shape), dtype=bool))
        for axis in range(3):
            one, other = (np.moveaxis(values, axis, 0) for values in (free, away))
            wall = np.moveaxis(ways.walls[axis], axis, 0)
            both = one[:-1] & one[1:]
            sure = both & (other[:-1] + other[1:] - spacing >= 2.0 * stand_off)
            wall[:-1] = ~sure
            doubtful = np.argwhere(both & ~sure)
            at = np.empty_like(doubtful)
            at[:, axis], at[:, [a for a in range(3) if a != axis]] = doubtful[:, 0], doubtful[:, 1:]
            begin = origin + spacing * at
            wall[tuple(doubtful.T)] = ~ways.clear(begin, begin + spacing * np.eye(3)[axis])
        return ways

    def clear(self, begins: Float[np.ndarray, "m 3"], ends: Float[np.ndarray, "m 3"]) -> Bool[np.ndarray, " m"]:
        """Whether straight pieces are proved to keep the stand-off."""
        result = np.ones(len(begins), dtype=bool)
        middle, half = 0.5 * (begins + ends), 0.5 * np.linalg.norm(ends - begins, axis=1)
        across = 0.5 * (ends - begins)
        piece = np.arange(len(begins))
        while len(piece):
            away = self.distance.distance(middle)
            blocked = away < self.stand_off
            open_ = ~blocked & (away - half < self.stand_off)
            blocked |= open_ & (half < _SHORTEST)
            result[piece[blocked]] = False
            split = open_ & result[piece]
            middle = np.concatenate([middle[split] - 0.5 * across[split], middle[split] + 0.5 * across[split]])
            across, half = np.tile(0.5 * across[split], (2, 1)), np.tile(0.5 * half[split], 2)
            piece = np.tile(piece[split], 2)
        return result

    def lengths(self, places: Float[np.ndarray, "k 3"]) -> tuple[Float[np.ndarray, "k k"], Float[np.ndarray, "k k 3"]]:
        """Give the lengths (m) of the ways between all places, infinite where none leads, and how they set out.

        A straight way that is clear has its own length; another has that of the grid, which is a few per cent more
        than the shortest has.

        Returns:
            (k, k) lengths, and (k, k, 3) the unit vector in which the way from the first to the second leaves.

        """
        count = len(places)
        first, second = np.triu_indices(count, 1)
        straight = np.zeros((count, count), dtype=bool)
        straight[first, second] = self.clear(places[first], places[second])
        straight |= straight.T
        apart = places[None] - places[:, None]
        length: Float[np.ndarray, "k k"] = np.sqrt(np.sum(apart * apart, axis=2))
        leave = apart / np.maximum(length, 1e-12)[..., None]
        joined = [self._joined(place) for place in places]
        crooked = np.logical_not(straight | np.eye(count, dtype=bool))
        length[crooked] = np.inf
        for j in np.flatnonzero(crooked.any(axis=0)).tolist():
            times = self._march(*joined[j])
            for i in np.flatnonzero(crooked[:, j]).tolist():
                nodes, away = joined[i]
                if len(nodes) == 0:
                    continue
                through = times[tuple(nodes.T)] + away
                best = int(np.argmin(through))
                if through[best] < np.inf:
                    length[i, j] = max(through[best], float(np.linalg.norm(apart[i, j])))
                    course = self.origin + self.spacing * nodes[best] - places[i]
                    leave[i, j] = course / max(float(np.linalg.norm(course)), 1e-12)
        return np.minimum(length, length.T), leave

    def leads(self, place: Float[np.ndarray, "3"], places: Float[np.ndarray, "k 3"]) -> Bool[np.ndarray, " k"]:
        """Say to which places some way leads from one."""
        found = self.clear(np.tile(place, (len(places), 1)), places)
        if not found.all():
            times = self._march(*self._joined(place))
            for other in np.flatnonzero(~found).tolist():
                nodes, _ = self._joined(places[other])
                found[other] = bool(np.isfinite(times[tuple(nodes.T)]).any())
        return found

    def nearly(self, place: Float[np.ndarray, "3"], places: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, " k"]:
        """Give the lengths (m) of ways from one place to many, to within about a cell; infinite where none leads."""
        times = self._march(*self._joined(place))
        at = (places - self.origin) / self.spacing
        base = np.clip(np.floor(at).astype(int), 0, np.array(self.open.shape) - 2)
        found = np.full(len(places), np.inf)
        for corner in np.ndindex(2, 2, 2):
            node = base + corner
            through = times[tuple(node.T)] + self.spacing * np.linalg.norm(node - at, axis=1)
            found = np.minimum(found, through)
        return np.maximum(found, np.where(np.isfinite(found), np.linalg.norm(places - place, axis=1), 0.0))

    def path(self, begin: Float[np.ndarray, "3"], end: Float[np.ndarray, "3"]) -> Float[np.ndarray, "m 3"] | None:
        """Give the corners of a way, every piece of it clear; None where none leads.

        From a place nearer than the stand-off, the first piece leads straight to a node of the grid and is not clear.
        """
        begin, end = np.asarray(begin, dtype=np.float64), np.asarray(end, dtype=np.float64)
        if self.clear(begin[None], end[None])[0]:
            return np.stack([begin, end])
        nodes, away = self._joined(begin)
        times = self._march(*self._joined(end))
        if len(nodes) == 0 or not np.isfinite(through := times[tuple(nodes.T)] + away).any():
            return None
        node = tuple(int(i) for i in nodes[np.argmin(through)])
        corners = [begin, self.place(node)]
        near = {tuple(n) for n in self._joined(end)[0].tolist()}
        while node not in near:
            node = self._downhill(times, node)
            corners.append(self.place(node))
        return self._pulled(np.array([*corners, end]))

    def place(self, node: Node) -> Float[np.ndarray, "3"]:
        """Give a node's place, m."""
        return self.origin + self.spacing * np.asarray(node)

    @functools.cached_property
    def _speed(self) -> Float[np.ndarray, "nx ny nz"]:
        return self.open.astype(np.float64)

    def _march(self, nodes: Int[np.ndarray, "n 3"], away: Float[np.ndarray, " n"]) -> Float[np.ndarray, "nx ny nz"]:
        if len(nodes) == 0:
            return np.full(self.open.shape, np.inf)
        return travel_time(self._speed, self.walls, nodes, away, self.spacing)

    def _joined(self, place: Float[np.ndarray, "3"]) -> tuple[Int[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
        """Give the nodes joined to a place by clear pieces, and their distances from it, m.

        To a place nearer than the stand-off the nearest open node is joined, whatever is between.
        """
        at = (place - self.origin) / self.spacing
        inside = float(self.distance.distance(place[None])[0]) < self.stand_off
        reach = _NEAR + (math.ceil(self.stand_off / self.spacing) if inside else 0.0)
        low = np.maximum(np.floor(at - reach).astype(int), 0)
        high = np.minimum(np.ceil(at + reach).astype(int) + 1, self.open.shape)
        if np.any(high <= low):
            return np.zeros((0, 3), dtype=np.int64), np.zeros(0)
        nodes = np.argwhere(self.open[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]) + low
        away = self.spacing * np.linalg.norm(nodes - at, axis=1)
        if inside:
            keep = np.argsort(away)[:1]
            return nodes[keep], away[keep]
        keep = away <= _NEAR * self.spacing
        nodes, away = nodes[keep], away[keep]
        keep = self.clear(np.tile(place, (len(nodes), 1)), self.origin + self.spacing * nodes)
        return nodes[keep], away[keep]

    def _downhill(self, times: Float[np.ndarray, "nx ny nz"], node: Node) -> Node:
        best, least = node, times[node]
        for axis in range(3):
            for sign in (-1, 1):
                beside = tuple(n + sign * (a == axis) for a, n in enumerate(node))
                if not all(0 <= n < m for n, m in zip(beside, times.shape, strict=True)):
                    continue
                edge = beside if sign < 0 else node
                if not self.walls[(axis, *edge)] and times[beside] < least:
                    best, least = beside, times[beside]
        if best == node:
            raise AssertionError(f"no way down from node {node}")
        return best

    def _pulled(self, corners: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "n 3"]:
        """Leave corners out, and pull the rest towards the line between their neighbours, while all stays clear."""
        kept, here = [corners[0]], 0
        while here < len(corners) - 1:
            rest = corners[here + 1 :]
            seen = np.flatnonzero(self.clear(np.tile(corners[here], (len(rest), 1)), rest))
            here = here + 1 + (int(seen[-1]) if len(seen) else 0)
            kept.append(corners[here])
        way = np.array(kept)
        for _ in range(_SWEEPS):
            before = way_length(way)
            for i in range(1, len(way) - 1):
                a, c = way[i - 1], way[i + 1]
                share = np.clip((way[i] - a) @ (c - a) / max((c - a) @ (c - a), 1e-12), 0.0, 1.0)
                foot = a + share * (c - a)
                tried = np.array([way[i] + pull * (foot - way[i]) for pull in _PULLS])
                fits = self.clear(np.tile(a, (len(tried), 1)), tried) & self.clear(tried, np.tile(c, (len(tried), 1)))
                if fits.any():
                    way[i] = tried[np.argmax(fits)]
            if before - way_length(way) < 1e-3 * before:
                break
        return way


def way_length(corners: Float[np.ndarray, "m 3"]) -> float:
    """Give the length of a way by its corners, m."""
    return float(np.linalg.norm(np.diff(corners, axis=0), axis=1).sum())
