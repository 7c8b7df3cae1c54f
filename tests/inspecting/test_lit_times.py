"""When units are lit: at a window's ends and between the times looked at."""

import numpy as np
import pytest

from keepout.inspecting.lit_times import LitTimes

TIMES = LitTimes(np.array([0.0, 10.0, 20.0, 30.0]), np.array([[0, 1], [1, 1], [1, 0], [0, 1]], dtype=bool), True)


@pytest.mark.parametrize(
    ("time", "lit"),
    [
        (0.0, [0, 1]),
        (5.0, [0, 1]),
        (10.0 - 1e-9, [1, 1]),  # a window begins, and the first unit counts at once
        (10.0, [1, 1]),
        (15.0, [1, 0]),
        (20.0, [1, 0]),
        (25.0, [0, 0]),
        (30.0, [0, 1]),
        (31.0, [0, 0]),
        (-1.0, [0, 0]),
    ],
)
def test_what_is_lit_at_a_time(time, lit):
    assert TIMES.at(time).tolist() == [bool(one) for one in lit]


def test_a_light_that_does_not_change_is_the_same_at_every_time():
    still = LitTimes(np.array([0.0]), np.array([[True, False]]), False)
    assert still.at(1e5).tolist() == [True, False]
