"""Which cubes a view frees: the rule itself, cube by cube, written without the compiled loops."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from truths.depth_views import (
    Ball,
    Box,
    axes_towards,
    cube_centres,
    freed_by_projections,
    freed_by_rectangles,
    true_ranges,
)

from keepout.apps.led.camera import Pinhole
from keepout.apps.unknown.known_free import KnownFreeMap, ViewStatus
from keepout.apps.unknown.rule import all_exceed, pyramid
from keepout.apps.unknown.view import SensorBounds, View

CAMERA = Pinhole(40, 30, math.radians(60.0))
BOUNDS = SensorBounds(surely_returned_width=0.12)
BODIES = (Ball((0.1, -0.2, 0.0), 0.4), Box((0.3, 0.0, -0.5), (0.5, 0.6, 0.4)))


def begin(radius=1.0, spacing=0.1, bounds=BOUNDS):
    return KnownFreeMap.begin(np.zeros(3), radius, spacing=spacing, cap=3 * spacing, bounds=bounds, name="bodies")


def opened_by(known, view):
    """Indices of the cubes that a view frees; `see` refuses such images: returns far too long contradict the map."""
    before = known.free.copy()
    opened = known.open(view)
    cubes = np.argwhere(known.free & ~before)
    assert (known.free >= before).all()
    assert opened == len(cubes)
    return cubes


def seen_from(seed, distance, camera=CAMERA, bounds=BOUNDS):
    """A view of the bodies with lost pixels, losses that read as empty, and some far too long returns."""
    generator = np.random.default_rng(seed)
    position = generator.normal(size=3)
    position *= distance / np.linalg.norm(position)
    axes = axes_towards(0.5 * generator.normal(size=3) - position, generator.uniform(0.0, 6.0))
    ranges = true_ranges(BODIES, camera, bounds, position, axes)
    draw = generator.random(ranges.shape)
    ranges[draw < 0.01] = np.nan
    ranges[(draw > 0.01) & (draw < 0.02)] = np.inf
    ranges[draw > 0.99] += 5.0
    return View(camera, position, axes, ranges)


many_bounds = st.builds(
    SensorBounds,
    range_error=st.floats(0.0, 0.1),
    position_error=st.floats(0.0, 0.1),
    attitude_error=st.floats(0.0, 0.05),
    surely_returned_width=st.floats(0.01, 0.3),
    rays_across=st.integers(1, 4),
    sure_empty_range=st.sampled_from([0.0, 2.0, 15.0]),
    least_range=st.floats(0.0, 2.0),
    greatest_range=st.floats(2.5, 15.0),
)


@pytest.mark.long
@given(data=st.data())
def test_a_view_frees_the_cubes_of_the_rule_and_no_other(data):
    """Nor is one freed whose projection, an ellipse, holds a pixel that forbids it."""
    bounds, cameras = data.draw(many_bounds), [CAMERA, Pinhole(33, 57, 1.3), Pinhole(64, 9, 2.0), Pinhole(7, 7, 0.6)]
    distance = 1.0 + data.draw(st.floats(0.35, 3.0))  # outside every cube that meets the ball
    view = seen_from(data.draw(st.integers(0, 10**6)), distance, data.draw(st.sampled_from(cameras)), bounds)
    known = begin(1.0, data.draw(st.sampled_from([0.1, 0.07, 0.19])), bounds)
    expected = known.free | freed_by_rectangles(known, view)
    cubes = opened_by(known, view)
    np.testing.assert_array_equal(known.free, expected)
    some = cubes[np.random.default_rng(0).permutation(len(cubes))[:60]]
    assert freed_by_projections(known, view, some).all()


def all_empty(bounds, position, axes, camera=CAMERA):
    """Centres of the cubes that an image without any return frees, from its place."""
    known = begin(bounds=bounds)
    cubes = opened_by(known, View(camera, position, axes, np.full(camera.shape, np.inf)))
    return cube_centres(known)[tuple(cubes.T)] - position


def test_no_cube_is_freed_within_the_least_range():
    bounds = SensorBounds(surely_returned_width=0.12, least_range=2.5)
    camera = Pinhole(40, 40, math.radians(90.0))
    offset = all_empty(bounds, np.array([0.0, 0.0, 3.0]), axes_towards([0, 0, -1]), camera)
    reach = 0.05 * math.sqrt(3.0) + bounds.position_error
    assert 2.5 <= np.linalg.norm(offset, axis=1).min() - reach < 2.51


def test_a_pixel_without_return_is_empty_out_to_the_least_of_sure_and_greatest_range():
    """And says nothing where the sure empty range is zero, though its neighbours' returns open room."""
    position, axes = np.array([0.0, 0.0, 2.0]), axes_towards([0, 0, -1])
    for sure, greatest in ((15.0, 2.2), (2.2, 15.0)):
        bounds = SensorBounds(surely_returned_width=0.12, sure_empty_range=sure, greatest_range=greatest)
        distance = np.linalg.norm(all_empty(bounds, position, axes), axis=1)
        # As it must be empty for a range that frees: w beyond the cube's farthest point.
        assert 2.17 < distance.max() + 0.05 * math.sqrt(3.0) + bounds.position_error + 0.12 <= 2.2
    known = begin(bounds=SensorBounds(surely_returned_width=0.12, sure_empty_range=0.0))
    half = np.full(CAMERA.shape, np.inf)
    assert known.see(View(CAMERA, position, axes, half)).status is ViewStatus.EMPTY
    half[:, :20] = 3.5
    cubes = opened_by(known, View(CAMERA, position, axes, half))
    assert len(cubes)
    assert ((cube_centres(known)[tuple(cubes.T)] - position) @ axes[:, 0] < 0.0).all()


@given(st.integers(1, 20), st.integers(1, 20), st.integers(0, 10**6))
def test_the_least_of_every_rectangle(rows, columns, seed):
    generator = np.random.default_rng(seed)
    image = generator.integers(0, 50, (rows, columns)).astype(float)
    least = pyramid(image)
    for _ in range(30):
        top, bottom = np.sort(generator.integers(0, rows, 2))
        left, right = np.sort(generator.integers(0, columns, 2))
        inner = image[top : bottom + 1, left : right + 1]
        for limit in (inner.min() - 0.5, inner.min(), inner.max(), inner.max() - 0.5):
            assert all_exceed(least, top, bottom, left, right, limit) == (inner > limit).all()
