"""Statistics of what a campaign counts: intervals and exact tests of rates and quantiles, and which draws matter.

All are for independent runs. The rates' intervals are Clopper and Pearson's, which cover their probability at least as
often as they say; those of differences are Newcombe's, which do so closely but not always.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy import special, stats

Interval = tuple[float, float]

CONFIDENCE = 0.95
GROUPS = 10
"""Groups of equal size that a number's draws are put into, to find what goes up and down again."""


def clopper_pearson(count: int, total: int) -> Interval:
    """Bound the probability of what happened `count` times in `total` independent runs.

    Whatever the probability is, at least `CONFIDENCE` of such intervals hold it (Clopper and Pearson, Biometrika 26,
    1934).

    Returns:
        From 0 to 1 without runs.

    """
    if total == 0:
        return 0.0, 1.0
    return _interval(count, total, "exact")


def none_seen_bound(total: int) -> float:
    """Give the upper bound, from one side, of a probability of what never happened: close to 3/total at 95 %."""
    return 1.0 - (1.0 - CONFIDENCE) ** (1.0 / total) if total else 1.0


def newcombe(first: tuple[int, int], second: tuple[int, int]) -> Interval:
    """Bound the first probability less the second from separate runs: Newcombe's hybrid score interval.

    About `CONFIDENCE` of such intervals hold the difference (Newcombe, Statistics in Medicine 17, 1998, pp. 873-890,
    method 10).

    Args:
        first: how often, and of how many runs.
        second: likewise.

    """
    if not (first[1] and second[1]):
        return -1.0, 1.0
    rates = first[0] / first[1], second[0] / second[1]
    return difference(rates, (_interval(*first), _interval(*second)))


def newcombe_paired(both: int, first_only: int, second_only: int, neither: int) -> Interval:
    """Bound the first probability less the second from pairs: Newcombe's interval for paired data.

    Method 10 of Newcombe, Statistics in Medicine 17, 1998, pp. 2635-2650: about `CONFIDENCE` of such intervals hold the
    difference.

    Args:
        both: pairs in which it happened in both.
        first_only: in the first alone.
        second_only: in the second alone.
        neither: in neither.

    """
    total = both + first_only + second_only + neither
    if total == 0:
        return -1.0, 1.0
    counts = both + first_only, both + second_only
    margins = math.sqrt(math.prod((*(float(count) for count in counts), *(float(total - count) for count in counts))))
    product = float(both) * neither - float(first_only) * second_only
    if product > 0.0:  # a continuity correction, towards no correlation
        product = max(product - total / 2.0, 0.0)
    correlation = product / margins if margins else 0.0
    rates = counts[0] / total, counts[1] / total
    sides = _interval(counts[0], total), _interval(counts[1], total)
    return difference(rates, sides, correlation)


def fisher(first: tuple[int, int], second: tuple[int, int]) -> float:
    """Give Fisher's exact p-value, two-sided, of two rates being one."""
    table = [[first[0], first[1] - first[0]], [second[0], second[1] - second[0]]]
    return float(stats.fisher_exact(table).pvalue)  # pyright: ignore[reportAttributeAccessIssue]


def mcnemar(first_only: int, second_only: int) -> float:
    """Give McNemar's exact p-value, two-sided, of pairs being as likely to differ one way as the other."""
    total = first_only + second_only
    return float(stats.binomtest(first_only, total, 0.5).pvalue) if total else 1.0


def rank(n: int, share: float) -> int:
    """Give the place, from 0 on, of a quantile among n ordered values: of rank ⌈q n⌉."""
    return min(max(math.ceil(share * n - 1e-9 * n * share), 1), n) - 1


def quantile_interval(ordered: Float[np.ndarray, "n"], share: float) -> Interval:
    """Bound a quantile by two of the values seen, whatever the distribution: at least `CONFIDENCE` of them hold it.

    Args:
        ordered: independent values, ascending.
        share: of the quantile, strictly between 0 and 1.

    Returns:
        Infinite on a side on which the values are too few.

    """
    n, tail = len(ordered), (1.0 - CONFIDENCE) / 2.0
    low = int(stats.binom.ppf(tail, n, share)) if n else 0
    high = int(stats.binom.ppf(1.0 - tail, n, share)) + 1 if n else 1
    return (
        float(ordered[low - 1]) if low >= 1 else -math.inf,
        float(ordered[high - 1]) if high <= n else math.inf,
    )


def _interval(count: int, total: int, method: str = "wilson") -> Interval:
    found = stats.binomtest(count, total).proportion_ci(CONFIDENCE, method=method)
    return float(found.low), float(found.high)


def difference(values: tuple[float, float], sides: tuple[Interval, Interval], correlation: float = 0.0) -> Interval:
    """Bound the first of two values less the second by the intervals of both: about as sure as the two are.

    Distances to the ends are squared and added: of rates that is Newcombe's interval, of quantiles of separate runs
    Zou and Donner's (Statistics in Medicine 27, 2008).
    """
    (first, second), ((low_1, high_1), (low_2, high_2)) = values, sides
    down, up = (first - low_1, high_2 - second), (high_1 - first, second - low_2)
    return tuple(  # pyright: ignore[reportReturnType]
        first - second + sign * (math.inf if math.inf in way else _length(way, correlation))
        for sign, way in ((-1.0, down), (1.0, up))
    )


def _length(way: tuple[float, float], correlation: float) -> float:
    return math.sqrt(max(way[0] ** 2 - 2.0 * correlation * way[0] * way[1] + way[1] ** 2, 0.0))


@dataclass(frozen=True, eq=False)
class Factor:
    """What was drawn for one dispersed number, one entry a run.

    Attributes:
        name: of its column; of a choice, of its entry.
        values: the numbers; of a choice, the place of the chosen value in `levels`.
        levels: of a choice, its values as text; None of a number.

    """

    name: str
    values: Float[np.ndarray, "runs"] | Int[np.ndarray, "runs"]
    levels: tuple[str, ...] | None = None


@dataclass(frozen=True)
class Influence:
    """How a factor and a figure of the flights go together.

    Attributes:
        factor: its name.
        figure: the figure's name.
        runs: that have the figure.
        correlation: Spearman's ρ, from -1 to 1; None of a choice, and where either never changes.
        low: end of its 95 % interval (Bonett and Wright, Psychometrika 65, 2000), approximate; None with fewer than 4.
        high: the other end.
        ratio: η, from 0 to 1, of the figure's ranks between groups: a choice's values, or `GROUPS` of a number's draws.
            The part of the variance that so many groups show by chance is taken off (ε², Kelley 1935).
        p_value: that what was drawn does not matter: of ρ for a number (two-sided, Student's t), of Kruskal and
            Wallis's test for a choice.
        p_groups: of Kruskal and Wallis's test between the groups.

    """

    factor: str
    figure: str
    runs: int
    correlation: float | None
    low: float | None
    high: float | None
    ratio: float | None
    p_value: float | None
    p_groups: float | None

    @property
    def strength(self) -> float:
        """The larger of |ρ| and η."""
        return max(abs(self.correlation or 0.0), self.ratio or 0.0)


def influence(factor: Factor, figure: str, values: Float[np.ndarray, "runs"]) -> Influence:
    """Measure how a factor goes together with a figure.

    Args:
        factor: with the draws of those runs that have the figure.
        figure: its name.
        values: of the figure, all finite.

    """
    n, varies = len(values), bool(np.ptp(values)) if len(values) else False
    correlation = p_value = ratio = p_groups = None
    groups = factor.values
    if factor.levels is None:
        if n >= 3 and varies and np.ptp(factor.values):
            correlation, p_value = map(float, stats.spearmanr(factor.values, values))
        places = (stats.rankdata(factor.values) - 0.5) * GROUPS / max(n, 1)
        groups = np.minimum(places.astype(np.int64), GROUPS - 1)
    parts = [values[groups == group] for group in np.unique(groups)]
    k = len(parts)
    if n > k > 1 and varies:
        statistic, p_groups = map(float, stats.kruskal(*parts))
        ratio = min(math.sqrt(max((statistic - k + 1) / (n - k), 0.0)), 1.0)
    if factor.levels is not None:
        p_value = p_groups
    low, high = (None, None) if correlation is None else correlation_interval(correlation, n)
    return Influence(factor.name, figure, n, correlation, low, high, ratio, p_value, p_groups)


def correlation_interval(rho: float, n: int) -> tuple[float, float] | tuple[None, None]:
    """Give the approximate interval of Spearman's ρ: Fisher's z with Bonett and Wright's standard error."""
    if n < 4:
        return None, None
    if abs(rho) == 1.0:
        return rho, rho
    middle, error = math.atanh(rho), math.sqrt((1.0 + rho**2 / 2.0) / (n - 3))
    wide = float(special.ndtri(0.5 + CONFIDENCE / 2.0)) * error
    return math.tanh(middle - wide), math.tanh(middle + wide)


def holm(p_values: Sequence[float | None]) -> list[float | None]:
    """Correct p-values for being many (Holm 1979): at 0.05, the chance of even one false alarm is at most 5 %."""
    known = sorted((p, place) for place, p in enumerate(p_values) if p is not None)
    found: list[float | None] = [None] * len(p_values)
    largest = 0.0
    for rank, (p, place) in enumerate(known):
        largest = max(largest, min((len(known) - rank) * p, 1.0))
        found[place] = largest
    return found
