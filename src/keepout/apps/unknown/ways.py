"""Ways through known-free room: where the chaser can get to, and the way to a goal that it hopes will open.

All ways lead over a lattice of map nodes. Lengths are whole numbers, so that no order of sums changes one.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8, UInt16

from keepout.apps.unknown.cells import SURFACE, Cells, Tried
from keepout.apps.unknown.known_free import KnownFreeMap
from keepout.core.cores import kernel

FAR = np.iinfo(np.int32).max
"""Length of a way to where none leads."""
_TENTHS = 10.0
_STRAIGHT = (0, 10, 14, 17)
"""Length of a step that changes 1, 2 or 3 indices, in tenths of the lattice spacing."""
_MOST_NODES = 1_500_000
_UNKNOWN_PRICE, _GIVEN_UP_PRICE, _SURFACE_PRICE = 3, 12, 40
_STAGES = (1.5, 4.0)
"""Metres of unknown room before a cell on the way, at which it is wanted less."""


@dataclass(frozen=True, eq=False)
class Reachable:
    """The lattice of every so many map nodes, and the way to each from where the chaser is.

    A node is reachable if a chain of steps leads to it on which every map node, the ones between lattice nodes
    included, is at least `keep` from all that is not known free.
    """

    origin: Float[np.ndarray, "3"]
    """First node, m."""
    spacing: float
    """Between nodes of the lattice, m."""
    keep: float
    """Distance kept, m."""
    room: Bool[np.ndarray, "nx ny nz"]
    """Nodes that keep the distance, reachable or not."""
    tenths: Int[np.ndarray, "nx ny nz"]
    """Length of the way to each node in tenths of the spacing; `FAR` where none is known."""

    @property
    def reached(self) -> Bool[np.ndarray, "nx ny nz"]:
        """Nodes that a way leads to."""
        return self.tenths != FAR

    def place(self, nodes: Int[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Places of nodes, m."""
        return self.origin + self.spacing * np.asarray(nodes)

    def lengths(self, nodes: Int[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Lengths of the ways to nodes, m; infinite where none is known."""
        tenths = self.tenths[tuple(np.asarray(nodes).T)]
        return np.where(tenths == FAR, np.inf, tenths * (self.spacing / _TENTHS))

    def within(self, position: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        """Give a place (m), or the nearest to it in the box."""
        return np.clip(position, self.origin, self.origin + self.spacing * (np.array(self.room.shape) - 1))

    def beside(self, position: Float[np.ndarray, "3"]) -> Int[np.ndarray, "n 3"]:
        """Nodes that keep the distance within a cell's diagonal of a place, or of the nearest place in the box."""
        return _nodes_near(self.room, (self.within(position) - self.origin) / self.spacing)

    def way_length(self, position: Float[np.ndarray, "3"]) -> float:
        """Length of the way to a place, m; infinite where none is known."""
        nodes = self.beside(position)
        apart = np.linalg.norm(self.place(nodes) - np.asarray(position, dtype=float), axis=1)
        return float(np.min(self.lengths(nodes) + apart, initial=math.inf))

    def leads_to(self, known: KnownFreeMap, position: Float[np.ndarray, "3"]) -> bool:
        """Whether a way is known to a place that itself keeps the distance (interpolated between the map's nodes)."""
        return self.way_length(position) < math.inf and distance_at(known, position) >= self.keep


def distance_at(known: KnownFreeMap, position: Float[np.ndarray, "3"]) -> float:
    """Distance to what is not known free, interpolated between the eight nodes around, m; the cap outside the box."""
    place = (np.asarray(position, dtype=float) - known.origin) / known.spacing
    if np.any(place < 0.0) or np.any(place > np.array(known.squares.shape) - 1):
        return known.cap
    corner = np.minimum(np.floor(place).astype(int), np.array(known.squares.shape) - 2)
    part = place - corner
    values = known.spacing * np.sqrt(known.squares[tuple(slice(c, c + 2) for c in corner)].astype(float))
    for share in part:
        values = (1.0 - share) * values[0] + share * values[1]
    return float(values)


def reachable(
    known: KnownFreeMap, position: Float[np.ndarray, "3"], keep: float, *, stride: int | None = None
) -> Reachable:
    """Find the ways from `position` through room that keeps `keep` (m) from all that is not known free.

    Args:
        known: the map.
        position: of the chaser's centre, m. Outside the map's box all is free, and the way begins at the box.
        keep: metres; more than 0.
        stride: map nodes between nodes of the lattice; by default the least that keeps it below 1.5 million nodes.

    """
    shape = np.array(known.squares.shape)
    if stride is None:
        stride = 1
        while np.prod((shape - 1) // stride + 1) > _MOST_NODES:
            stride += 1
    least = math.ceil((keep / known.spacing) ** 2 - 1e-9)
    room = known.squares[::stride, ::stride, ::stride] >= least
    lengths = np.full(room.shape, FAR, dtype=np.int32)
    found = Reachable(known.origin, known.spacing * stride, keep, room, lengths)
    begin = np.asarray(position, dtype=float)
    sources = found.beside(begin)
    apart = np.linalg.norm(found.place(sources) - found.within(begin), axis=1) / found.spacing
    lengths[tuple(sources.T)] = np.ceil(_TENTHS * apart)
    shorten(lengths, room.astype(np.uint8), known.squares, stride, least)
    return found


def _nodes_near(room: Bool[np.ndarray, "nx ny nz"], place: Float[np.ndarray, "3"]) -> Int[np.ndarray, "m 3"]:
    """Give the open nodes at most a cell's diagonal from `place`, in lattice spacings from the lattice's corner."""
    reach = math.sqrt(3.0)
    low = np.maximum(np.floor(place - reach).astype(int), 0)
    high = np.minimum(np.ceil(place + reach).astype(int) + 1, room.shape)
    found = np.argwhere(room[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]) + low
    return found[np.linalg.norm(found - place, axis=1) <= reach]


def shorten(
    lengths: Int[np.ndarray, "nx ny nz"],
    price: UInt8[np.ndarray, "nx ny nz"],
    squares: UInt16[np.ndarray, "mx my mz"],
    stride: int = 1,
    least: int = 0,
) -> None:
    """Make each node's length, in place, that of the shortest way from the nodes at which ways begin.

    A step leads to any of the 26 neighbours and costs its length, in tenths of the spacing, times the price of the node
    that it leads to. Where the lattice leaves map nodes out, a step is open only if every map node on it keeps its
    distance. The lattice is gone through forwards and backwards, past nodes none of whose neighbours has changed, until
    nothing changes: then every length is the least over all ways, and no other method gives another.

    Args:
        lengths: of the ways that begin at nodes, and `FAR` elsewhere.
        price: of each node; 0 closes it.
        squares: a map's squared node distances, in cells.
        stride: map nodes between neighbours of the lattice.
        least: squared distance, in cells, that a step keeps.

    """
    awake = np.ones(lengths.shape, dtype=np.bool_)
    way = lengths, awake, price, squares, stride, least
    while _swept(*way, False) | _swept(*way, True):
        pass


@kernel()
def _swept(lengths, awake, price, squares, stride, least, backwards):
    """Lower each awake node's length to the least over its neighbours', waking them; give whether any was lowered."""
    nx, ny, nz = price.shape
    lowered = False
    for step_i in range(nx):
        for step_j in range(ny):
            for step_k in range(nz):
                i, j, k = step_i, step_j, step_k
                if backwards:
                    i, j, k = nx - 1 - i, ny - 1 - j, nz - 1 - k
                if price[i, j, k] == 0 or not awake[i, j, k]:
                    continue
                awake[i, j, k] = False
                best = np.int64(lengths[i, j, k])
                for a in range(max(i - 1, 0), min(i + 2, nx)):
                    for b in range(max(j - 1, 0), min(j + 2, ny)):
                        for c in range(max(k - 1, 0), min(k + 2, nz)):
                            straight = _STRAIGHT[abs(a - i) + abs(b - j) + abs(c - k)]
                            through = lengths[a, b, c] + straight * price[i, j, k]
                            if through < best and _open(squares, (i, j, k), (a - i, b - j, c - k), stride, least):
                                best = through
                if best < lengths[i, j, k]:
                    lengths[i, j, k] = best
                    awake[max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2, max(k - 1, 0) : k + 2] = True
                    lowered = True
    return lowered


@kernel()
def _open(squares, node, step, stride, least):
    """Whether every map node between two neighbours of the lattice keeps its distance."""
    i, j, k = node
    for part in range(1, stride):
        if squares[i * stride + part * step[0], j * stride + part * step[1], k * stride + part * step[2]] < least:
            return False
    return True


def walk_back(
    lengths: Int[np.ndarray, "nx ny nz"], price: UInt8[np.ndarray, "nx ny nz"], end: Int[np.ndarray, "3"]
) -> Int[np.ndarray, "m 3"]:
    """Nodes of the shortest way that `shorten` found to `end`, first to last; empty where none leads."""
    node = np.asarray(end)
    if lengths[tuple(node)] == FAR:
        return np.zeros((0, 3), dtype=np.int64)
    way = [node]
    steps = np.argwhere(np.ones((3, 3, 3))) - 1
    costs = np.array(_STRAIGHT)[np.abs(steps).sum(axis=1)]
    while True:
        inside = np.all((node + steps >= 0) & (node + steps < lengths.shape), axis=1) & (costs > 0)
        before = lengths[tuple((node + steps[inside]).T)].astype(np.int64)
        leads = before + costs[inside] * int(price[tuple(node)]) == lengths[tuple(node)]
        if not leads.any():
            return np.array(way[::-1], dtype=np.int64)
        node = node + steps[inside][np.argmin(np.where(leads, before, FAR))]
        way.append(node)


@dataclass(frozen=True, eq=False)
class HopedWay:
    """The cheapest way to a goal, unknown room being dearer than free room, and the seen surface dearest."""

    places: Float[np.ndarray, "m 3"]
    """From the chaser to the goal, m."""
    blocked: np.ndarray
    """(m,) Whether the chaser may not be there yet."""
    stages: UInt8[np.ndarray, "nx ny nz"]
    """For every cell that blocks it 1, 2 or 3, by how much unknown room comes before; 0 elsewhere."""


def hoped_way(
    reach: Reachable,
    cells: Cells,
    tried: Tried,
    position: Float[np.ndarray, "3"],
    goal: Float[np.ndarray, "3"],
) -> HopedWay:
    """Find the way to a goal that would be open if what is unknown turned out free; what was given up is dear.

    It leads over the lattice of `reach`. What on it must be seen comes first.
    """
    price = np.where(reach.room, 1, _UNKNOWN_PRICE).astype(np.uint8)
    scale = cells.edge / reach.spacing
    for closed, dear in (
        ((tried.failures >= tried.patience) & (cells.kinds > SURFACE), _GIVEN_UP_PRICE),
        (cells.kinds == SURFACE, _SURFACE_PRICE),
    ):
        centres = (np.argwhere(closed) + 0.5) * scale
        paints = np.full(len(centres), dear, dtype=np.uint8)
        _paint(price, (price > 1) & (price < dear), centres, reach.keep / reach.spacing, paints)
    last = np.array(price.shape) - 1
    end = np.round(np.clip((np.asarray(goal) - reach.origin) / reach.spacing, 0, last)).astype(int)
    start = np.clip((np.asarray(position) - reach.origin) / reach.spacing, 0, last)
    sources = _nodes_near(price > 0, start)
    lengths = np.full(price.shape, FAR, dtype=np.int32)
    lengths[tuple(sources.T)] = np.ceil(_TENTHS * np.linalg.norm(sources - start, axis=1))
    shorten(lengths, price, np.zeros((1, 1, 1), dtype=np.uint16))
    nodes = walk_back(lengths, price, end)
    blocked = ~reach.room[tuple(nodes.T)]
    stages = np.zeros(cells.kinds.shape, dtype=np.uint8)
    before = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(nodes, axis=0), axis=1) * blocked[1:])])
    stage = (1 + np.searchsorted(_STAGES, before * reach.spacing, side="right")).astype(np.uint8)
    tube = (reach.keep + 0.5 * cells.edge) / cells.edge
    # Later stages first, so that a cell keeps the earliest that it blocks.
    _paint(stages, cells.kinds > SURFACE, nodes[blocked][::-1] / scale - 0.5, tube, stage[blocked][::-1])
    return HopedWay(reach.place(nodes), blocked, stages)


@kernel()
def _paint(values, allowed, centres, radius, paints):
    """Give what lies within `radius` of each centre that centre's paint, one after another, where it is allowed."""
    reach = int(np.ceil(radius))
    for c in range(centres.shape[0]):
        x, y, z = round(centres[c, 0]), round(centres[c, 1]), round(centres[c, 2])
        for i in range(max(x - reach, 0), min(x + reach + 1, values.shape[0])):
            for j in range(max(y - reach, 0), min(y + reach + 1, values.shape[1])):
                for k in range(max(z - reach, 0), min(z + reach + 1, values.shape[2])):
                    apart = (i - centres[c, 0]) ** 2 + (j - centres[c, 1]) ** 2 + (k - centres[c, 2]) ** 2
                    if allowed[i, j, k] and apart <= radius * radius:
                        values[i, j, k] = paints[c]
