"""Largest linear value on a distance's level set inside a cube: never below what samples of that set reach."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from keepout.core.geometry.distance import ExactDistance
from keepout.core.geometry.level_set import largest_on_level


def random_soup(rng, count):
    corners = rng.uniform(-1.0, 1.0, (count, 1, 3)) + 0.4 * rng.normal(size=(count, 3, 3))
    return ExactDistance(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3))


def on_level(distance, level, points):
    for _ in range(20):
        d, gradient = distance.distance_and_gradient(points)
        points = points + (level - d)[:, None] * gradient
    return points[np.abs(distance.distance(points) - level) < 1e-10]


@pytest.mark.long
@given(seed=st.integers(0, 10_000), level=st.floats(0.05, 0.8), half=st.tuples(*[st.floats(0.003, 0.3)] * 3))
def test_no_point_of_the_level_set_exceeds_the_bound(seed, level, half):
    rng = np.random.default_rng(seed)
    distance = random_soup(rng, 12)
    points = on_level(distance, level, rng.uniform(-2.0, 2.0, (150, 3)))
    half = np.tile(half, (len(points), 1))
    centres = points + half * rng.uniform(-1.0, 1.0, points.shape)
    # Half of the slopes follow the distance, as a field's do; the others are anything.
    slopes = rng.normal(size=points.shape)
    slopes[::2] = distance.distance_and_gradient(centres[::2])[1] + 0.1 * slopes[::2]
    bound = largest_on_level(distance, level, centres, half, slopes)
    assert (bound - ((points - centres) * slopes).sum(axis=1)).min() >= 0.0


def test_a_cube_beside_a_flat_face_is_bounded_by_its_level_plane():
    side = 10.0
    square = np.array([[-side, -side, 0.0], [side, -side, 0.0], [side, side, 0.0], [-side, side, 0.0]])
    distance = ExactDistance(square, np.array([[0, 1, 2], [0, 2, 3]]))
    centres = np.array([[5.0, -3.0, 0.45], [5.0, -3.0, 0.55], [5.0, -3.0, 0.65]])
    slopes = np.tile([0.0, 0.0, 1.0], (3, 1))
    bound = largest_on_level(distance, 0.5, centres, np.full((3, 3), 0.1), slopes)
    assert bound[:2] == pytest.approx([0.05, -0.05], abs=1e-8)  # the whole cubes would give 0.1
    assert bound[2] == -np.inf  # it does not meet the level
