"""The skin of a map: the surface between cubes that are not known free and free room that is reached from outside."""

from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float, Int64

from keepout.apps.unknown.mapping.known_free import KnownFreeMap


@no_type_check
@numba.njit(cache=True, nogil=True)
def _sweep(free, reached, step):
    """Hand `reached` on to free neighbours that follow (step 1) or precede (step -1) on each axis."""
    n = free.shape[0]
    grown = 0
    first = 0 if step > 0 else n - 1
    for count_i in range(n):
        i = first + step * count_i
        for count_j in range(n):
            j = first + step * count_j
            for count_k in range(n):
                k = first + step * count_k
                if (
                    free[i, j, k]
                    and not reached[i, j, k]
                    and (
                        (i != first and reached[i - step, j, k])
                        or (j != first and reached[i, j - step, k])
                        or (k != first and reached[i, j, k - step])
                    )
                ):
                    reached[i, j, k] = True
                    grown += 1
    return grown


def reachable_cubes(free: Bool[np.ndarray, "n n n"]) -> Bool[np.ndarray, "n n n"]:
    """Give the free cubes that a path through faces of free cubes joins to the box's border."""
    reached = np.zeros_like(free)
    for axis in range(3):
        for side in (0, -1):
            where = tuple(side if other == axis else slice(None) for other in range(3))
            reached[where] = free[where]
    # The border counts as growth, so that both directions are swept at least once.
    grown = 1
    while grown:
        grown = _sweep(free, reached, 1) + _sweep(free, reached, -1)
    return reached


def skin(known: KnownFreeMap) -> tuple[Float[np.ndarray, "v 3"], Int64[np.ndarray, "f 3"]]:
    """Give the closed triangle mesh of the map's obstacle, as seen from outside; see `skin_of`."""
    return skin_of(known.free, known.origin, known.spacing)


def skin_of(
    free: Bool[np.ndarray, "n n n"], origin: Float[np.ndarray, "3"], spacing: float
) -> tuple[Float[np.ndarray, "v 3"], Int64[np.ndarray, "f 3"]]:
    """Give the closed triangle mesh of the obstacle among cubes of edge `spacing` (m) from corner `origin` (m) on.

    The obstacle is every cube that is not free, and free room that is shut in by such cubes. Each square between the
    obstacle and free room is two triangles that face the free room. Squares share vertices, and the surface is the
    boundary of a solid: every edge has an even number of triangles, two nearly everywhere, four where two cubes
    touch along an edge alone.

    Returns:
        Vertices in the map's frame, m, and vertex indices of the triangles.

    """
    solid = ~reachable_cubes(free)
    nodes = len(solid) + 1
    strides = (nodes * nodes, nodes, 1)
    quads = []
    for axis in range(3):
        low = tuple(slice(None, -1) if other == axis else slice(None) for other in range(3))
        high = tuple(slice(1, None) if other == axis else slice(None) for other in range(3))
        one, two = strides[(axis + 1) % 3], strides[(axis + 2) % 3]
        for inner, outer, corners in (
            (low, high, (0, one, one + two, two)),  # faces the axis
            (high, low, (0, two, one + two, one)),
        ):
            # The square's own node is the lower corner of the upper of the two cubes.
            i, j, k = np.nonzero(solid[inner] & ~solid[outer])
            corner = i * strides[0] + j * strides[1] + k * strides[2] + strides[axis]
            quads.append(corner[:, None] + np.array(corners))
    square = np.concatenate(quads)
    used, index = np.unique(square, return_inverse=True)
    index = index.reshape(-1, 4)
    faces = np.concatenate([index[:, [0, 1, 2]], index[:, [0, 2, 3]]]).astype(np.int64)
    places = np.stack([used // strides[0], used // strides[1] % nodes, used % nodes], axis=1)
    return origin + spacing * places, faces
