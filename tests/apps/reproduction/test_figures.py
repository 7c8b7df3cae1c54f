"""Silhouettes of ellipsoids."""

import numpy as np

from keepout.apps.reproduction import figures
from keepout.core.measures.surface import Ellipsoid
from keepout.flights.pages.mesh_pictures import eye_axes


def test_the_silhouette_holds_every_point_of_the_ellipsoid_and_is_touched():
    rng = np.random.default_rng(0)
    square = rng.normal(size=(3, 3))
    ellipsoid = Ellipsoid(np.zeros(3), square @ square.T + 0.3 * np.eye(3))
    sphere = rng.normal(size=(200_000, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    points = sphere @ np.linalg.inv(np.linalg.cholesky(ellipsoid.matrix))
    np.testing.assert_allclose(np.einsum("ni,ij,nj->n", points, ellipsoid.matrix, points), 1.0)
    seen = points @ eye_axes(*figures.SIDE)[:2].T
    level = np.einsum("ni,ij,nj->n", seen, np.linalg.inv(figures.outline(ellipsoid)), seen)
    assert 0.999 < level.max() <= 1.0 + 1e-9
    width, height = figures.extent(figures.outline(ellipsoid))
    np.testing.assert_allclose([width, height], 2.0 * np.abs(seen).max(axis=0), rtol=1e-3)
