"""A ball against a triangle soup: as the exact distance says, for triangles of every shape."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from keepout.core.geometry.distance import ExactDistance, distance_within

COARSE = st.tuples(*[st.integers(-3, 3).map(float)] * 3)
"""Corners on a coarse grid: many triangles are degenerate, and many points lie on a side, a corner or in a plane."""
FINE = st.tuples(*[st.floats(-3.0, 3.0)] * 3)


@given(st.lists(st.tuples(*[COARSE | FINE] * 3), min_size=1, max_size=8), COARSE | FINE)
@example([((0.0, 0.0, 0.0),) * 3], (1.0, 2.0, 2.0))
@example([((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (3.0, 0.0, 0.0))], (2.0, 0.0, 1.0))
def test_it_is_the_exact_distance_within_reach_and_infinite_beyond(triangles, point):
    vertices = np.array(triangles).reshape(-1, 3)
    faces, point = np.arange(len(vertices)).reshape(-1, 3), np.array(point)
    exact = ExactDistance(vertices, faces).distance(point[None])[0]
    assert distance_within(vertices, faces, point, exact + 1e-6) == pytest.approx(exact, abs=1e-9)
    assert distance_within(vertices, faces, point, exact - 1e-6) == np.inf
