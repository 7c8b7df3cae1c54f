"""Meshes of boxes, and under which solid angle a point sees a mesh."""

import numpy as np
import trimesh


def boxes_mesh(boxes):
    parts = [
        trimesh.creation.box(
            extents=np.subtract(b, a), transform=trimesh.transformations.translation_matrix(np.add(a, b) / 2)
        )
        for a, b in boxes
    ]
    mesh = trimesh.util.concatenate(parts)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def solid_angle(target, points):
    """Solid angle under which each point sees a mesh: 4π inside one that is closed and oriented, 0 outside."""
    total = np.zeros(len(points))
    for number, point in enumerate(points):
        a, b, c = np.moveaxis(target.vertices[target.faces] - point, 1, 0)
        la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
        top = (a * np.cross(b, c)).sum(1)
        bottom = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
        total[number] = 2.0 * np.arctan2(top, bottom).sum()
    return total


def hollow_box(half_hole):
    """A sheet box of half side 1.5 m with a square hole in its top, as loose triangles."""
    half = 1.5
    vertices, faces = boxes_mesh([((-half, -half, -half), (half, half, half))])
    top = (vertices[faces][:, :, 2] == half).all(axis=1)
    faces = faces[~top]
    outer = np.array([(-half, -half), (half, -half), (half, half), (-half, half)])
    inner = outer * half_hole / half
    corners = np.concatenate([np.column_stack([ring, np.full(4, half)]) for ring in (outer, inner)])
    ring = np.array([t for i in range(4) for t in ((i, (i + 1) % 4, 4 + i), ((i + 1) % 4, 4 + (i + 1) % 4, 4 + i))])
    return np.concatenate([vertices, corners]), np.concatenate([faces, ring + len(vertices)]), half
