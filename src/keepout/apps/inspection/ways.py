"""Ways between places that keep the stand-off: their lengths on a grid of exact distances, and their courses.

The distance d to the mesh, and to zones, is 1-Lipschitz: on a straight piece of half length h about its middle m it is
nowhere below d(m) − h. A piece is *clear* where bisection proves d ≥ stand-off on all of it by that; nothing is
sampled.
"""

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse.csgraph import shortest_path

from keepout.apps.inspection.seeing.room import Measure
from keepout.core.control.barrier_grid import travel_time
from keepout.core.cores import available_cores
from keepout.core.geometry.distance import Point, Points

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
_AROUND = 3.0
"""Metres beyond places to which the ways between them are looked for first."""
_NEIGHBOURS = 20
"""Places to which ways are marched from a place; farther ones are reached by way of these."""


Node = tuple[int, ...]
Corner = Int[np.ndarray, "3"]
Joined = tuple[Int[np.ndarray, "_ 3"], Float[np.ndarray, " _"]]
"""Nodes joined to a place, and their distances from it, m."""
Pairs = dict[tuple[bytes, bytes], tuple[float, np.ndarray]]
"""Length of the way from one place to another, m, and the unit vector in which it sets out."""


@dataclass(frozen=True, eq=False)
class Ways:
    """Ways in {d ≥ stand-off}; make one with `Ways.build`.

    Attributes:
        distance: to the mesh, and to what else ways keep the stand-off from.
        stand_off: that a way keeps, m.
        origin: of node (0, 0, 0), m.
        spacing: of the nodes, m.
        open: nodes with d ≥ stand-off.
        walls: walls[a, i, j, k] closes the edge from node (i, j, k) to the next along axis a: it is not proved clear.

    """

    distance: Measure
    stand_off: float
    origin: Point
    spacing: float
    open: Bool[np.ndarray, "nx ny nz"]
    walls: Bool[np.ndarray, "3 nx ny nz"]

    @classmethod
    def build(
        cls, distance: Measure, stand_off: float, lower: Point, upper: Point, *, most_nodes: int = MOST_NODES
    ) -> "Ways":
        """Lay the grid over a box (m) and find what is open.

        Args:
            distance: to the mesh, and to what else ways keep the stand-off from.
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

    def clear(self, begins: Points, ends: Points) -> Bool[np.ndarray, " n"]:
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

    def lengths(
        self, places: Points, known: Pairs | None = None
    ) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "n n 3"]]:
        """Give the lengths (m) of the ways between all places, infinite where none leads, and how they set out.

        A straight way that is clear has its own length; another has that of the grid, which is a few per cent more
        than the shortest has. Both are looked for between neighbours; to a place farther off the way leads from
        neighbour to neighbour.

        Args:
            places: m.
            known: ways between neighbours found before, and added to.

        Returns:
            (k, k) lengths, and (k, k, 3) the unit vector in which the way from the first to the second leaves.

        """
        count = len(places)
        apart = places[None] - places[:, None]
        away: Float[np.ndarray, "k k"] = np.sqrt(np.sum(apart * apart, axis=2))
        leave = apart / np.maximum(away, 1e-12)[..., None]
        direct = np.full((count, count), np.inf)
        joined = [self._joined(place) for place in places]
        reach = np.sort(away, axis=1)[:, min(_NEIGHBOURS, count - 1)]
        fresh = away <= np.maximum(reach, reach[:, None])
        known = {} if known is None else known
        names = [place.tobytes() for place in places]
        while True:
            pairs = [(i, j) for i, j in np.argwhere(fresh & ~np.eye(count, dtype=bool)).tolist()]
            for i, j in pairs:
                if (names[i], names[j]) in known:
                    direct[i, j], leave[i, j] = known[names[i], names[j]]
            fresh &= np.isinf(direct)
            self._join(places, joined, fresh, direct, leave)
            known.update(((names[i], names[j]), (direct[i, j], leave[i, j].copy())) for i, j in pairs)
            # A matrix entry of 0 would be no edge.
            edges = np.where(np.isfinite(direct), np.maximum(direct, 1e-12), 0.0)
            length, before = shortest_path(edges, directed=False, return_predecessors=True)
            # Neighbours of what is shut off from the rest lie farther off, if there are any.
            shut = np.isinf(length).any(axis=1) & (reach < away.max(axis=1))
            if not shut.any():
                break
            reach[shut] *= 2.0
            fresh = (away <= np.maximum(reach, reach[:, None])) & np.isinf(length)
        # The last stop before i on the way there from j is the first on the way back.
        stop = np.where(before.T >= 0, before.T, np.arange(count))
        return length, leave[np.arange(count)[:, None], stop]

    def _join(
        self,
        places: Float[np.ndarray, "k 3"],
        joined: list[Joined],
        fresh: Bool[np.ndarray, "k k"],
        direct: Float[np.ndarray, "k k"],
        leave: Float[np.ndarray, "k k 3"],
    ) -> None:
        """Write the lengths of ways between those pairs that are `fresh`, a symmetric matrix, and how they set out."""
        first, second = np.nonzero(np.triu(fresh, 1))
        clear = self.clear(places[first], places[second])
        apart = np.linalg.norm(places[second] - places[first], axis=1)
        direct[first[clear], second[clear]] = direct[second[clear], first[clear]] = apart[clear]
        crooked = np.zeros_like(fresh)
        crooked[first[~clear], second[~clear]] = crooked[second[~clear], first[~clear]] = True

        def march_from(j: int) -> None:
            ends = [i for i in np.flatnonzero(crooked[:, j]).tolist() if len(joined[i][0])]
            if not ends:
                return
            low, high = self._box(places[[j, *ends]], _AROUND)
            times = self._march(joined[j], low, high)
            for i in ends:
                nodes, away = joined[i]
                through = times[tuple((nodes - low).T)] + away
                best = int(np.argmin(through))
                if through[best] < np.inf:
                    direct[i, j] = max(through[best], float(np.linalg.norm(places[j] - places[i])))
                    course = self.origin + self.spacing * nodes[best] - places[i]
                    leave[i, j] = course / max(float(np.linalg.norm(course)), 1e-12)

        with ThreadPoolExecutor(available_cores()) as pool:
            list(pool.map(march_from, np.flatnonzero(crooked.any(axis=0)).tolist()))
        np.minimum(direct, direct.T, out=direct)

    def reached(self, begin: Point, places: Points) -> Bool[np.ndarray, " n"]:
        """Say to which places a way leads from one, by the grid or straight."""
        times = self._march(self._joined(begin))
        joined = [self._joined(place)[0] for place in places]
        found = np.array([bool(np.isfinite(times[tuple(nodes.T)]).any()) for nodes in joined], dtype=bool)
        alone = np.flatnonzero(~found)
        found[alone] = self.clear(np.tile(begin, (len(alone), 1)), places[alone])
        return found

    def nearly(self, place: Point, places: Points) -> Float[np.ndarray, " n"]:
        """Give the lengths (m) of ways from one place to many, to within about a cell; infinite where none leads."""
        times = self._march(self._joined(place))
        at = (places - self.origin) / self.spacing
        base = np.clip(np.floor(at).astype(int), 0, np.array(self.open.shape) - 2)
        found = np.full(len(places), np.inf)
        for corner in np.ndindex(2, 2, 2):
            node = base + corner
            through = times[tuple(node.T)] + self.spacing * np.linalg.norm(node - at, axis=1)
            found = np.minimum(found, through)
        return np.maximum(found, np.where(np.isfinite(found), np.linalg.norm(places - place, axis=1), 0.0))

    def path(self, begin: Point, end: Point) -> Points | None:
        """Give the corners of a way, every piece of it clear; None where none leads.

        From a place nearer than the stand-off, the first piece leads straight to a node of the grid and is not clear.
        """
        begin, end = np.asarray(begin, dtype=np.float64), np.asarray(end, dtype=np.float64)
        if self.clear(begin[None], end[None])[0]:
            return np.stack([begin, end])
        (nodes, away), (last, beyond) = self._joined(begin), self._joined(end)
        apart, around = float(np.linalg.norm(end - begin)), _AROUND
        while True:
            low, high = self._box(np.stack([begin, end]), around)
            times = self._march((last, beyond), low, high)
            through = times[tuple((nodes - low).T)] + away
            length = float(through.min()) if len(nodes) else np.inf
            # No way of that length leaves a box so much larger than the two places.
            needed = 0.5 * (length - apart) if length < np.inf else 2.0 * around
            if needed <= around or bool(np.all(low == 0) and np.all(high == self.open.shape)):
                break
            around = needed
        if not length < np.inf:
            return None
        walls = self.walls[(slice(None), *(slice(a, b) for a, b in zip(low, high, strict=True)))]
        node = tuple((nodes[int(np.argmin(through))] - low).tolist())
        corners = [begin, self._place(node, low)]
        near = {tuple(n) for n in (last - low).tolist()}
        while node not in near:
            node = _downhill(times, walls, node)
            corners.append(self._place(node, low))
        return self._pulled(np.array([*corners, end]))

    def _place(self, node: Node, low: Corner) -> Point:
        return self.origin + self.spacing * (low + np.asarray(node))

    def _box(self, places: Points, around: float) -> tuple[Corner, Corner]:
        """Give the first nodes of a box that holds places and all within `around` (m) and their nodes; and the ends."""
        room = around + (_NEAR + 2.0) * self.spacing + self.stand_off
        low = np.floor((places.min(axis=0) - room - self.origin) / self.spacing).astype(int)
        high = np.ceil((places.max(axis=0) + room - self.origin) / self.spacing).astype(int) + 1
        return np.clip(low, 0, self.open.shape), np.clip(high, 0, self.open.shape)

    def _march(
        self, joined: Joined, low: Corner | None = None, high: Corner | None = None
    ) -> Float[np.ndarray, "nx ny nz"]:
        """March the distance from nodes over the grid, or over a box of it whose first node is then `low`."""
        nodes, away = joined
        low = np.zeros(3, dtype=int) if low is None else low
        within = tuple(slice(a, b) for a, b in zip(low, self.open.shape if high is None else high, strict=True))
        if len(nodes) == 0:
            return np.full(self.open[within].shape, np.inf)
        return travel_time(
            self.open[within].astype(float), self.walls[(slice(None), *within)], nodes - low, away, self.spacing
        )

    def _joined(self, place: Point) -> Joined:
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

    def _pulled(self, corners: Points) -> Float[np.ndarray, "m 3"]:
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


def _downhill(times: Float[np.ndarray, "nx ny nz"], walls: Bool[np.ndarray, "3 nx ny nz"], node: Node) -> Node:
    best, least = node, times[node]
    for axis in range(3):
        for sign in (-1, 1):
            beside = tuple(n + sign * (a == axis) for a, n in enumerate(node))
            if not all(0 <= n < m for n, m in zip(beside, times.shape, strict=True)):
                continue
            edge = beside if sign < 0 else node
            if not walls[(axis, *edge)] and times[beside] < least:
                best, least = beside, times[beside]
    if best == node:
        raise AssertionError(f"no way down from node {node}")
    return best


def way_length(corners: Points) -> float:
    """Give the length of a way by its corners, m."""
    return float(np.linalg.norm(np.diff(corners, axis=0), axis=1).sum())
