"""Bodies round a cloud of points against closed forms."""

import numpy as np
import pytest

from keepout.core.errors import MeshError
from keepout.core.geometry import shape


def test_smallest_ellipsoid_of_an_affine_simplex():
    # The smallest ellipsoid of an affine image is the affine image of the smallest: a regular simplex gives the sphere.
    simplex = np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)], dtype=float)
    stretch = np.array([[2.0, 0.3, 0.0], [0.0, 1.0, -0.4], [0.1, 0.0, 0.7]])
    found = shape.smallest_ellipsoid(simplex @ stretch.T)
    assert found.volume == pytest.approx(4.0 / 3.0 * np.pi * 3.0**1.5 * np.linalg.det(stretch), rel=1e-6)


def test_flat_points_are_refused():
    with pytest.raises(MeshError, match="span no volume"):
        shape.smallest_ellipsoid(np.zeros((10, 3)))
