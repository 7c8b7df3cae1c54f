"""Silhouettes of ellipsoids, and training curves drawn."""

import numpy as np

from keepout.geometry.shape import Ellipsoid
from keepout.report import surface_view
from keepout.report.raster import eye_axes
from keepout.report.training_view import draw_sinking, draw_training


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


def test_curves_are_drawn(tmp_path):
    curve = {
        "steps": [250, 500, 750],
        "value_term": [0.1, 0.05, 0.02],
        "gradient_term": [0.2, 0.1, 0.1],
        "mean_error_m": [0.5, -0.2, 0.0],
    }
    draw_training(tmp_path / "training.png", {"one": curve, "two": curve})
    draw_sinking(tmp_path / "sinking.png", {"printed": curve, "pinball": {**curve, "steps": [250, 500, 1000]}})
    for name in ("training", "sinking"):
        assert (tmp_path / f"{name}.png").stat().st_size > 5_000 < (tmp_path / f"{name}.svg").stat().st_size
