"""When a view is done with, and what became of what it promised."""

import numpy as np
import pytest

from keepout.inspecting.leg import Leg, Lost
from keepout.inspecting.plan import InspectionPlan, PlannedView
from keepout.inspecting.wanted import Wanted
from keepout.mission.inspection_entries import HoldPointEntry
from keepout.seeing.patches import Patches
from keepout.sensing.depth.pointing import Boresight

AHEAD = np.array([1.0, 0.0, 0.0])


def patches(areas=(1.0, 2.0, 3.0, 4.0)):
    n = len(areas)
    counted = np.tile([True, False], n)
    return Patches(
        np.zeros((n, 3, 3)),
        np.full(n, 3),
        np.zeros((n, 3)),
        np.array(areas),
        np.zeros((n, 3)),
        np.arange(n),
        counted,
        1.0,
    )


def wanted(share=1.0):
    of = patches()
    return Wanted.of(of, of.counted.copy(), share)


def looking(direction=AHEAD):
    return Boresight.at_rest(direction, greatest_rate=0.02, greatest_acceleration=0.002)


def leg(**changes):
    made = Leg(**({"place": np.zeros(3), "boresight": AHEAD, "units": np.array([0, 2])} | changes))
    made.begun(0.0, np.zeros(3), 50.0)
    return made


def frame(of, now, what, *, away=0.0, fresh=0):
    of.noted(now, np.array([away, 0.0, 0.0]), looking(), AHEAD, what, fresh)


def test_a_view_is_over_as_soon_as_all_of_it_was_taken_wherever_the_chaser_is():
    what, view = wanted(), leg()
    frame(view, 5.0, what, away=4.0)
    assert view.ended(5.0, what) is None
    what.take(np.array([0, 2, 1]))
    assert view.ended(10.0, what) is Lost.NOT


def test_at_its_place_a_view_that_shows_no_more_is_over_and_one_that_does_goes_on():
    what, view = wanted(), leg()
    for now in (5.0, 10.0):
        frame(view, now, what)
        assert view.ended(now, what) is None
    frame(view, 15.0, what, fresh=1)
    assert view.ended(15.0, what) is None
    for now in (20.0, 25.0, 30.0):
        frame(view, now, what)
    assert view.ended(30.0, what) is Lost.NOT


def test_a_view_that_is_not_reached_is_given_up_and_the_guard_is_named_where_it_held_the_chaser():
    what, view = wanted(), leg()
    assert view.ended(389.0, what) is None
    assert view.ended(391.0, what) is Lost.LATE
    view.held_up = 3
    assert view.ended(391.0, what) is Lost.GUARD


def test_before_its_window_a_view_waits_and_after_it_is_lost_to_the_light():
    what, view = wanted(), leg(window=(100.0, 200.0))
    for now in np.arange(5.0, 100.0, 5.0):
        frame(view, now, what)
        assert view.ended(now, what) is None
    assert view.ended(201.0, what) is Lost.LIGHT


def test_at_its_place_after_its_window_a_view_goes_on_while_it_shows_more():
    what, view = wanted(), leg(window=(0.0, 10.0))
    frame(view, 15.0, what, fresh=1)
    assert view.ended(15.0, what) is Lost.LIGHT  # what of it is lit is asked for again
    for now in (20.0, 25.0, 30.0):
        frame(view, now, what)
    assert view.ended(30.0, what) is Lost.NOT


def test_a_hold_point_is_held_for_its_seconds_from_when_it_is_reached():
    what = wanted()
    (view,) = Leg.holds([HoldPointEntry(position=(1.0, 0.0, 0.0), seconds=60.0)], 0.1)
    view.begun(0.0, np.zeros(3), 10.0)
    frame(view, 30.0, what, away=2.0)
    frame(view, 40.0, what)
    assert view.ended(99.0, what) is None
    assert view.ended(100.0, what) is Lost.NOT


def test_leaving_the_place_begins_the_stay_again():
    what, view = wanted(), leg(stay=30.0, units=np.zeros(0, int))
    frame(view, 10.0, what)
    frame(view, 20.0, what, away=1.0)
    frame(view, 25.0, what)
    assert view.ended(45.0, what) is None
    assert view.ended(55.0, what) is Lost.NOT


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


def test_a_plans_views_stay_as_long_as_the_longer_of_both():
    view = PlannedView(np.zeros(3), AHEAD, np.array([0]), dwell=4.0)
    plan = InspectionPlan((view,), np.ones(8, bool), 1.0, 10.0, 1, 1, 1)
    assert [one.stay for one in Leg.views(plan, 2.0)] == [4.0]
    assert [one.stay for one in Leg.views(plan, 9.0)] == [9.0]
