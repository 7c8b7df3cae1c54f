"""Returns in known-free room: counted as the words say, never while the promises are kept, and always left out."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from truths.depth_views import Ball, Box, axes_towards, true_ranges, turned

from keepout.mapping import KnownFreeMap, Pinhole, SensorBounds, View, ViewStatus
from keepout.mapping.contradiction import in_free_room

CAMERA = Pinhole(60, 45, math.radians(60.0))
BOUNDS = SensorBounds()
SCENES = {
    "ball": (Ball((0.0, 0.1, 0.0), 0.5),),
    "box": (Box((-0.43, -0.31, -0.27), (0.42, 0.33, 0.38)),),
    "plate before a ball": (Box((-0.6, -0.6, 0.5), (0.6, 0.6, 0.58)), Ball((0.0, 0.0, -0.2), 0.45)),
}


def begin(radius=1.05, **changes):
    return KnownFreeMap.begin(
        np.zeros(3), radius, **({"spacing": 0.1, "cap": 0.4, "bounds": BOUNDS, "name": "bodies"} | changes)
    )


def image(bodies, position, generator, *, times=1.0, at=None, bounds=BOUNDS, camera=CAMERA):
    """An image with errors of ranges and pose at so many times their bounds, each of a random sign and direction."""
    axes = axes_towards((generator.uniform(-0.4, 0.4, 3) if at is None else at) - position, generator.uniform(0.0, 6.0))
    ranges = true_ranges(bodies, camera, bounds, position, axes)
    signs = generator.choice([-1.0, 1.0]) if generator.random() < 0.5 else generator.choice([-1.0, 1.0], ranges.shape)
    move, about = generator.normal(size=(2, 3))
    return View(
        camera,
        position + times * bounds.position_error * move / np.linalg.norm(move),
        turned(axes, times * bounds.attitude_error, about),
        np.maximum(ranges + times * bounds.range_error * signs, 0.0),
    )


def around(generator):
    place = generator.normal(size=3)
    return place * generator.uniform(1.7, 2.6) / np.linalg.norm(place)


def by_brute_force(points, reach, origin, spacing, free):
    """Whether each point is farther than its reach from all cubes that are not free, over all of them."""
    lower = origin + spacing * np.argwhere(~free)
    away = np.maximum(np.maximum(lower - points[:, None], points[:, None] - lower - spacing), 0.0)
    return np.linalg.norm(away, axis=2).min(axis=1) > reach


@settings(max_examples=20)
@given(seed=st.integers(0, 10**6), share=st.floats(0.0, 0.1))
def test_room_round_a_point_is_free_as_brute_force_says(seed, share):
    generator = np.random.default_rng(seed)
    free = np.ones((14, 14, 14), dtype=bool)
    free[4:10, 4:10, 4:10] = generator.random((6, 6, 6)) >= share
    free[generator.integers(4, 10), 6, 7] = False
    origin, spacing, cap = np.array([-0.3, 0.2, 1.0]), 0.11, 0.33
    points = origin + generator.uniform(-0.5, 14 * spacing + 0.5, (200, 3))
    reach = generator.uniform(0.0, 0.32, 200)
    found = in_free_room(points, reach, origin, spacing, free, cap)
    assert found.tolist() == by_brute_force(points, reach, origin, spacing, free).tolist()
    assert not in_free_room(points, reach + cap, origin, spacing, free, cap).any()


@pytest.mark.parametrize("scene", SCENES)
@settings(max_examples=4)
@given(seed=st.integers(0, 10**6), bounds=st.sampled_from([BOUNDS, SensorBounds(rays_across=3, attitude_error=0.02)]))
def test_no_sensor_within_its_bounds_ever_contradicts_a_map(scene, seed, bounds):
    generator = np.random.default_rng(seed)
    known, returns = begin(bounds=bounds), 0
    for _ in range(30):
        view = image(SCENES[scene], around(generator), generator, bounds=bounds)
        report = known.see(view)
        assert (report.status, report.contradicting) == (ViewStatus.SEEN, 0)
        returns += int(np.isfinite(view.ranges).sum())
    assert returns > 3000
    assert known.assumptions_broken == ()


@pytest.mark.parametrize("scene", SCENES)
def test_nor_is_the_bound_much_too_wide(scene):
    """Errors two and a half times their bounds are found out."""
    generator = np.random.default_rng(1)
    known = begin()
    reports = [known.see(image(SCENES[scene], around(generator), generator, times=2.5)) for _ in range(40)]
    assert known.contradicting == sum(report.contradicting for report in reports) > 0
    assert "returns contradict it" in known.assumptions_broken[0]


WIRE = Box((-0.0005, -0.0005, -0.9), (0.0005, 0.0005, 0.3))
"""A millimetre thick: from along it no ray meets it, so that room is called free which it crosses."""


def test_a_wire_looked_along_and_then_seen_from_aside_contradicts():
    bodies, generator = (Ball((0.0, 0.0, 0.5), 0.2), WIRE), np.random.default_rng(2)
    known, camera = begin(1.0), Pinhole(160, 120, math.radians(60.0))
    along = image(bodies, np.array([0.0, 0.0, -3.0]), generator, times=0.0, at=np.zeros(3), camera=camera)
    assert known.see(along).status is ViewStatus.SEEN
    on_wire = np.linspace([0.0, 0.0, -0.9], [0.0, 0.0, 0.0], 20)
    assert known.is_free(on_wire).any()  # assumption A1 does not hold of it
    before = known.free.copy(), known.return_keys.copy(), known.views
    aside = image(bodies, np.array([2.0, 0.0, -0.3]), generator, at=np.array([0.0, 0.0, -0.3]), camera=camera)
    report = known.see(aside)
    assert report.status is ViewStatus.CONTRADICTED
    assert report.opened == 0
    # Truth: the returns that are nearer to the wire's axis than to the ball behind it.
    points = aside.points()
    assert 0 < report.contradicting <= (np.linalg.norm(points[:, :2], axis=1) < 0.2).sum()
    assert all(np.array_equal(one, two) for one, two in zip(before, (known.free, known.return_keys, known.views)))


def test_a_view_that_is_refused_is_counted_as_well():
    generator = np.random.default_rng(3)
    known = begin(speed_limit=0.1)
    known.see(image((Ball((0.0, 0.0, 0.0), 0.4),), np.array([0.0, 0.0, -2.0]), generator, at=np.zeros(3)))
    elsewhere = (Ball((0.0, 0.0, -0.8), 0.1),)
    jumped = image(elsewhere, np.array([0.0, 2.0, -0.8]), generator, at=np.array([0.0, 0.0, -0.8]))
    report = known.see(jumped)
    assert report.status is ViewStatus.POSE_JUMP
    assert report.contradicting == known.contradicting > 0
    no_place = dataclasses.replace(jumped, position=np.full(3, np.nan))
    assert known.see(no_place).contradicting == 0
