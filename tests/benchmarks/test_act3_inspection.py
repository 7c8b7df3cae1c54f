"""The public inspection task of act3: its numbers, a few flights of it, and what it costs to be wrong."""

import act3_inspection
import act3_task
import pytest

CODE = act3_task.TASKS["code"]


@pytest.mark.slow
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
