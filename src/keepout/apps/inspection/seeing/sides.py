"""Which side of a face is outside: closed parts of a mesh know, sheets do not."""

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
from jaxtyping import Bool, Float, Int

from keepout.core.geometry.mesh_report import weld


def neighbours(welded: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, "f 3"]:
    """Give the one face on the other side of each edge (corner k to corner k + 1); -1 where there are none or several.

    The other face must run through the edge the other way round: then both have the same side up.
    """
    count = len(welded)
    start, end = welded.reshape(-1), np.roll(welded, -1, axis=1).reshape(-1)
    low, high = np.minimum(start, end), np.maximum(start, end)
    order = np.lexsort((high, low))
    same = (low[order][1:] == low[order][:-1]) & (high[order][1:] == high[order][:-1])
    first = np.flatnonzero(np.concatenate([[True], ~same]))
    alone = np.diff(np.append(first, 3 * count)) == 2
    one, other = order[first[alone]], order[first[alone] + 1]
    opposite = (start[one] == end[other]) & (start[one] != end[one])
    one, other = one[opposite], other[opposite]
    across = np.full(3 * count, -1, dtype=np.int64)
    across[one], across[other] = other // 3, one // 3
    return across.reshape(count, 3)


def closed_parts(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Bool[np.ndarray, " f"], Bool[np.ndarray, " f"]]:
    """Say of each face whether it belongs to a closed part, and whether its normal then points into that part.

    A part is all faces that hang together by edges of two faces with the same side up. It is closed if each of its
    edges has as many of its faces running one way as the other; the sign of its volume says which side is outside.

    Returns:
        (f,) closed, and (f,) inward.

    """
    welded = weld(vertices, faces)
    across = neighbours(welded)
    count = len(faces)
    face = np.repeat(np.arange(count), 3)
    joined = across.reshape(-1) >= 0
    graph = scipy.sparse.coo_matrix(
        (np.ones(int(joined.sum()), dtype=np.int8), (face[joined], across.reshape(-1)[joined])), shape=(count, count)
    )
    parts, part = scipy.sparse.csgraph.connected_components(graph, directed=False)
    start, end = welded.reshape(-1), np.roll(welded, -1, axis=1).reshape(-1)
    # Runs of each edge of each part one way less those the other way.
    low, high, way = np.minimum(start, end), np.maximum(start, end), np.sign(end - start)
    order = np.lexsort((high, low, part[face]))
    keys = np.stack([part[face], low, high])[:, order]
    first = np.flatnonzero(np.concatenate([[True], (keys[:, 1:] != keys[:, :-1]).any(axis=0)]))
    balance = np.add.reduceat(way[order], first)
    closed = np.ones(parts, dtype=bool)
    closed[keys[0, first[balance != 0]]] = False
    a, b, c = np.moveaxis(vertices[faces] - vertices[faces].mean(axis=(0, 1)), 1, 0)
    volume = np.bincount(part, weights=np.einsum("fi,fi->f", a, np.cross(b, c)), minlength=parts)
    area = np.bincount(part, weights=np.linalg.norm(np.cross(b - a, c - a), axis=1), minlength=parts)
    closed &= np.abs(volume) > 1e-9 * area**1.5
    return closed[part], closed[part] & (volume[part] < 0.0)
