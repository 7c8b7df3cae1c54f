"""Intervals against published values and by their coverage, and which draws matter, where that is known."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from keepout.flights.campaign import statistics as intervals
from keepout.flights.campaign.statistics import Factor, correlation_interval, holm, influence


@given(st.integers(1, 5000), st.data())
def test_ends_of_a_rates_interval_solve_the_binomial_tails(n, data):
    k = data.draw(st.integers(0, n))
    low, high = intervals.clopper_pearson(k, n)
    assert 0.0 <= low <= k / n <= high <= 1.0
    if k > 0:
        assert stats.binom.sf(k - 1, n, low) == pytest.approx(0.025, rel=1e-6)
    if k < n:
        assert stats.binom.cdf(k, n, high) == pytest.approx(0.025, rel=1e-6)
    assert (1.0 - intervals.none_seen_bound(n)) ** n == pytest.approx(0.05)  # what it means


@pytest.mark.parametrize(
    ("found", "low", "high"),
    [
        # Newcombe, Statistics in Medicine 17 (1998): of one rate pp. 857-872, table I, method 5; of two pp. 873-890,
        # table II, method 10; of pairs pp. 2635-2650, method 10.
        (intervals.clopper_pearson(81, 263), 0.2527, 0.3676),
        (intervals.clopper_pearson(1, 29), 0.0009, 0.1776),
        (intervals.newcombe((56, 70), (48, 80)), 0.0524, 0.3339),
        (intervals.newcombe((9, 10), (3, 10)), 0.1705, 0.8090),
        (intervals.newcombe_paired(36, 12, 2, 0), 0.0569, 0.3404),
        (intervals.newcombe_paired(18, 12, 2, 18), 0.0562, 0.3290),
        (intervals.newcombe_paired(53, 0, 0, 1), -0.0729, 0.0729),
        (intervals.newcombe_paired(0, 30, 0, 0), 0.8395, 1.0),
        # Without runs nothing is known.
        (intervals.clopper_pearson(0, 0), 0.0, 1.0),
        (intervals.newcombe((0, 0), (1, 2)), -1.0, 1.0),
        (intervals.newcombe_paired(0, 0, 0, 0), -1.0, 1.0),
    ],
)
def test_published_intervals(found, low, high):
    assert found == pytest.approx((low, high), abs=1e-4)


def test_exact_p_values_by_counting():
    assert intervals.fisher((3, 4), (1, 4)) == pytest.approx(34.0 / 70.0)  # the lady tasting tea
    assert intervals.mcnemar(1, 7) == pytest.approx(2.0 * sum(math.comb(8, k) for k in range(2)) / 2**8)
    assert intervals.mcnemar(0, 0) == 1.0


@pytest.mark.parametrize(("n", "share"), [(10, 0.5), (59, 0.05), (200, 0.95)])
def test_a_quantiles_interval_covers_by_brute_force(n, share):
    draws = np.sort(np.random.default_rng(n).random((1000, n)), axis=1)  # uniform: the quantile is the share
    held = [low <= share <= high for low, high in (intervals.quantile_interval(row, share) for row in draws)]
    assert np.mean(held) >= 0.95 - 3.0 * math.sqrt(0.05 * 0.95 / 1000)


def test_intervals_of_a_difference_of_medians_and_of_a_rank_correlation_cover_by_brute_force():
    generator, r, n = np.random.default_rng(1), 0.6, 60
    medians = correlations = 0
    for _ in range(500):
        a, b = np.sort(generator.exponential(1.0, 80)), np.sort(generator.exponential(2.0, 120))
        sides = [(float(np.median(x)), intervals.quantile_interval(x, 0.5)) for x in (a, b)]
        low, high = intervals.difference(*zip(*sides))
        medians += low <= -math.log(2.0) <= high  # medians log 2 and 2 log 2
        x = generator.standard_normal(n)
        y = r * x + np.sqrt(1.0 - r**2) * generator.standard_normal(n)
        low, high = correlation_interval(stats.spearmanr(x, y).statistic, n)
        # Of a bivariate normal with correlation r, Spearman's rho is 6/pi asin(r/2).
        correlations += low <= 6.0 / np.pi * np.arcsin(r / 2.0) <= high
    assert medians >= 0.93 * 500
    assert 0.92 <= correlations / 500 <= 0.98


def of(values, figure, levels=None):
    return influence(Factor("a", np.asarray(values), levels), "b", np.asarray(figure))


def test_what_goes_up_and_down_again_is_found_and_what_does_not_matter_is_not():
    generator = np.random.default_rng(0)
    x = generator.uniform(-1.0, 1.0, 5000)
    found = of(x, x**2)
    assert abs(found.correlation) < 0.05
    assert found.ratio > 0.9
    assert found.p_groups < 1e-100
    small = [of(generator.random(200), generator.random(200)) for _ in range(200)]
    assert np.mean([one.p_value < 0.05 for one in small]) == pytest.approx(0.05, abs=0.045)
    assert np.mean([one.ratio**2 for one in small]) < 0.05


def test_holm_by_hand():
    # Holm's procedure on four p-values: 4 p1, 3 p2, 2 p3, p4, never falling.
    assert holm([0.03, None, 0.01, 0.04, 0.005]) == pytest.approx([0.06, None, 0.03, 0.06, 0.02], nan_ok=True)
