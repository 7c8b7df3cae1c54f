"""When a flight counts as trapped, against motions in closed form."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from keepout.apps.reproduction.flown import first_within, trapped

TIME = np.arange(0.0, 1201.0)
GOAL = np.array([1.0, -2.0, 3.0])
ALONG = np.array([2.0, -1.0, 2.0]) / 3.0


def at(distance) -> np.ndarray:
    """Positions at distances (m) from the goal, in one direction."""
    return GOAL + np.broadcast_to(distance, TIME.shape)[:, None] * ALONG


def unhindered(length: float, distance: float) -> np.ndarray:
    """Distances under dr/dt = −v tanh(r/k): sinh(r/k) falls as exp(−v t/k)."""
    return length * np.arcsinh(np.sinh(distance / length) * np.exp(-0.1 * TIME / length))


@pytest.mark.parametrize(
    ("distance", "rests"),
    [
        *((12.8, True), (0.11, True), (0.09, False), (0.0, False)),
        # Rest takes the last five minutes.
        *((np.where(TIME[-1] - since <= TIME, 6.0, 9.0), since == 300.0) for since in (300.0, 299.0)),
    ],
)
def test_at_rest_is_long_enough_and_away_from_the_goal(distance, rests):
    assert trapped(TIME, at(distance), GOAL, 0.1) is rests


@given(st.floats(0.5, 30.0), st.floats(0.2, 60.0))
def test_nothing_that_is_only_slow_is_trapped(length, distance):
    assert not trapped(TIME, at(unhindered(length, distance)), GOAL, 1e-9)


@given(st.floats(0.2, 30.0), st.floats(0.0, 1.5))
def test_a_chatter_of_less_than_a_twentieth_is_rest_and_a_swing_of_more_is_not(left, share):
    swing = left * (1.0 + 0.05 * share * np.cos(0.1 * TIME))
    swing[-1] = left
    beyond = 0.05 * share * np.abs(np.cos(0.1 * TIME[-301:])).max()
    if abs(beyond - 0.05) > 1e-9:
        assert trapped(TIME, at(swing), GOAL, 0.1) == (beyond < 0.05)


def test_too_short_or_not_a_number_is_not_said_to_rest():
    assert not trapped(TIME[:300], at(6.0)[:300], GOAL, 0.1)
    for broken in (-1, -100):
        path = at(6.0).copy()
        path[broken] = np.nan
        assert not trapped(TIME, path, GOAL, 0.1)


@given(st.floats(0.3, 40.0))
def test_the_first_time_within_the_tolerance(length):
    path = at(unhindered(length, 5.0))
    exact = length / 0.1 * np.log(np.sinh(5.0 / length) / np.sinh(0.1 / length))
    found = first_within(TIME + 7.0, path, GOAL, 0.1)
    if found is None:
        assert exact > TIME[-1] - 1e-6
    else:
        assert exact <= found + 1e-6
        assert found <= exact + 1.0 + 1e-6
