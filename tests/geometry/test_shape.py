"""Shape measures against closed forms and against what they must enclose."""

import numpy as np
import pytest

from keepout.errors import MeshError
from keepout.geometry import Target, shape


def cube_corners(a, b, c):
    return np.array([(x, y, z) for x in (-a, a) for y in (-b, b) for z in (-c, c)], dtype=float)


def turned(points, seed=0):
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return points @ (q * np.sign(np.linalg.det(q))).T + np.array([3.0, -1.0, 7.0])


def test_smallest_ellipsoid_of_a_box():
    # Semi-axes of the smallest ellipsoid round a box are √3 times the box's half sides.
    found = shape.smallest_ellipsoid(turned(cube_corners(3.0, 1.0, 0.5)))
    np.testing.assert_allclose(found.semi_axes, np.sqrt(3.0) * np.array([3.0, 1.0, 0.5]), rtol=1e-6)
    np.testing.assert_allclose(found.centre, [3.0, -1.0, 7.0], atol=1e-6)


def test_smallest_ellipsoid_of_an_affine_simplex():
    # The smallest ellipsoid of an affine image is the affine image of the smallest: a regular simplex gives the sphere.
    simplex = np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)], dtype=float)
    stretch = np.array([[2.0, 0.3, 0.0], [0.0, 1.0, -0.4], [0.1, 0.0, 0.7]])
    found = shape.smallest_ellipsoid(simplex @ stretch.T)
    assert found.volume == pytest.approx(4.0 / 3.0 * np.pi * 3.0**1.5 * np.linalg.det(stretch), rel=1e-6)


@pytest.mark.parametrize("name", ["intelsat30", "tiangong"])
def test_measures_enclose_the_target(name):
    points = Target.load(name).vertices
    ellipsoid = shape.smallest_ellipsoid(points, 1e-4)
    offset = points - ellipsoid.centre
    assert np.einsum("ij,jk,ik->i", offset, ellipsoid.matrix, offset).max() <= 1.0 + 1e-9
    _, hull = shape.convex_hull(points)
    assert hull < min(ellipsoid.volume, np.prod(np.ptp(points, axis=0)))


def test_volumes_of_simple_targets():
    pocket = Target.load("pocket")
    assert shape.enclosed_volume(pocket.vertices, pocket.faces) == pytest.approx(6 * 4 * 6 - 5.4 * 3.7 * 5.4)
    box = Target.load("box")
    assert shape.enclosed_volume(box.vertices, box.faces) == pytest.approx(24.0)
    assert shape.convex_hull(box.vertices)[1] == pytest.approx(24.0)


def test_flat_points_are_refused():
    with pytest.raises(MeshError, match="span no volume"):
        shape.smallest_ellipsoid(np.zeros((10, 3)))
