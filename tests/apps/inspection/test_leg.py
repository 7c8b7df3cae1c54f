"""When a view is done with, and what became of what it promised."""

import numpy as np
import pytest

from keepout.apps.inspection.problem import Wanted
from keepout.apps.inspection.seeing.patches import Patches
from keepout.apps.inspection.views_ahead import Leg, Lost
from keepout.apps.led.camera import Boresight

AHEAD = np.array([1.0, 0.0, 0.0])


def wanted(share=1.0):
    """Four units that count, of 1, 2, 3 and 4 m²."""
    n, nowhere, counted = 4, np.zeros((4, 3)), np.tile([True, False], 4)
    areas = np.array([1.0, 2.0, 3.0, 4.0])
    of = Patches(np.zeros((n, 3, 3)), np.full(n, 3), nowhere, areas, nowhere, np.arange(n), counted, 1.0)
    return Wanted(of, counted.copy(), share)


VIEW = {"place": np.zeros(3), "boresight": AHEAD, "units": np.array([0, 2])}
PLACE = {"units": np.zeros(0, int)}


@pytest.mark.parametrize(
    ("options", "frames", "ended"),
    [
        # It is over as soon as all of it was taken, wherever the chaser is.
        ({}, [(5.0, 4.0, 0), (7.0, 4.0, "all")], {6.0: None, 10.0: Lost.NOT}),
        # At its place it goes on while it shows more.
        ({}, [(t, 0.0, int(t == 15.0)) for t in (5.0, 10.0, 15.0, 20.0, 25.0, 30.0)], {15.0: None, 30.0: Lost.NOT}),
        # It is given up where it is not reached; the guard is named where it held the chaser.
        ({}, [], {389.0: None, 391.0: Lost.LATE}),
        ({"held_up": 3}, [], {389.0: None, 391.0: Lost.GUARD}),
        # Before its window it waits, and after it is lost to the light.
        ({"window": (100.0, 200.0)}, [(t, 0.0, 0) for t in np.arange(5.0, 99.0, 5.0)], {95.0: None, 201.0: Lost.LIGHT}),
        # After its window it goes on while it shows more; what of it is lit is asked for again.
        (
            {"window": (0.0, 10.0)},
            [(15.0, 0.0, 1), *((t, 0.0, 0) for t in (20.0, 25.0, 30.0))],
            {15.0: Lost.LIGHT, 30.0: Lost.NOT},
        ),
        # Leaving the place begins the stay again.
        (PLACE | {"stay": 30.0}, [(10.0, 0.0, 0), (20.0, 1.0, 0), (25.0, 0.0, 0)], {45.0: None, 55.0: Lost.NOT}),
        # A hold point is held for its seconds from when it is reached.
        (PLACE | {"boresight": None, "stay": 60.0}, [(30.0, 2.0, 0), (40.0, 0.0, 0)], {99.0: None, 100.0: Lost.NOT}),
    ],
)
def test_when_a_view_is_over_and_why(options, frames, ended):
    """Frames are told by their time, how far from the place they are, and what they show that is new."""
    what, view = wanted(), Leg(**(VIEW | options))
    view.begun(0.0, np.zeros(3), 50.0)
    looking, rows = Boresight.at_rest(AHEAD, greatest_rate=0.02, greatest_acceleration=0.002), list(frames)
    for at, lost in ended.items():
        while rows and rows[0][0] <= at:
            now, away, fresh = rows.pop(0)
            if fresh == "all":
                what.take(np.array([0, 2, 1]))
                fresh = 2
            view.noted(now, np.array([away, 0.0, 0.0]), looking, AHEAD, fresh)
        assert view.ended(at, what) is lost


def test_units_are_given_up_after_two_tours_that_promised_them_in_vain():
    what = wanted()
    assert what.take(np.array([0, 1])) == 1  # unit 1 is not asked for
    what.failed(np.array([0, 2]))
    assert what.left[[0, 2, 4, 6]].tolist() == [False, True, True, True]
    what.failed(np.array([0, 2]))
    assert what.left[[0, 2, 4, 6]].tolist() == [False, False, True, True]
    assert what.reached == pytest.approx(0.1)
    what.take(np.array([2]))  # seen after all
    assert what.reached == pytest.approx(0.3)


def test_enough_is_the_share_of_the_area_that_is_wanted():
    what = wanted(0.7)
    what.take(np.array([2, 4]))
    assert not what.enough
    assert what.share_of_left == pytest.approx((7.0 - 5.0) / 5.0)
    what.take(np.array([0, 4]))
    assert not what.enough
    what.take(np.array([6]))
    assert what.enough
