"""No cube that meets a body is ever freed while the sensor keeps its promises, whatever it does within them."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from truths.depth_views import Ball, Box, axes_towards, cube_centres, view_of

from keepout.mapping import KnownFreeMap, Pinhole, SensorBounds, ViewStatus

CAMERA = Pinhole(60, 45, math.radians(60.0))
BOUNDS = SensorBounds()
SCENES = {
    "ball": (Ball((0.0, 0.1, 0.0), 0.5),),
    "box": (Box((-0.43, -0.31, -0.27), (0.42, 0.33, 0.38)),),
    "plate before a ball": (Box((-0.6, -0.6, 0.5), (0.6, 0.6, 0.58)), Ball((0.0, 0.0, -0.2), 0.45)),
}


def bad_cubes(scene, seed, *, views=40, range_times=1.0, pose_times=1.0, spacing=0.1, towards=0.7):
    """Cubes free that meet a body after adversarial views, and cubes free within 0.35 m of one that do not."""
    bodies, generator = SCENES[scene], np.random.default_rng(seed)
    known = KnownFreeMap.begin(np.zeros(3), 1.05, spacing=spacing, cap=3 * spacing, bounds=BOUNDS, name=scene)
    for _ in range(views):
        position = generator.normal(size=3)
        position *= generator.uniform(1.7, 2.6) / np.linalg.norm(position)
        axes = axes_towards(generator.uniform(-0.4, 0.4, 3) - position, generator.uniform(0.0, 6.0))
        # Places estimated nearer to the target than they are make ranges reach too deep; others come as well.
        ahead = -position / np.linalg.norm(position)
        move = ahead if generator.random() < towards else generator.normal(size=3)
        view = view_of(
            bodies,
            CAMERA,
            BOUNDS,
            position,
            axes,
            range_error=range_times * BOUNDS.range_error,
            move=pose_times * BOUNDS.position_error * move / np.linalg.norm(move),
            turn=pose_times * BOUNDS.attitude_error,
            about=generator.normal(size=3),
        )
        if range_times == pose_times == 1.0:
            assert known.see(view).status is ViewStatus.SEEN
        else:
            known.open(view)  # whether or not its returns contradict the map
    centres = cube_centres(known)
    meets = np.any([body.meets_cubes(centres, spacing) for body in bodies], axis=0)
    near = np.any([body.meets_cubes(centres, spacing + 0.7) for body in bodies], axis=0)
    return int((known.free & meets).sum()), int((known.free & near & ~meets).sum())


@pytest.mark.parametrize("scene", SCENES)
@settings(max_examples=4)
@given(seed=st.integers(0, 10**6))
def test_no_free_cube_meets_a_body(scene, seed):
    bad, near = bad_cubes(scene, seed)
    assert bad == 0
    assert near > 200  # room close to the bodies was opened, so that the test says something


@pytest.mark.long
@pytest.mark.parametrize("scene", SCENES)
def test_nor_do_small_cubes(scene):
    assert bad_cubes(scene, 0, views=60, spacing=0.05)[0] == 0


@pytest.mark.parametrize("broken", [{"range_times": 4.0}, {"pose_times": 3.0}])
def test_broken_promises_free_cubes_that_meet_a_body(broken):
    assert sum(bad_cubes(scene, 1, spacing=0.05, **broken)[0] for scene in SCENES) > 0
