"""The ordinary map: right where it has looked, and free where it has not, which is what is wrong with it."""

import math

import numpy as np
import pytest
from truncated_distance import TruncatedDistanceMap

from keepout.mapping.known_free import KnownFreeMap
from keepout.mapping.view import Pinhole, SensorBounds, View

CAMERA = Pinhole(160, 120, math.radians(60.0))
WALL = 4.0
"""Metres from the sensor to a wall across its boresight."""


@pytest.fixture(scope="module")
def maps():
    known = KnownFreeMap.begin(np.zeros(3), 2.5, spacing=0.1, cap=1.2, bounds=SensorBounds(), name="wall")
    ordinary = TruncatedDistanceMap(known)
    # From -z along +z; the wall is the plane z = WALL - 4 = 0.
    ranges = WALL / CAMERA.directions()[..., 2]
    view = View(CAMERA, np.array([0.0, 0.0, -WALL]), np.eye(3), ranges)
    ordinary.see(view)
    known.see(view)
    return known, ordinary


def node(known, x, y, z):
    return tuple(np.rint((np.array([x, y, z]) - known.origin) / known.spacing).astype(int))


def test_it_gives_distances_in_the_form_of_the_known_free_map(maps):
    known, ordinary = maps
    squares = ordinary.squares()
    assert squares.shape == known.squares.shape
    assert squares.dtype == known.squares.dtype
    assert squares.max() == 12**2


def test_before_a_seen_wall_its_distance_is_that_of_the_wall_to_a_cube(maps):
    known, ordinary = maps
    squares = ordinary.squares()
    for away in (0.2, 0.5, 0.9):
        found = known.spacing * math.sqrt(squares[node(known, 0.0, 0.0, -away)])
        assert away - 0.1 - 1e-6 <= found <= away + 0.1 + 1e-6


def test_what_it_has_not_seen_it_takes_for_free_and_the_known_free_map_does_not(maps):
    known, ordinary = maps
    squares = ordinary.squares()
    behind = node(known, 0.0, 0.0, 1.8)
    assert squares[behind] == 12**2
    assert known.squares[behind] == 0


def test_a_second_view_is_averaged_in():
    known = KnownFreeMap.begin(np.zeros(3), 1.0, spacing=0.1, cap=1.2, bounds=SensorBounds(), name="wall")
    ordinary = TruncatedDistanceMap(known)
    for depth in (3.9, 4.1):
        ordinary.see(View(CAMERA, np.array([0.0, 0.0, -WALL]), np.eye(3), depth / CAMERA.directions()[..., 2]))
    middle = len(known.free) // 2
    column = ordinary.mean[middle, middle]
    z = known.origin[2] + known.spacing * (np.arange(len(column)) + 0.5)
    near = np.abs(z) < 0.25
    np.testing.assert_allclose(column[near], -z[near], atol=0.01)
    assert (ordinary.weight[middle, middle][near] == 2).all()
