"""Which cubes triangles meet, beside a linear programme for each pair."""

import numpy as np
import pytest
from scipy.optimize import linprog

from keepout.apps.unknown.exploration import cubes_met

pytestmark = pytest.mark.long


def apart(triangle, lower, spacing):
    """Least distance, along an axis, by which every point of a triangle is outside a cube; below 0 where one is in."""
    # Least s with |point - middle| <= spacing / 2 + s along each axis; unknowns: three weights and s.
    middle = lower + 0.5 * spacing
    sides = np.vstack([np.hstack([triangle.T, -np.ones((3, 1))]), np.hstack([-triangle.T, -np.ones((3, 1))])])
    limits = np.concatenate([middle, -middle]) + 0.5 * spacing
    weights = np.array([[1.0, 1.0, 1.0, 0.0]])
    found = linprog([0, 0, 0, 1], sides, limits, weights, [1.0], [(0, 1)] * 3 + [(None, None)])
    return found.fun


def test_triangles_meet_the_cubes_that_a_linear_programme_says():
    generator = np.random.default_rng(0)
    origin, spacing, count = np.array([-0.2, 0.1, 0.3]), 0.4, 3
    near = 0
    for size in (0.1, 0.4, 1.0):
        corners = origin + generator.uniform(0.0, 1.2, 3) + generator.uniform(-size, size, (3, 3))
        met = cubes_met(corners, np.array([[0, 1, 2]]), origin, spacing, count)
        for cube in np.ndindex(met.shape):
            gap = apart(corners, origin + spacing * np.array(cube), spacing)
            assert met[cube] == (gap < 0.0), (cube, gap)
            near += abs(gap) < 0.1
    assert near > 10


def test_a_wire_a_point_and_what_only_touches():
    met = cubes_met(np.array([[0.5, 0.5, -9.0], [0.5, 0.5, 9.0]]), np.array([[0, 1, 1]]), np.zeros(3), 1.0, 4)
    assert np.argwhere(met).tolist() == [[0, 0, k] for k in range(4)]
    met = cubes_met(np.array([[2.5, 1.5, 0.5]]), np.array([[0, 0, 0]]), np.zeros(3), 1.0, 4)
    assert np.argwhere(met).tolist() == [[2, 1, 0]]
    side = np.array([[1.0, 1.2, 1.2], [1.0, 1.8, 1.2], [1.0, 1.2, 1.8]])
    assert not cubes_met(side, np.array([[0, 1, 2]]), np.zeros(3), 1.0, 4).any()
