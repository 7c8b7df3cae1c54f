"""Random triangles and boxes, and points in them."""

import numpy as np

from keepout.proof import bounds


def points_in(elements, rng, each):
    """Random points of each element (each, m, 3), corners among them."""
    columns = elements.columns
    m = columns.shape[1]
    if elements.kind == "triangle":
        weights = rng.dirichlet(np.full(3, 0.5), size=(each, m))
        weights[:3] = np.eye(3)[:, None, :]
        return np.einsum("emk,kmi->emi", weights, columns)
    signs = rng.uniform(-1.0, 1.0, size=(each, m, 3))
    signs[: each // 4] = np.sign(signs[: each // 4])
    return columns[0] + np.einsum("emk,kmi->emi", signs, columns[1:])


def random_elements(kind, rng, m, size):
    if kind == "triangle":
        return bounds.triangles(rng.uniform(-0.7, 0.7, (m, 1, 3)) + size * rng.normal(size=(m, 3, 3)))
    return bounds.boxes(rng.uniform(-0.7, 0.7, (m, 3)), size * rng.uniform(0.2, 1.0, (m, 3)))
