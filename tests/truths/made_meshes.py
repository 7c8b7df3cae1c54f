"""Small meshes from their numbers."""

import numpy as np

from keepout.apps.inspection.seeing.patches import Patches
from keepout.core.geometry.mesh_files.contents import MeshContents
from keepout.core.geometry.target import Target, describe


def target_of(vertices, faces, name="made"):
    surface = MeshContents(np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int64))
    return Target(name, surface.vertices, surface.faces, describe(surface))


def joined(*parts):
    """One mesh of several (vertices, faces)."""
    vertices, faces, start = [], [], 0
    for some, triangles in parts:
        vertices.append(some)
        faces.append(np.asarray(triangles) + start)
        start += len(some)
    return np.concatenate(vertices), np.concatenate(faces)


def plate(lower, upper, height):
    """Two triangles over a rectangle at a height."""
    (x0, y0), (x1, y1) = lower, upper
    corners = np.array([[x0, y0, height], [x1, y0, height], [x1, y1, height], [x0, y1, height]])
    return corners, np.array([[0, 1, 2], [0, 2, 3]])


def patch_of(corners, size=16.0):
    """The patch that a convex plane polygon is; both its sides count."""
    corners = np.asarray(corners, dtype=np.float64)
    spokes = corners[1:] - corners[0]
    twice = np.cross(spokes[:-1], spokes[1:]).sum(axis=0)
    area, counted = 0.5 * np.linalg.norm(twice), np.array([True, True])
    normal, middle = twice / (2.0 * area), corners.mean(axis=0)
    return Patches(
        *(corners[None], np.array([len(corners)]), normal[None], np.array([area]), middle[None], np.array([0])),
        *(counted, size),
    )
