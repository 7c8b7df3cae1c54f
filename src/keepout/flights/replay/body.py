"""The target's mesh as it is drawn: not too many triangles, and how open to the sky each of them is."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from keepout.core.geometry.target import Target

MOST_TRIANGLES = 40_000
"""A browser without a graphics card still turns a mesh of so many several times a second."""
_REACHES = (0.01, 0.04)
"""Shares of the target's size over which a triangle looks for what shades it."""
_COARSER = 1.25


@dataclass(frozen=True, eq=False)
class DrawnBody:
    """A target as it is drawn, metres.

    Attributes:
        vertices: of the triangles, or the middles of a point cloud's balls.
        faces: the triangles; none of a point cloud.
        openness: 0 to 1 for each triangle.
        triangles: how many the mesh has.
        remark: what the drawing leaves out of the target, as a sentence; empty where it is drawn whole.

    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    openness: Float[np.ndarray, "f"]
    triangles: int
    remark: str


def drawn_body(target: Target) -> DrawnBody:
    """Give a target's mesh as it is drawn; a mesh of very many triangles is drawn with fewer."""
    used, faces = np.unique(target.faces, return_inverse=True)
    vertices, faces = target.vertices[used], faces.reshape(-1, 3)
    if target.ball_radius == 0.0:
        side = float(np.ptp(vertices, axis=0).max()) / 1000.0
        vertices, faces = fewer(vertices, faces, MOST_TRIANGLES, side=side)
        remark = _remark(len(faces), len(target.faces), "triangles")
    else:
        chosen = np.linspace(0, len(vertices) - 1, min(len(vertices), MOST_TRIANGLES)).astype(int)
        vertices, faces = vertices[chosen], np.empty((0, 3), int)
        remark = _remark(len(vertices), len(used), "points")
    return DrawnBody(vertices, faces, _openness(target, vertices, faces), len(target.faces), remark)


def _remark(drawn: int, whole: int, kind: str) -> str:
    if drawn == whole:
        return ""
    return f"The target is drawn with {drawn:,} of its {whole:,} {kind}; distances are to all of it."


def fewer(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], most: int, *, side: float
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "g 3"]]:
    """Move vertices of one cell of a grid to their mean, the grid coarser until few enough triangles are left.

    Args:
        vertices: m.
        faces: of a mesh; one that has no more than `most` is given back as it is.
        most: triangles that may be left.
        side: of the first grid's cells, m.

    """
    return fewer_of(vertices, faces, most, side=side)[:2]


def fewer_of(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], most: int, *, side: float
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "g 3"], Int[np.ndarray, " f"]]:
    """Do as `fewer` does, and say which of the faces left each face became, -1: none; the arguments are those."""
    whole, became = (vertices, faces), np.arange(len(faces))
    while len(faces) > most:
        _, place, count = np.unique(
            np.floor(whole[0] / side).astype(np.int64), axis=0, return_inverse=True, return_counts=True
        )
        vertices = np.zeros((len(count), 3))
        np.add.at(vertices, place.reshape(-1), whole[0])
        vertices /= count[:, None]
        faces = place.reshape(-1)[whole[1]]
        kept = np.flatnonzero(
            (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
        )
        _, once, same = np.unique(np.sort(faces[kept], axis=1), axis=0, return_index=True, return_inverse=True)
        order = np.argsort(once)
        became = np.full(len(whole[1]), -1)
        became[kept] = np.argsort(order)[same.reshape(-1)]
        faces = faces[kept[once[order]]]
        side *= _COARSER
    return vertices, faces, became


def _openness(target: Target, vertices: np.ndarray, faces: np.ndarray) -> Float[np.ndarray, "f"]:
    """Say how far what stands opposite is from each triangle, on its freer side: 1 in the open, to 0 in a corner."""
    if len(faces) == 0:
        return np.ones(0)
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    middle = corners.mean(axis=1)
    size = float(np.ptp(target.vertices, axis=0).max())
    openness = np.ones(len(faces))
    for reach in _REACHES:
        sides = [
            target.distance.distance(middle + sign * reach * size * normal) / (reach * size) for sign in (1.0, -1.0)
        ]
        openness *= np.clip(np.maximum(*sides), 0.0, 1.0)
    return openness
