"""The grid that geodesic guidance marches over, made directly from the node distances of a map.

`BarrierGrid.build` samples a field point by point, for seconds. A map knows its distance at every node already, so that
a grid over every few nodes, with exact values, is there in a fraction of a second, anew for every later map.
"""

import math
from collections.abc import Sequence
from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Float, UInt16

from keepout.core.control.guidance.geodesic import BarrierGrid, outwards

MOST_NODES = 1_600_000
"""By default a grid takes every few nodes of the map, so that it has no more than these: a second's march at most."""


def grid_of_nodes(
    squares: UInt16[np.ndarray, "nx ny nz"],
    origin: Sequence[float] | Float[np.ndarray, "3"],
    spacing: float,
    offset: float,
    *,
    room: float = 3.0,
    every: int | None = None,
) -> BarrierGrid:
    """Give h = f − offset, f the cubic spline of a map's node distances, at every few nodes of the map.

    An edge is a wall where h is not positive at a node of the map on it. The grid's shape depends on no distance, so
    guidances by one map at several times have one shape.

    Args:
        squares: at the map's nodes, the squared distance in cells to what is not known free; at the cap near the faces.
        origin: of node (0, 0, 0), m.
        spacing: between the map's nodes, m.
        offset: of the barrier, m.
        room: by how much the grid reaches beyond the map's box on every side, m; the distance is at the cap there.
        every: how many of the map's nodes lie from one of the grid to the next; by default the fewest that
            `MOST_NODES` allow.

    """
    beyond = math.ceil(max(room, 0.0) / spacing)
    extent = np.array(squares.shape) - 1 + 2 * beyond
    if every is None:
        every = 1
        while np.prod(-(-extent // every) + 1) > MOST_NODES:
            every += 1
    shape = np.maximum(-(-extent // every) + 1, 5)
    # What is too much is shared between both sides.
    first = -beyond - (every * (shape - 1) - extent) // 2
    values = np.empty(tuple(shape))
    walls = np.zeros((3, *shape), dtype=bool)
    _sample(squares, first, every, float(spacing), float(offset), values, walls)
    return BarrierGrid(values, walls, outwards(values), np.asarray(origin) + spacing * first, every * spacing)


@numba.njit(cache=True)
@no_type_check
def _spline(squares, roots, x, y, z):
    """Evaluate the spline at a node, in cells: means with weights 1/6, 4/6, 1/6 along each axis."""
    nx, ny, nz = squares.shape
    if x < 1 or y < 1 or z < 1 or x >= nx - 1 or y >= ny - 1 or z >= nz - 1:
        return roots[squares[0, 0, 0]]
    total = 0.0
    for i in range(-1, 2):
        for j in range(-1, 2):
            line = roots[squares[x + i, y + j, z - 1]] + roots[squares[x + i, y + j, z + 1]]
            line += 4.0 * roots[squares[x + i, y + j, z]]
            total += line * ((4.0 if i == 0 else 1.0) * (4.0 if j == 0 else 1.0))
    return total / 216.0


@numba.njit(cache=True)
@no_type_check
def _sample(squares, first, every, spacing, offset, values, walls):
    most = squares[0, 0, 0]
    roots = np.sqrt(np.arange(most + 1))
    nx, ny, nz = values.shape
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                x, y, z = first[0] + every * i, first[1] + every * j, first[2] + every * k
                here = spacing * _spline(squares, roots, x, y, z) - offset
                values[i, j, k] = here
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                here = values[i, j, k]
                if here <= 0.0:
                    continue
                for axis in range(3):
                    a, b, c = i + (axis == 0), j + (axis == 1), k + (axis == 2)
                    # The spline's slope is below 1.2 (`SLOPE`): from there on no node between can be in the obstacle.
                    if a >= nx or b >= ny or c >= nz or values[a, b, c] <= 0.0:
                        continue
                    if here + values[a, b, c] >= 1.2 * every * spacing:
                        continue
                    for step in range(1, every):
                        x = first[0] + every * i + step * (axis == 0)
                        y = first[1] + every * j + step * (axis == 1)
                        z = first[2] + every * k + step * (axis == 2)
                        if spacing * _spline(squares, roots, x, y, z) <= offset:
                            walls[axis, i, j, k] = True
                            break
