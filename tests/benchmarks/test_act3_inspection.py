"""The public inspection task of act3: its numbers, a few flights of it, and what it costs to be wrong."""

import act3_inspection
import act3_plan
import act3_task
import numpy as np
import pytest

from keepout.inspecting.hill import VVLH_FROM_RTN

CODE = act3_task.TASKS["code"]


def test_a_hundred_points_asked_make_ninety_nine_on_the_ball():
    points = act3_task.directions_of_points()
    assert points.shape == (99, 3)
    assert np.allclose(np.linalg.norm(points, axis=1), 1.0)
    closest = np.arccos(np.clip(np.max(points @ points.T - 2.0 * np.eye(99), axis=1), -1.0, 1.0))
    assert closest.min() > 0.28
    assert closest.max() < 0.37


@pytest.mark.parametrize("name", act3_task.TASKS)
def test_starts_lie_where_the_task_says(name):
    task = act3_task.TASKS[name]
    starts = [act3_task.start(task, seed) for seed in range(200)]
    distances = np.linalg.norm([one[0] for one in starts], axis=1)
    speeds = np.linalg.norm([one[1] for one in starts], axis=1)
    most = 0.8 * 2.0 * act3_task.MEAN_MOTION * distances if task.by_distance else 0.8
    assert np.all((distances >= 50.0) & (distances <= 100.0))
    assert np.all(speeds <= most)
    assert speeds.max() > 0.9 * np.max(most)
    assert np.array_equal(act3_task.start(task, 7)[0], starts[7][0])


def test_a_point_is_seen_where_a_line_to_deputy_and_sun_meets_no_ball():
    """Against the definition: does the segment from just above the point meet the ball?"""
    points, radius = act3_task.directions_of_points(), 10.0
    generator = np.random.default_rng(3)
    for _ in range(50):
        place, sun = generator.normal(size=(2, 3))
        place *= generator.uniform(15.0, 100.0) / np.linalg.norm(place)
        sun /= np.linalg.norm(sun)
        told = act3_task.steps_until_seen(place[None], sun[None], points, radius, 0.0, 0.0) == 0
        for point, answer in zip(points, told, strict=True):
            along = (place - radius * point) @ point, sun @ point
            if min(abs(along[0]), 100.0 * abs(along[1])) > 1e-6:
                assert answer == (along[0] > 0.0 and along[1] > 0.0)


def test_the_sun_goes_round_once_an_orbit_in_its_plane():
    suns = act3_task.sun_directions(0.3) @ VVLH_FROM_RTN
    assert np.allclose(suns[:, 2], 0.0)
    assert np.allclose(suns[0], [np.cos(0.3), -np.sin(0.3), 0.0])
    quarter = round(0.5 * np.pi / act3_task.MEAN_MOTION / act3_task.PERIOD)
    assert np.allclose(suns[quarter], [-np.sin(0.3), -np.cos(0.3), 0.0], atol=0.01)


def test_a_few_seeds_see_all_points_and_keep_off():
    row = act3_inspection.row(CODE, 6)
    assert row["success"] == 6
    assert row["least_seen"] == 99
    assert row["crashes"] == row["too_far"] == 0
    assert row["certified_starts"] == 6
    assert row["least_distance_m"] > 15.0
    assert 0.0 < row["delta_v_mps"] <= row["delta_v_axes_mps"] < 1.0
    assert row["time_s"] <= act3_task.LONGEST


def test_without_a_burn_most_seeds_fail(monkeypatch):
    monkeypatch.setattr(act3_plan.Search, "find", lambda self, *start: None)
    row = act3_inspection.row(CODE, 6)
    assert row["success"] < 6
    assert row["least_seen"] < 99


def test_the_guard_keeps_the_crash_sphere_from_a_law_that_dives(monkeypatch):
    """Two minutes of full thrust towards the chief from every start: nothing but the guard keeps them off."""
    monkeypatch.setattr(
        act3_plan.Search, "find", lambda self, position, velocity, sun: (-position / np.linalg.norm(position), 12)
    )
    found, _ = act3_inspection.fly(CODE, range(4))
    assert np.all(found["guard_interventions"] > 0)
    assert np.all(found["least_distance_m"] > CODE.crash - 2.0)


def test_the_bound_between_samples_holds_for_a_finer_flight():
    positions = np.array([[[20.0, -30.0, 0.0], [20.0, 30.0, 0.0]]])
    forces = np.zeros((1, 2, 3))
    assert act3_inspection.least_distances(positions, forces, 0.0) == pytest.approx([20.0])
    assert act3_inspection.least_distances(positions, forces, 0.01) == pytest.approx([20.0 - 0.125])
