"""Silhouettes of ellipsoids."""

import numpy as np

from keepout.apps.reproduction import surface_view
from keepout.core.measures.surface import Ellipsoid
from keepout.flights.report.raster import eye_axes


def test_the_silhouette_holds_every_point_of_the_ellipsoid_and_is_touched():
    rng = np.random.default_rng(0)
    square = rng.normal(size=(3, 3))
    ellipsoid = Ellipsoid(np.zeros(3), square @ square.T + 0.3 * np.eye(3))
    sphere = rng.normal(size=(200_000, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    points = sphere @ np.linalg.inv(np.linalg.cholesky(ellipsoid.matrix))
    np.testing.assert_allclose(np.einsum("ni,ij,nj->n", points, ellipsoid.matrix, points), 1.0)
    seen = points @ eye_axes(surface_view._ELEVATION, surface_view._AZIMUTH)[:2].T
    level = np.einsum("ni,ij,nj->n", seen, np.linalg.inv(surface_view._outline(ellipsoid)), seen)
    assert 0.999 < level.max() <= 1.0 + 1e-9
    width, height = surface_view._extent(surface_view._outline(ellipsoid))
    np.testing.assert_allclose([width, height], 2.0 * np.abs(seen).max(axis=0), rtol=1e-3)
