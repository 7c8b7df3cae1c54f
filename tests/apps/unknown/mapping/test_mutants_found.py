"""Blocks of cubes that a wall passes through: what is decided of all of them at once frees none behind it."""

import math

import numpy as np
import pytest
from truths.depth_views import Box, axes_towards, cube_centres, true_ranges

from keepout.apps.unknown.mapping import KnownFreeMap, Pinhole, SensorBounds, View

BOUNDS = SensorBounds()
CAMERA = Pinhole(120, 90, math.radians(60.0))


@pytest.mark.long
def test_no_cube_behind_a_wall_is_freed_with_its_block():
    freed = 0
    for height in np.arange(-0.7, 0.7, 0.1):
        known = KnownFreeMap.begin(np.zeros(3), 1.05, spacing=0.1, cap=0.4, bounds=BOUNDS, name="wall")
        wall, unknown, position = Box((-9.0, -9.0, -2.0), (9.0, 9.0, height)), ~known.free, np.array([0.1, 0.05, 4.0])
        axes = axes_towards(-position)
        freed += known.open(View(CAMERA, position, axes, true_ranges([wall], CAMERA, BOUNDS, position, axes)))
        behind = wall.meets_cubes(cube_centres(known), known.spacing) & unknown
        assert behind.any()
        assert not known.free[behind].any()
    assert freed > 1000
