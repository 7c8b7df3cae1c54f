"""The way to a goal that would be open if what is unknown turned out free: what on it must be seen comes first."""

import math
from dataclasses import dataclass
from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Float, UInt8

from keepout.apps.unknown.cells import SURFACE, Cells
from keepout.apps.unknown.lattice import TENTHS, nodes_near, shortest, walk_back
from keepout.apps.unknown.reachable import Reachable
from keepout.apps.unknown.tried import Tried

_UNKNOWN_PRICE, _GIVEN_UP_PRICE, _SURFACE_PRICE = 3, 12, 40
_STAGES = (1.5, 4.0)
"""Metres of unknown room before a cell on the way, at which it is wanted less."""


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
    """Find the hoped way over the lattice of `reach`; what was given up is dear."""
    price = np.where(reach.room, 1, _UNKNOWN_PRICE).astype(np.uint8)
    scale = cells.edge / reach.spacing
    radius = reach.keep / reach.spacing
    given_up = np.argwhere((tried.failures >= tried.patience) & (cells.kinds > SURFACE))
    _raise_price(price, (given_up + 0.5) * scale, radius, _GIVEN_UP_PRICE)
    _raise_price(price, (np.argwhere(cells.kinds == SURFACE) + 0.5) * scale, radius, _SURFACE_PRICE)
    last = np.array(price.shape) - 1
    place = np.clip((np.asarray(goal) - reach.origin) / reach.spacing, 0, last)
    end = np.round(place).astype(int)
    start = np.clip((np.asarray(position) - reach.origin) / reach.spacing, 0, last)
    sources = nodes_near(price > 0, start, math.sqrt(3.0))
    apart = np.ceil(TENTHS * np.linalg.norm(sources - start, axis=1)).astype(np.int64)
    length = shortest(price, sources, apart, target=end)
    nodes = walk_back(length, price, end)
    blocked = ~reach.room[tuple(nodes.T)]
    stages = np.zeros(cells.kinds.shape, dtype=np.uint8)
    before = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(nodes, axis=0), axis=1) * blocked[1:])])
    stage = 1 + np.searchsorted(_STAGES, before * reach.spacing, side="right")
    tube = (reach.keep + 0.5 * cells.edge) / cells.edge
    # Later stages first, so that a cell keeps the earliest that it blocks.
    for node, one in zip(nodes[blocked][::-1], stage[blocked][::-1], strict=True):
        _mark(cells.kinds, stages, node / scale, tube, one)
    return HopedWay(reach.place(nodes), blocked, stages)


@numba.njit(cache=True)
@no_type_check
def _raise_price(price, centres, radius, value):
    """Give nodes that are not open and lie within `radius` of a centre at least the price `value`."""
    reach = int(np.ceil(radius))
    for c in range(centres.shape[0]):
        a, b, d = round(centres[c, 0]), round(centres[c, 1]), round(centres[c, 2])
        for i in range(max(a - reach, 0), min(a + reach + 1, price.shape[0])):
            for j in range(max(b - reach, 0), min(b + reach + 1, price.shape[1])):
                for k in range(max(d - reach, 0), min(d + reach + 1, price.shape[2])):
                    apart = (i - centres[c, 0]) ** 2 + (j - centres[c, 1]) ** 2 + (k - centres[c, 2]) ** 2
                    if price[i, j, k] > 1 and price[i, j, k] < value and apart <= radius * radius:
                        price[i, j, k] = value


@numba.njit(cache=True)
@no_type_check
def _mark(kinds, stages, centre, radius, stage):
    reach = int(np.ceil(radius))
    a, b, c = int(centre[0]), int(centre[1]), int(centre[2])
    for i in range(max(a - reach, 0), min(a + reach + 1, kinds.shape[0])):
        for j in range(max(b - reach, 0), min(b + reach + 1, kinds.shape[1])):
            for k in range(max(c - reach, 0), min(c + reach + 1, kinds.shape[2])):
                apart = (i + 0.5 - centre[0]) ** 2 + (j + 0.5 - centre[1]) ** 2 + (k + 0.5 - centre[2]) ** 2
                if kinds[i, j, k] > SURFACE and apart <= radius * radius:
                    stages[i, j, k] = stage
