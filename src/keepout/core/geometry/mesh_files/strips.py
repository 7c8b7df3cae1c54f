"""Triangles of strips and fans."""

import numpy as np
from jaxtyping import Int


def strip_triangles(strip: Int[np.ndarray, "n"]) -> tuple[Int[np.ndarray, "f 3"], int]:
    """Triangles (i, i + 1, i + 2), every other one turned round so that all face the same way.

    Returns:
        The triangles, without those that repeat a corner: such joints between strips are not drawn; and their number.

    """
    faces = np.stack([strip[:-2], strip[1:-1], strip[2:]], axis=1) if len(strip) > 2 else np.zeros((0, 3), np.int64)
    faces[1::2] = faces[1::2, ::-1]
    return _without_joints(faces)


def fan_triangles(fan: Int[np.ndarray, "n"]) -> tuple[Int[np.ndarray, "f 3"], int]:
    """Triangles (0, i + 1, i + 2) of a fan, without those that repeat a corner; and their number."""
    faces = np.zeros((max(len(fan) - 2, 0), 3), dtype=np.int64)
    if len(faces):
        faces[:, 0], faces[:, 1], faces[:, 2] = fan[0], fan[1:-1], fan[2:]
    return _without_joints(faces)


def _without_joints(faces: Int[np.ndarray, "f 3"]) -> tuple[Int[np.ndarray, "kept 3"], int]:
    joint = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    return np.ascontiguousarray(faces[~joint]), int(joint.sum())
