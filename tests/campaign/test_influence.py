"""Rank correlations against scipy's own, and against dependences known in advance."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from keepout.campaign.influence import (
    GROUPS,
    Factor,
    average_ranks,
    correlation_interval,
    holm,
    influence,
    rank_correlation,
    rank_ratio,
    ranked,
)

few = st.lists(st.tuples(st.integers(0, 9), st.integers(0, 9)), min_size=3, max_size=60)


def of(values, figure, levels=None):
    return influence(ranked(Factor("a", np.asarray(values), levels)), "b", stats.rankdata(figure))


@given(few)
def test_spearman_is_scipys(pairs):
    a, b = np.array(pairs, float).T
    rho, p = rank_correlation(stats.rankdata(a), stats.rankdata(b))
    if len(set(a)) == 1 or len(set(b)) == 1:
        assert rho is None
        return
    truth = stats.spearmanr(a, b)
    assert rho == pytest.approx(truth.statistic, abs=1e-12)
    assert p == pytest.approx(truth.pvalue, rel=1e-6, abs=1e-12)


@given(st.lists(st.floats(-1e300, 1e300) | st.sampled_from([0.0, -0.0, 1.0]), max_size=40))
def test_ranks_are_scipys(values):
    ranks = average_ranks(np.array(values, float))
    assert ranks.tobytes() == stats.rankdata(np.array(values, float)).tobytes()


@given(few)
def test_kruskal_and_wallis_is_scipys(pairs):
    groups, values = np.array(pairs).T
    ratio, p = rank_ratio(groups, stats.rankdata(values))
    parts = [values[groups == g] for g in np.unique(groups)]
    if len(parts) < 2 or len(set(values)) == 1 or len(values) <= len(parts):
        assert ratio is None
        return
    truth = stats.kruskal(*parts)
    assert p == pytest.approx(truth.pvalue, rel=1e-9, abs=1e-300)
    epsilon = (truth.statistic - len(parts) + 1) / (len(values) - len(parts))
    # Squares: a root makes 1e-8 of a zero's rounding.
    assert ratio**2 == pytest.approx(max(epsilon, 0.0), rel=1e-9, abs=1e-12)


def test_the_interval_of_rho_covers():
    # Of a bivariate normal with correlation r, Spearman's rho is 6/pi asin(r/2).
    generator, r, n = np.random.default_rng(3), 0.6, 60
    truth = 6.0 / np.pi * np.arcsin(r / 2.0)
    held = 0
    for _ in range(2000):
        x = generator.standard_normal(n)
        y = r * x + np.sqrt(1.0 - r**2) * generator.standard_normal(n)
        rho, _ = rank_correlation(stats.rankdata(x), stats.rankdata(y))
        low, high = correlation_interval(rho, n)
        held += low <= truth <= high
    assert 0.93 <= held / 2000 <= 0.97


def test_what_goes_up_and_down_again_is_found():
    x = np.random.default_rng(0).uniform(-1.0, 1.0, 5000)
    found = of(x, x**2)
    assert abs(found.correlation) < 0.05
    assert found.ratio > 0.9
    assert found.p_groups < 1e-100


def test_what_does_not_matter_stays_near_nothing():
    generator = np.random.default_rng(0)
    small = [of(generator.random(200), generator.random(200)) for _ in range(400)]
    assert np.mean([found.p_value < 0.05 for found in small]) == pytest.approx(0.05, abs=0.035)
    assert np.mean([found.ratio**2 for found in small]) < 1.0 / 200 * GROUPS


def test_a_choice_that_decides_all_has_eta_one():
    found = of([0, 0, 1, 1, 2, 2] * 50, [1.0, 1.0, 5.0, 5.0, 3.0, 3.0] * 50, levels=("p", "q", "r"))
    assert found.correlation is None
    assert found.ratio == pytest.approx(1.0)


@pytest.mark.parametrize("n", [0, 1, 2, 3])
def test_few_runs_say_nothing_false(n):
    found = of(np.arange(float(n)), np.arange(float(n)))
    assert found.ratio is None
    assert (found.low is None) or n >= 4


def test_holm_by_hand():
    # Holm's procedure on four p-values: 4 p1, 3 p2, 2 p3, p4, never falling.
    assert holm([0.03, None, 0.01, 0.04, 0.005]) == pytest.approx([0.06, None, 0.03, 0.06, 0.02], nan_ok=True)
