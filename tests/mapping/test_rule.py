"""Which cubes a view frees: the rule itself, cube by cube, written without the compiled loops."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
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

from keepout.mapping import KnownFreeMap, Pinhole, SensorBounds, View, ViewStatus
from keepout.mapping.pyramid import pyramid
from keepout.mapping.windows import all_exceed, none_exceeds

CAMERA = Pinhole(40, 30, math.radians(60.0))
BOUNDS = SensorBounds(surely_returned_width=0.12)
BODIES = (Ball((0.1, -0.2, 0.0), 0.4), Box((0.3, 0.0, -0.5), (0.5, 0.6, 0.4)))


def begin(radius=1.0, spacing=0.1, bounds=BOUNDS):
    return KnownFreeMap.begin(np.zeros(3), radius, spacing=spacing, cap=3 * spacing, bounds=bounds, name="bodies")


def place(seed, distance):
    """A place at a distance, the axes towards somewhere near the middle."""
    generator = np.random.default_rng(seed)
    position = generator.normal(size=3)
    position *= distance / np.linalg.norm(position)
    return position, axes_towards(0.5 * generator.normal(size=3) - position, generator.uniform(0.0, 6.0)), generator


def seen_from(seed, distance, camera=CAMERA, bounds=BOUNDS):
    """A view of the bodies with lost pixels, losses that read as empty, and some far too long returns."""
    position, axes, generator = place(seed, distance)
    ranges = true_ranges(BODIES, camera, bounds, position, axes)
    draw = generator.random(ranges.shape)
    ranges[draw < 0.01] = np.nan
    ranges[(draw > 0.01) & (draw < 0.02)] = np.inf
    ranges[draw > 0.99] += 5.0
    return View(camera, position, axes, ranges)


views = st.builds(
    seen_from,
    st.integers(0, 10**6),
    st.floats(1.35, 4.0),  # outside every cube that meets the ball
    st.sampled_from([CAMERA, Pinhole(33, 57, 1.3), Pinhole(64, 9, 2.0), Pinhole(7, 7, 0.6)]),
)
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
@settings(max_examples=25)
@given(views, many_bounds, st.sampled_from([0.1, 0.07, 0.19]))
def test_a_view_frees_the_cubes_of_the_rule_and_no_other(view, bounds, spacing):
    known = begin(spacing=spacing, bounds=bounds)
    expected = known.free | freed_by_rectangles(known, view)
    opened = known.open(view)  # `see` refuses such images: returns far too long contradict the map
    before = begin(spacing=spacing, bounds=bounds).free
    assert opened == known.free.sum() - before.sum()
    np.testing.assert_array_equal(known.free, expected)


@pytest.mark.long
@settings(max_examples=4)
@given(st.integers(0, 10**6), st.floats(2.3, 3.5))
def test_blocks_decided_at_once_are_decided_as_their_cubes(seed, distance):
    """A larger ball and a finer camera, so that whole blocks are freed and whole blocks passed over."""
    camera = Pinhole(80, 60, math.radians(60.0))
    known = begin(radius=2.0)
    view = seen_from(seed, distance, camera)
    expected = known.free | freed_by_rectangles(known, view)
    known.open(view)
    np.testing.assert_array_equal(known.free, expected)


@pytest.mark.long
@settings(max_examples=8)
@given(views)
def test_no_cube_is_freed_whose_projection_holds_a_pixel_that_forbids_it(view):
    known = begin()
    before = known.free.copy()
    allowed = before | freed_by_projections(known, view)
    known.open(view)
    assert not (known.free & ~allowed).any()


def test_the_views_of_these_tests_free_cubes_and_leave_others():
    known = begin()
    unknown = (~known.free).sum()
    opened = sum(known.open(seen_from(seed, 2.5)) for seed in range(12))
    assert 0.2 * unknown < opened < unknown


def test_a_view_frees_nothing_round_its_own_place_or_at_its_sides():
    """Round the sensor the ball's projection is wider than the image: that room must be free beforehand."""
    bounds = SensorBounds(least_range=0.0)
    known = begin(bounds=bounds)
    position = np.array([0.0, 0.0, 1.9])
    for axes in (axes_towards([0, 0, -1], roll) for roll in np.linspace(0.0, 6.0, 13)):
        known.see(View(CAMERA, position, axes, np.full(CAMERA.shape, np.inf)))
    opened = cube_centres(known)[known.free & ~begin(bounds=bounds).free]
    offset = opened - position
    distance = np.linalg.norm(offset, axis=1)
    radius = 0.05 * math.sqrt(3.0) + 0.05 + 0.05 + 0.005 * distance
    assert len(opened) > 100
    half = math.atan(0.5 * CAMERA.width / CAMERA.focal)  # of the wider side
    assert (distance * math.sin(half) >= radius).all()
    assert (np.arccos(-offset[:, 2] / distance) + np.arcsin(radius / distance) < math.hypot(half, half)).all()


def test_cubes_are_freed_within_the_least_and_the_usable_range_only():
    bounds = SensorBounds(surely_returned_width=0.12, least_range=1.5, greatest_range=2.2)
    known = begin(bounds=bounds)
    position = np.array([0.0, 0.0, 2.0])
    known.see(View(CAMERA, position, axes_towards([0, 0, -1]), np.full(CAMERA.shape, np.inf)))
    opened = cube_centres(known)[known.free & ~begin(bounds=bounds).free]
    distance = np.linalg.norm(opened - position, axis=1)
    reach = 0.05 * math.sqrt(3.0) + bounds.position_error
    assert 1.5 <= distance.min() - reach < 1.52
    # A pixel without return is empty out to 2.2 m as well: w more than the range asks.
    assert 2.17 < distance.max() + reach + bounds.surely_returned_width <= 2.2


def test_cubes_are_freed_out_to_the_usable_range():
    """Where the smallest part that surely returns sets the range, along the boresight and in the image's corners."""
    bounds = SensorBounds(surely_returned_width=0.06, rays_across=3)
    camera = Pinhole(80, 60, math.radians(60.0))
    known = begin(radius=3.5, bounds=bounds)
    position, axes = np.array([3.9, 0.0, 0.0]), axes_towards([-1, 0, 0], 0.4)
    usable = 0.5 * 0.06 * 3 * 40.0 / math.tan(math.radians(30.0))
    known.see(View(camera, position, axes, np.full(camera.shape, np.inf)))
    offset = cube_centres(known)[known.free & ~begin(radius=3.5, bounds=bounds).free] - position
    reach = np.linalg.norm(offset, axis=1) + 0.05 * math.sqrt(3.0) + bounds.position_error
    assert usable - 0.02 < reach.max() <= usable
    x, y, z = (offset @ axes).T
    for right in (-1, 1):
        for down in (-1, 1):
            corner = (x / z * right > 0.45) & (y / z * down > 0.3)
            assert usable - 0.1 < reach[corner].max() <= usable


def test_a_block_that_the_least_range_cuts_is_not_freed_as_a_whole():
    bounds = SensorBounds(surely_returned_width=0.12, least_range=2.5)
    known = begin(bounds=bounds)
    position, camera = np.array([0.0, 0.0, 3.0]), Pinhole(40, 40, math.radians(90.0))
    known.see(View(camera, position, axes_towards([0, 0, -1]), np.full(camera.shape, np.inf)))
    opened = cube_centres(known)[known.free & ~begin(bounds=bounds).free]
    reach = 0.05 * math.sqrt(3.0) + bounds.position_error
    assert 2.5 <= np.linalg.norm(opened - position, axis=1).min() - reach < 2.51


def test_a_pixel_that_says_nothing_opens_nothing_behind_it():
    known = begin()
    ranges = np.full(CAMERA.shape, np.inf)
    ranges[15, 20] = np.nan
    known.see(View(CAMERA, np.array([0.0, 0.0, 2.0]), axes_towards([0, 0, -1]), ranges))
    middle = len(known.free) // 2
    assert not known.free[middle, middle, middle - 5 : middle + 5].any()
    assert known.free[middle + 5, middle, middle]


def test_no_return_says_nothing_where_the_sure_empty_range_is_zero():
    """Returns at 3 m open; the same image without them opens nothing."""
    known = begin(bounds=SensorBounds(surely_returned_width=0.12, sure_empty_range=0.0))
    position, axes = np.array([0.0, 0.0, 2.0]), axes_towards([0, 0, -1])
    half = np.full(CAMERA.shape, np.inf)
    half[:, :20] = 3.5
    assert known.see(View(CAMERA, position, axes, np.full(CAMERA.shape, np.inf))).status is ViewStatus.EMPTY
    assert known.open(View(CAMERA, position, axes, half)) > 0
    side = (cube_centres(known) - position) @ axes[:, 0]
    opened = known.free & ~begin().free
    assert (side[opened] < 0.0).all()


def test_no_return_says_nothing_beyond_the_greatest_range():
    """A body just beyond the greatest range gives no return; what it may reach is not freed by that."""
    freed = []
    for sure in (2.0, 15.0):
        bounds = SensorBounds(surely_returned_width=0.12, sure_empty_range=sure, greatest_range=2.0)
        known = begin(bounds=bounds)
        known.see(View(CAMERA, np.array([0.0, 0.0, 2.0]), axes_towards([0, 0, -1]), np.full(CAMERA.shape, np.inf)))
        freed.append(known.free.copy())
    np.testing.assert_array_equal(freed[0], freed[1])


@settings(max_examples=60)
@given(st.integers(1, 20), st.integers(1, 20), st.integers(0, 10**6))
def test_the_least_and_greatest_of_every_rectangle(rows, columns, seed):
    generator = np.random.default_rng(seed)
    image = generator.integers(0, 50, (rows, columns)).astype(float)
    least, greatest = pyramid(image), pyramid(image, greatest=True)
    for _ in range(30):
        top, bottom = np.sort(generator.integers(0, rows, 2))
        left, right = np.sort(generator.integers(0, columns, 2))
        inner = image[top : bottom + 1, left : right + 1]
        for limit in (inner.min() - 0.5, inner.min(), inner.max(), inner.max() - 0.5):
            assert all_exceed(least, top, bottom, left, right, limit) == (inner > limit).all()
            assert none_exceeds(greatest, top, bottom, left, right, limit) == (inner <= limit).all()
