"""The public inspection task of act3: its numbers, a few flights of it, and what it costs to be wrong."""

import act3_inspection
import act3_task
import numpy as np
import pytest

CODE = act3_task.TASKS["code"]


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


@pytest.mark.long
def test_a_few_seeds_see_all_points_and_keep_off():
    row = act3_inspection.row(CODE, 6)
    assert row["success"] == 6
    assert row["least_seen"] == 99
    assert row["crashes"] == row["too_far"] == 0
    assert row["certified_starts"] == 6
    assert row["least_distance_m"] > 15.0
    assert 0.0 < row["delta_v_mps"] <= row["delta_v_axes_mps"] < 1.0
    assert row["time_s"] <= act3_task.LONGEST


def test_the_bound_between_samples_holds_for_a_finer_flight():
    positions = np.array([[[20.0, -30.0, 0.0], [20.0, 30.0, 0.0]]])
    forces = np.zeros((1, 2, 3))
    assert act3_inspection.least_distances(positions, forces, 0.0) == pytest.approx([20.0])
    assert act3_inspection.least_distances(positions, forces, 0.01) == pytest.approx([20.0 - 0.125])
