"""Whether a ball touches a triangle soup, in plain NumPy: an answer that waits for no compiler and no hierarchy."""

import numpy as np
from jaxtyping import Float, Int


def distance_within(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], point: Float[np.ndarray, "3"], reach: float
) -> float:
    """Give the distance of a point to a triangle soup where it is at most `reach`, else infinity.

    Only triangles whose bounding box is within reach are looked at. Agrees with `ExactDistance` to rounding;
    degenerate triangles count as the segment or point that they are.

    Args:
        vertices: in metres.
        faces: vertex indices; at least one.
        point: in metres.
        reach: in metres.

    """
    triangles = vertices[faces]
    beyond = np.maximum(triangles.min(axis=1) - point, point - triangles.max(axis=1))
    near = triangles[np.linalg.norm(np.maximum(beyond, 0.0), axis=1) <= reach] - point
    if len(near) == 0:
        return np.inf
    edges = np.roll(near, -1, axis=1) - near
    distance = min(_to_segments(near, edges), _to_planes(near, edges))
    return distance if distance <= reach else np.inf


def _to_segments(corners: Float[np.ndarray, "n 3 3"], edges: Float[np.ndarray, "n 3 3"]) -> float:
    """Least distance of the origin to the triangles' sides."""
    squares = np.sum(edges**2, axis=2)
    along = np.clip(-np.sum(corners * edges, axis=2) / np.where(squares > 0.0, squares, 1.0), 0.0, 1.0)
    return float(np.linalg.norm(corners + along[..., None] * edges, axis=2).min())


def _to_planes(corners: Float[np.ndarray, "n 3 3"], edges: Float[np.ndarray, "n 3 3"]) -> float:
    """Least distance of the origin to the planes of those triangles above whose inside it lies; else infinity."""
    normal = np.cross(edges[:, 0], -edges[:, 2])
    length = np.linalg.norm(normal, axis=1)
    inward = np.cross(normal[:, None], edges)
    inside = (np.sum(inward * -corners, axis=2) >= 0.0).all(axis=1) & (length > 0.0)
    if not inside.any():
        return np.inf
    return float((np.abs(np.sum(corners[inside, 0] * normal[inside], axis=1)) / length[inside]).min())
