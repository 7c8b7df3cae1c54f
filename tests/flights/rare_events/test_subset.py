"""Subset simulation against probabilities known in closed form or by quadrature."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import stats

from keepout.core.errors import ScenarioError
from keepout.flights.rare_events.subset import Question, Simulation, band, curve, estimate, interval, simulate


def linear(tapes):
    """Minus a standard normal that every number of the tape has a part in."""
    return -tapes.sum(axis=1) / math.sqrt(tapes.shape[1])


RARE = float(-stats.norm.isf(1e-7))


def test_a_half_space_of_probability_1e_7():
    found = [simulate(linear, 50, Question(below=RARE, seed=seed)) for seed in range(3)]
    means = [estimate(one, RARE).mean for one in found]
    assert np.mean(means) == pytest.approx(1e-7, rel=0.2)
    assert all(one.ended == "reached" for one in found)
    assert all(one.evaluations <= 60_000 for one in found)
    assert sum(estimate(one, RARE).lower <= 1e-7 <= estimate(one, RARE).upper for one in found) >= 2
    assert all(0.2 < level.acceptance < 0.45 for one in found for level in one.levels[1:])


@pytest.mark.long
def test_many_short_simulations_have_no_bias():
    # 64 tapes a level are few: a share counted without the whole clump of a refused move, or thresholds of one run
    # alone, show here as tens of percent.
    below, probability = -stats.norm.isf(1e-4), 1e-4
    runs = np.array(
        [simulate(linear, 10, Question(below=below, tapes=128, seed=seed)).below(below) for seed in range(160)]
    )
    error = np.std(runs.mean(axis=1)) / math.sqrt(len(runs)) / probability
    assert error < 0.04
    assert np.mean(runs) / probability - 1.0 == pytest.approx(0.0, abs=3.0 * error + 0.05)


@given(arrays(float, (6, 8), elements=st.sampled_from([1e-6, 1e-4, 1e-3, 1e-2, 0.1])))
def test_the_band_rises_with_its_number_whatever_the_runs_found(runs):
    runs = np.sort(runs, axis=0)  # each run's own probability rises
    found = band(np.arange(6.0).tolist(), list(runs))
    assert (np.diff(found, axis=0) >= 0.0).all()
    assert ((found[:, 2] <= found[:, 1]) & (found[:, 1] <= found[:, 3])).all()
    # No end of it says less than the number's own interval at the same confidence.
    alone = np.array([interval(of, 1.0 - 0.05 / 6) for of in runs])
    assert ((found[:, 2] >= alone[:, 1]) & (found[:, 3] <= alone[:, 2])).all()


@pytest.mark.long
def test_the_band_covers_the_whole_curve_at_once():
    """Two ways to the event, one of them rarer: the truth is a closed form, the numbers' own intervals miss it."""

    def performance(tapes):
        return np.minimum(linear(tapes[:, :5]), 0.7 * tapes[:, 5] - 1.0)

    covered, alone = 0, 0
    for seed in range(100):
        found = simulate(performance, 6, Question(below=-3.7, tapes=64, seed=seed))
        number, _, lower, upper = curve(found).T
        truth = 1.0 - stats.norm.sf(number) * stats.norm.sf((number + 1.0) / 0.7)
        covered += bool(((lower <= truth) & (truth <= upper)).all())
        ends = np.array([interval(found.below(one)) for one in number])
        alone += bool(((ends[:, 1] <= truth) & (truth <= ends[:, 2])).all())
    # 89 of 100 and fewer have a chance of 1 % where the cover is 0.95.
    assert covered >= 90
    assert alone <= 75


def test_a_value_that_most_tapes_share():
    # 84 % of all tapes have the performance 2, as flights that come nowhere nearer than their start do.
    found = simulate(lambda tapes: np.minimum(linear(tapes) + 1.0, 0.0) + 2.0, 5, Question(below=-1.0, seed=2))
    truth = stats.norm.cdf(-4.0)
    result = estimate(found, -1.0)
    assert found.ended == "reached"
    assert result.mean == pytest.approx(truth, rel=0.3)
    assert result.lower <= truth <= result.upper


def test_what_never_happens_is_said_to_be_below_a_bound():
    found = simulate(lambda tapes: np.ones(len(tapes)), 5, Question(below=0.0))
    result = estimate(found, 0.0)
    assert found.ended == "stuck"
    assert result.bounded_only
    assert result.summary() == {
        "probability": None,
        "interval": None,
        "below": pytest.approx(-math.log(0.025) / 8192, rel=0.01),
    }


def test_a_number_out_of_reach_is_bounded_by_the_last_level():
    found = simulate(linear, 5, Question(below=-12.0, most_levels=7))
    result = estimate(found, -12.0)
    assert (found.ended, result.bounded_only, len(found.levels)) == ("levels", True, 7)
    # Far less than what none in the 8192 independent tapes of the first level allows, 4.5e-4.
    assert stats.norm.cdf(found.levels[-1].threshold) < result.upper < 3 * 8.0**-6


def test_a_simulation_stopped_in_the_middle_goes_on_bit_for_bit(tmp_path):
    whole, state, calls = simulate(linear, 12, Question(below=RARE, tapes=256, seed=4)), tmp_path / "state.npz", []

    def stopped(tapes):
        calls.append(1)
        if len(calls) == 25:
            raise KeyboardInterrupt
        return linear(tapes)

    with pytest.raises(KeyboardInterrupt):
        simulate(stopped, 12, Question(below=RARE, tapes=256, seed=4), state=state)
    half = Simulation.load(state)
    assert 1 < len(half.levels) < len(whole.levels)
    resumed = simulate(linear, 12, Question(below=RARE, tapes=256, seed=4), state=state)
    assert len(resumed.levels) == len(whole.levels)
    for one, other in zip(resumed.levels, whole.levels):
        assert np.array_equal(one.values, other.values)
        assert np.array_equal(one.probability, other.probability)
        assert (one.threshold, one.acceptance, one.step) == (other.threshold, other.acceptance, other.step)
    assert np.array_equal(resumed.lowest, whole.lowest)
    assert np.array_equal(resumed.below(RARE), whole.below(RARE))
    assert Simulation.load(state).below(RARE).tolist() == whole.below(RARE).tolist()


@pytest.mark.parametrize("content", [b"PK\x03\x04 no archive", None])
def test_a_damaged_state_is_refused_in_one_line(tmp_path, content):
    state = tmp_path / "state.npz"
    simulate(linear, 3, Question(below=-1.0, tapes=64)).save(state)
    whole = state.read_bytes()
    state.write_bytes(whole[: len(whole) // 2] if content is None else content)
    with pytest.raises(ScenarioError, match=r"state\.npz: .*remove it") as refusal:
        Simulation.load(state)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({"below": math.nan}, "below: nan"),
        ({"runs": 1}, "runs: 1"),
        ({"tapes": 100}, "flights: 100"),
        ({"tapes": 8}, "flights: 8"),
        ({"seed": -1}, "seed: -1"),
        ({"most_levels": 0}, "most_levels: 0"),
    ],
)
def test_bad_numbers_are_refused(changed, named):
    with pytest.raises(ScenarioError, match=named):
        Question(**({"below": -1.0} | changed))


@pytest.mark.parametrize(
    ("performance", "named"),
    [(lambda tapes: np.full(len(tapes), np.nan), "gave no number"), (lambda tapes: tapes, "shape")],
)
def test_a_performance_that_is_no_number_is_refused(performance, named):
    with pytest.raises(ScenarioError, match=named):
        simulate(performance, 3, Question(-1.0))
