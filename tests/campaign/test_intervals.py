"""Intervals and exact tests against closed forms, published values and brute force."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from keepout.campaign import intervals


@pytest.mark.parametrize("n", [1, 10, 100, 12345])
def test_none_of_n_has_its_closed_form(n):
    low, high = intervals.clopper_pearson(0, n)
    assert low == 0.0
    assert high == pytest.approx(1.0 - 0.025 ** (1.0 / n), rel=1e-9)
    assert intervals.clopper_pearson(n, n) == pytest.approx((1.0 - high, 1.0), rel=1e-9)


def test_the_rule_of_three():
    for n in (100, 1000, 100_000):
        bound = intervals.none_seen_bound(n)
        assert bound == pytest.approx(3.0 / n, rel=0.02)
        assert (1.0 - bound) ** n == pytest.approx(0.05)  # what it means


def test_published_clopper_pearson_interval():
    # 81 of 263, Newcombe, Statistics in Medicine 17 (1998), pp. 857-872, table I, method 5; and 15 of 148, 1 of 29.
    assert intervals.clopper_pearson(81, 263) == pytest.approx((0.2527, 0.3676), abs=5e-5)
    assert intervals.clopper_pearson(15, 148) == pytest.approx((0.0578, 0.1617), abs=5e-5)
    assert intervals.clopper_pearson(1, 29) == pytest.approx((0.0009, 0.1776), abs=5e-5)


@pytest.mark.parametrize("n", [1, 7, 40])
def test_covers_at_every_probability(n):
    found = [intervals.clopper_pearson(k, n) for k in range(n + 1)]
    low, high = np.array(found).T
    for p in np.linspace(0.0, 1.0, 2001):
        assert stats.binom.pmf(np.arange(n + 1), n, p)[(low <= p) & (p <= high)].sum() >= 0.95 - 1e-12


@given(st.integers(1, 5000), st.data())
def test_ends_solve_the_binomial_tails(n, data):
    k = data.draw(st.integers(0, n))
    low, high = intervals.clopper_pearson(k, n)
    assert 0.0 <= low <= k / n <= high <= 1.0
    if k > 0:
        assert stats.binom.sf(k - 1, n, low) == pytest.approx(0.025, rel=1e-6)
    if k < n:
        assert stats.binom.cdf(k, n, high) == pytest.approx(0.025, rel=1e-6)


def test_nothing_is_known_without_runs():
    assert intervals.clopper_pearson(0, 0) == (0.0, 1.0)
    assert intervals.newcombe((0, 0), (1, 2)) == (-1.0, 1.0)
    assert intervals.newcombe_paired(0, 0, 0, 0) == (-1.0, 1.0)
    assert intervals.mcnemar(0, 0) == 1.0


@pytest.mark.parametrize(
    ("first", "second", "low", "high"),
    [((56, 70), (48, 80), 0.0524, 0.3339), ((9, 10), (3, 10), 0.1705, 0.8090)],
)
def test_published_newcombe_intervals(first, second, low, high):
    """Newcombe, Statistics in Medicine 17 (1998), pp. 873-890, table II, method 10."""
    assert intervals.newcombe(first, second) == pytest.approx((low, high), abs=1e-4)


@pytest.mark.parametrize(
    ("counts", "low", "high"),
    [
        ((36, 12, 2, 0), 0.0569, 0.3404),
        ((18, 12, 2, 18), 0.0562, 0.3290),
        ((53, 0, 0, 1), -0.0729, 0.0729),
        ((0, 30, 0, 0), 0.8395, 1.0),
    ],
)
def test_published_newcombe_intervals_of_pairs(counts, low, high):
    """Newcombe, Statistics in Medicine 17 (1998), pp. 2635-2650, method 10."""
    assert intervals.newcombe_paired(*counts) == pytest.approx((low, high), abs=1e-4)


@given(*(st.integers(0, 200) for _ in range(4)))
def test_pairs_the_other_way_round_give_the_other_sign(both, first, second, neither):
    low, high = intervals.newcombe_paired(both, first, second, neither)
    assert (-high, -low) == pytest.approx(intervals.newcombe_paired(both, second, first, neither), abs=1e-12)
    n = both + first + second + neither
    if n:
        assert -1.0 - 1e-12 <= low <= (first - second) / n + 1e-12
        assert (first - second) / n - 1e-12 <= high <= 1.0 + 1e-12


def test_fishers_tea():
    # The lady tasting tea: 3 of 4 right, p = 34/70 from both sides.
    assert intervals.fisher((3, 4), (1, 4)) == pytest.approx(34.0 / 70.0)


def test_mcnemar_by_counting():
    assert intervals.mcnemar(1, 7) == pytest.approx(2.0 * sum(math.comb(8, k) for k in range(2)) / 2**8)


@pytest.mark.parametrize(("n", "share"), [(10, 0.5), (59, 0.05), (200, 0.95), (1000, 0.5)])
def test_quantile_interval_covers_by_brute_force(n, share):
    generator = np.random.default_rng(n)
    draws = np.sort(generator.random((4000, n)), axis=1)  # uniform: the quantile is the share
    held = [low <= share <= high for low, high in (intervals.quantile_interval(row, share) for row in draws)]
    assert np.mean(held) >= 0.95 - 3.0 * math.sqrt(0.05 * 0.95 / 4000)


def test_too_few_values_have_no_end():
    assert intervals.quantile_interval(np.arange(3.0), 0.01)[0] == -math.inf
    assert intervals.quantile_interval(np.arange(3.0), 0.99)[1] == math.inf
    assert intervals.quantile_interval(np.empty(0), 0.5) == (-math.inf, math.inf)


def test_difference_of_medians_covers_by_brute_force():
    generator = np.random.default_rng(1)
    held = 0
    for _ in range(1000):
        a, b = np.sort(generator.exponential(1.0, 80)), np.sort(generator.exponential(2.0, 120))
        sides = [(float(np.median(x)), intervals.quantile_interval(x, 0.5)) for x in (a, b)]
        low, high = intervals.difference_of_quantiles(*sides)
        held += low <= -math.log(2.0) <= high  # medians log 2 and 2 log 2
    assert 0.93 <= held / 1000 <= 1.0
