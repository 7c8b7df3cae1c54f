"""Quantile bands: within the error that they state of exact quantiles, and the same in whatever pieces counted."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from keepout.flights.campaign.bands import LEAST, QUANTITIES, RELATIVE, Bands

SHARES = (0.0, 0.05, 0.5, 0.95, 1.0)
GOAL = np.array([1.0, -2.0, 3.0])


def flights(count, rows, seed):
    rng = np.random.default_rng(seed)
    sizes = np.exp(rng.uniform(np.log(1e-8), np.log(1e4), (count, rows)))
    return {
        "barrier": sizes * rng.choice([-1.0, 1.0], (count, rows)),
        "lyapunov": sizes**2,
        "position": rng.normal(size=(count, rows, 3)) * sizes[:, :, None],
        "velocity": rng.normal(size=(count, rows, 3)) * 0.1,
    }


def counted(log, goal=GOAL, duration=40.0, period=1.0):
    bands = Bands.empty(duration, period)
    bands.count(log, np.broadcast_to(goal, (len(log["barrier"]), 3)), period)
    return bands


@given(count=st.integers(1, 60), seed=st.integers(0, 2**32 - 1))
def test_quantiles_are_within_what_is_stated(count, seed):
    log = flights(count, 41, seed)
    bands = counted(log)
    exact = {
        "barrier": log["barrier"],
        "lyapunov": log["lyapunov"],
        "position_error": np.linalg.norm(log["position"] - GOAL, axis=-1),
        "speed": np.linalg.norm(log["velocity"], axis=-1),
    }
    for name in QUANTITIES:
        ordered = np.sort(exact[name], axis=0)
        ranks = [max(int(np.ceil(share * count)), 1) - 1 for share in SHARES]
        true, found = ordered[ranks], bands.quantiles(name, SHARES)
        assert (np.abs(found - true) <= np.maximum(RELATIVE * np.abs(true) * (1.0 + 1e-9), LEAST)).all()
        np.testing.assert_array_equal(found[[0, -1]], ordered[[0, -1]])


@pytest.mark.long
@given(count=st.integers(2, 40), cut=st.integers(1, 39), seed=st.integers(0, 1000))
def test_pieces_add_up_to_the_whole_to_the_bit_in_any_order(count, cut, seed):
    log, cut = flights(count, 41, seed), min(cut, count - 1)
    whole = counted(log).to_bytes()
    one, other = ({name: part[where] for name, part in log.items()} for where in (slice(cut), slice(cut, None)))
    for first, second in ((one, other), (other, one)):
        summed = Bands.empty(40.0, 1.0)
        for part in (first, second):
            summed.add_bytes(counted(part).to_bytes())
        for name, array in vars(counted(log)).items():
            np.testing.assert_array_equal(getattr(summed, name), array)
        assert summed.to_bytes() == whole


def test_what_is_not_a_number_is_counted_apart_and_a_flight_that_ended_is_not_counted():
    log = flights(10, 41, 0)
    log["barrier"][3, 20] = np.nan
    bands = counted({name: part[:, :31] for name, part in log.items()})
    assert bands.lost[0].sum() == 1
    assert bands.counts[0, :31].sum(axis=1).tolist() == [10 - (row == 20) for row in range(31)]
    assert np.isnan(bands.quantiles("barrier", [0.5])[0, 31:]).all()
