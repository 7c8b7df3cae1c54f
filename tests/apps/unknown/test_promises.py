"""A sensor that keeps its promises frees no cube of a body and contradicts no map; what breaks them is found out."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from truths.depth_views import Ball, Box, axes_towards, cube_centres, true_ranges, turned

from keepout.apps.led.camera import Pinhole
from keepout.apps.unknown.known_free import KnownFreeMap, ViewStatus, in_free_room
from keepout.apps.unknown.view import SensorBounds, View

CAMERA = Pinhole(60, 45, math.radians(60.0))
BOUNDS = SensorBounds()
SCENES = {
    "ball": (Ball((0.0, 0.1, 0.0), 0.5),),
    "box": (Box((-0.43, -0.31, -0.27), (0.42, 0.33, 0.38)),),
    "plate before a ball": (Box((-0.6, -0.6, 0.5), (0.6, 0.6, 0.58)), Ball((0.0, 0.0, -0.2), 0.45)),
}


def begin(radius=1.05, spacing=0.1, **changes):
    given = {"cap": 4 * spacing, "bounds": BOUNDS, "name": "bodies"} | changes
    return KnownFreeMap.begin(np.zeros(3), radius, spacing=spacing, **given)


def image(bodies, position, generator, *, ranges=1.0, pose=1.0, towards=0.0, at=None, bounds=BOUNDS, camera=CAMERA):
    """An image with errors of ranges and pose at so many times their bounds, each of a random sign and direction.

    A share `towards` has all ranges long and its place told nearer than it is, which reaches deepest into bodies.
    """
    axes = axes_towards((generator.uniform(-0.4, 0.4, 3) if at is None else at) - position, generator.uniform(0.0, 6.0))
    true = true_ranges(bodies, camera, bounds, position, axes)
    signs = generator.choice([-1.0, 1.0]) if generator.random() < 0.5 else generator.choice([-1.0, 1.0], true.shape)
    move, about = generator.normal(size=(2, 3))
    if generator.random() < towards:
        signs, move = 1.0, -position
    return View(
        camera,
        position + pose * bounds.position_error * move / np.linalg.norm(move),
        turned(axes, pose * bounds.attitude_error, about),
        np.maximum(true + ranges * bounds.range_error * signs, 0.0),
    )


def around(generator):
    place = generator.normal(size=3)
    return place * generator.uniform(1.7, 2.6) / np.linalg.norm(place)


def cubes_of_bodies(known, bodies):
    """How many free cubes meet a body, and how many within 0.35 m of one do not."""
    centres = cube_centres(known)
    meets = np.any([body.meets_cubes(centres, known.spacing) for body in bodies], axis=0)
    near = np.any([body.meets_cubes(centres, known.spacing + 0.7) for body in bodies], axis=0)
    return int((known.free & meets).sum()), int((known.free & near & ~meets).sum())


@pytest.mark.long
@pytest.mark.parametrize("scene", SCENES)
@settings(max_examples=settings().max_examples // 5)  # forty images each
@given(
    seed=st.integers(0, 10**6),
    bounds=st.sampled_from([BOUNDS, SensorBounds(rays_across=3, attitude_error=0.02)]),
    spacing=st.sampled_from([0.1, 0.05]),
)
def test_no_free_cube_meets_a_body_and_no_return_contradicts_the_map(scene, seed, bounds, spacing):
    generator = np.random.default_rng(seed)
    known, returns = begin(bounds=bounds, spacing=spacing), 0
    for _ in range(40):
        view = image(SCENES[scene], around(generator), generator, towards=0.5, bounds=bounds)
        report = known.see(view)
        assert (report.status, report.contradicting) == (ViewStatus.SEEN, 0)
        returns += int(np.isfinite(view.ranges).sum())
    bad, near = cubes_of_bodies(known, SCENES[scene])
    assert bad == 0
    assert near > 200 or bounds != BOUNDS  # room close to the bodies was opened, so that the test says something
    assert returns > 3000
    assert known.assumptions_broken == ()


@pytest.mark.long
@pytest.mark.parametrize("broken", [{"ranges": 4.0, "pose": 1.0}, {"ranges": 1.0, "pose": 3.0}])
def test_broken_promises_free_cubes_that_meet_a_body(broken):
    bad = 0
    for bodies in SCENES.values():
        generator, known = np.random.default_rng(1), begin(spacing=0.05)
        for _ in range(40):
            known.open(image(bodies, around(generator), generator, towards=0.7, **broken))  # contradictory or not
        bad += cubes_of_bodies(known, bodies)[0]
    assert bad > 0


@pytest.mark.long
@pytest.mark.parametrize("scene", SCENES)
def test_errors_two_and_a_half_times_their_bounds_are_found_out(scene):
    generator, known = np.random.default_rng(1), begin()
    reports = [known.see(image(SCENES[scene], around(generator), generator, ranges=2.5, pose=2.5)) for _ in range(40)]
    assert known.contradicting == sum(report.contradicting for report in reports) > 0
    assert "returns contradict it" in known.assumptions_broken[0]


def by_brute_force(points, reach, origin, spacing, free):
    """Whether each point is farther than its reach from all cubes that are not free, over all of them."""
    lower = origin + spacing * np.argwhere(~free)
    away = np.maximum(np.maximum(lower - points[:, None], points[:, None] - lower - spacing), 0.0)
    return np.linalg.norm(away, axis=2).min(axis=1) > reach


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


WIRE = Box((-0.0005, -0.0005, -0.9), (0.0005, 0.0005, 0.3))
"""A millimetre thick: from along it no ray meets it, so that room is called free which it crosses."""


def test_a_wire_looked_along_and_then_seen_from_aside_contradicts():
    bodies, generator = (Ball((0.0, 0.0, 0.5), 0.2), WIRE), np.random.default_rng(2)
    known, camera = begin(1.0), Pinhole(160, 120, math.radians(60.0))
    exact = {"ranges": 0.0, "pose": 0.0, "at": np.zeros(3), "camera": camera}
    assert known.see(image(bodies, np.array([0.0, 0.0, -3.0]), generator, **exact)).status is ViewStatus.SEEN
    on_wire = np.linspace([0.0, 0.0, -0.9], [0.0, 0.0, 0.0], 20)
    assert known.is_free(on_wire).any()  # assumption A1 does not hold of it
    before = known.free.copy(), known.returned.keys.copy(), known.views
    aside = image(bodies, np.array([2.0, 0.0, -0.3]), generator, at=np.array([0.0, 0.0, -0.3]), camera=camera)
    report = known.see(aside)
    assert (report.status, report.opened) == (ViewStatus.CONTRADICTED, 0)
    # Truth: the returns that are nearer to the wire's axis than to the ball behind it.
    points = aside.points()
    assert 0 < report.contradicting <= (np.linalg.norm(points[:, :2], axis=1) < 0.2).sum()
    assert all(np.array_equal(one, two) for one, two in zip(before, (known.free, known.returned.keys, known.views)))


def test_a_view_that_is_refused_is_counted_as_well():
    generator, known = np.random.default_rng(3), begin(speed_limit=0.1)
    known.see(image((Ball((0.0, 0.0, 0.0), 0.4),), np.array([0.0, 0.0, -2.0]), generator, at=np.zeros(3)))
    below = np.array([0.0, 0.0, -0.8])
    jumped = image((Ball(tuple(below), 0.1),), below + np.array([0.0, 2.0, 0.0]), generator, at=below)
    report = known.see(jumped)
    assert report.status is ViewStatus.POSE_JUMP
    assert report.contradicting == known.contradicting > 0
    no_place = dataclasses.replace(jumped, position=np.full(3, np.nan))
    assert known.see(no_place).contradicting == 0
