"""Where the chaser can get to in known-free room, and how long it takes."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from keepout.apps.unknown.known_free import KnownFreeMap
from keepout.apps.unknown.lattice import FAR, TENTHS, nodes_near, shortest

_MOST_NODES = 1_500_000


@dataclass(frozen=True, eq=False)
class Reachable:
    """The lattice of every `stride`-th map node, and the way to each from where the chaser is.

    A node is reachable if a chain of steps leads to it on which every map node, the ones between lattice nodes
    included, is at least `keep` from all that is not known free.
    """

    origin: Float[np.ndarray, "3"]
    """First node, m."""
    spacing: float
    """Between nodes of the lattice, m."""
    stride: int
    """Map nodes from one node of the lattice to the next."""
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
        return np.where(tenths == FAR, np.inf, tenths * (self.spacing / TENTHS))

    def beside(self, position: Float[np.ndarray, "3"]) -> Int[np.ndarray, "n 3"]:
        """Nodes that keep the distance within a cell's diagonal of a place, or of the nearest place in the box."""
        return nodes_near(self.room, (self._inside(position) - self.origin) / self.spacing, math.sqrt(3.0))

    def way_length(self, position: Float[np.ndarray, "3"]) -> float:
        """Length of the way to a place, m; infinite where none is known."""
        nodes = self.beside(position)
        if len(nodes) == 0:
            return math.inf
        apart = np.linalg.norm(self.place(nodes) - np.asarray(position, dtype=float), axis=1)
        return float(np.min(self.lengths(nodes) + apart))

    def leads_to(self, known: KnownFreeMap, position: Float[np.ndarray, "3"]) -> bool:
        """Whether a way is known to a place that itself keeps the distance (interpolated between the map's nodes)."""
        return self.way_length(position) < math.inf and distance_at(known, position) >= self.keep

    def _inside(self, position: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        return np.clip(position, self.origin, self.origin + self.spacing * (np.array(self.room.shape) - 1))


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
    empty = Reachable(
        known.origin, known.spacing * stride, stride, keep, room, np.full(room.shape, FAR, dtype=np.int32)
    )
    sources = empty.beside(np.asarray(position, dtype=float))
    inside = empty._inside(np.asarray(position, dtype=float))
    apart = np.linalg.norm(empty.place(sources) - inside, axis=1) / empty.spacing
    tenths = shortest(
        room.astype(np.uint8),
        sources,
        np.ceil(TENTHS * apart).astype(np.int64),
        squares=known.squares,
        stride=stride,
        least=least,
    )
    return Reachable(known.origin, empty.spacing, stride, keep, room, tenths)
