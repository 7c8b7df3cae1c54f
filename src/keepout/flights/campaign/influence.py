"""Which of the dispersed numbers matters: rank correlations of what was drawn with what became of the flights."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy import special, stats

from keepout.flights.campaign.intervals import CONFIDENCE

GROUPS = 10
"""Groups of equal size that a number's draws are put into, to find what goes up and down again."""


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


@dataclass(frozen=True, eq=False)
class Ranked:
    """A factor's draws made ready: ranks of a number (None of a choice), and the groups they fall into."""

    name: str
    ranks: Float[np.ndarray, "runs"] | None
    groups: Int[np.ndarray, "runs"]


def ranked(factor: Factor) -> Ranked:
    """Rank the draws of those runs that have a figure."""
    if factor.levels is not None:
        return Ranked(factor.name, None, factor.values.astype(np.int64))
    ranks = stats.rankdata(factor.values)
    groups = ((ranks - 0.5) * GROUPS / max(len(ranks), 1)).astype(np.int64)
    return Ranked(factor.name, ranks, np.minimum(groups, GROUPS - 1))


def influence(factor: Ranked, figure: str, ranks: Float[np.ndarray, "runs"]) -> Influence:
    """Measure how a factor goes together with a figure.

    Args:
        factor: with the draws of those runs that have the figure.
        figure: its name.
        ranks: of the figure, averaged where equal.

    """
    n = len(ranks)
    ratio, p_groups = rank_ratio(factor.groups, ranks)
    if factor.ranks is None:
        return Influence(factor.name, figure, n, None, None, None, ratio, p_groups, p_groups)
    correlation, p_value = rank_correlation(factor.ranks, ranks)
    low, high = correlation_interval(correlation, n) if correlation is not None else (None, None)
    return Influence(factor.name, figure, n, correlation, low, high, ratio, p_value, p_groups)


def rank_correlation(
    first: Float[np.ndarray, "n"], second: Float[np.ndarray, "n"]
) -> tuple[float, float] | tuple[None, None]:
    """Give Spearman's ρ from ranks and its p-value; nothing where either never changes or there are fewer than 3."""
    if len(first) < 3 or np.ptp(first) == 0.0 or np.ptp(second) == 0.0:
        return None, None
    rho, p_value = np.asarray(stats.pearsonr(first, second)).tolist()
    return rho, p_value


def correlation_interval(rho: float, n: int) -> tuple[float, float] | tuple[None, None]:
    """Give the approximate interval of Spearman's ρ: Fisher's z with Bonett and Wright's standard error."""
    if n < 4:
        return None, None
    if abs(rho) == 1.0:
        return rho, rho
    middle, error = math.atanh(rho), math.sqrt((1.0 + rho**2 / 2.0) / (n - 3))
    wide = float(special.ndtri(0.5 + CONFIDENCE / 2.0)) * error
    return math.tanh(middle - wide), math.tanh(middle + wide)


def rank_ratio(groups: Int[np.ndarray, "n"], ranks: Float[np.ndarray, "n"]) -> tuple[float, float] | tuple[None, None]:
    """Give η of ranks between groups, less what chance gives, and Kruskal and Wallis's p-value.

    Nothing with fewer than two groups, or where all ranks are equal or each run is a group of its own.
    """
    n = len(ranks)
    counts = np.bincount(groups)
    used = counts > 0
    k = int(used.sum())
    about = ranks - ranks.mean() if n else ranks
    whole = float(about @ about)
    if k < 2 or n <= k or whole == 0.0:
        return None, None
    sums = np.bincount(groups, weights=about)[used]
    statistic = (n - 1) * float(np.sum(sums**2 / counts[used])) / whole
    ratio = math.sqrt(max((statistic - k + 1) / (n - k), 0.0))
    return min(ratio, 1.0), float(stats.chi2.sf(statistic, k - 1))


def holm(p_values: Sequence[float | None]) -> list[float | None]:
    """Correct p-values for being many (Holm 1979): at 0.05, the chance of even one false alarm is at most 5 %."""
    known = sorted((p, place) for place, p in enumerate(p_values) if p is not None)
    found: list[float | None] = [None] * len(p_values)
    largest = 0.0
    for rank, (p, place) in enumerate(known):
        largest = max(largest, min((len(known) - rank) * p, 1.0))
        found[place] = largest
    return found
