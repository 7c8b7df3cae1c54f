"""Two finished campaigns side by side: rates, quantiles, and, where run k drew the same in both, differences by run."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy import stats

from keepout.core.errors import ScenarioError
from keepout.core.progress import Progress, silent
from keepout.flights.campaign.intervals import (
    Interval,
    difference_of_quantiles,
    fisher,
    mcnemar,
    newcombe,
    newcombe_paired,
    quantile_interval,
)
from keepout.flights.campaign.outcomes import FIGURES, Figure, Outcomes, Rate, rank, rates, read_outcomes
from keepout.flights.campaign.reading import Reading, Words

SHARES = (0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99)
_DRAWS = ("seed", "campaign.sampling", "campaign.dispersions", "campaign.lower", "campaign.upper")
"""Entries that draws depend on; with a design over all runs, their number too."""


@dataclass(frozen=True)
class RateDifference:
    """One rate of two campaigns.

    Attributes:
        first: of the first campaign.
        second: of the second.
        low: end of the 95 % interval of first less second: Newcombe's, for pairs where they are pairs.
        high: the other end.
        p_value: exact, two-sided: McNemar's for pairs, else Fisher's.
        pairs: in both, in the first alone, in the second alone, in neither; None where runs are no pairs.

    """

    first: Rate
    second: Rate
    low: float
    high: float
    p_value: float
    pairs: tuple[int, int, int, int] | None

    @property
    def difference(self) -> float | None:
        """First less second: of the pairs where there are any."""
        if self.pairs is not None:
            return (self.pairs[1] - self.pairs[2]) / sum(self.pairs) if sum(self.pairs) else None
        if self.first.rate is None or self.second.rate is None:
            return None
        return self.first.rate - self.second.rate


@dataclass(frozen=True)
class QuantileDifference:
    """One quantile of a figure in two campaigns, each of all its flights that have a finite value.

    Attributes:
        figure: which.
        share: of the quantile.
        first: in the first campaign.
        second: in the second.
        low: end of the interval of first less second (`intervals.difference_of_quantiles`), about 95 %.
        high: the other end; infinite where the flights are too few.

    """

    figure: Figure
    share: float
    first: float
    second: float
    low: float
    high: float


@dataclass(frozen=True, eq=False)
class PairedDifference:
    """A figure of the first campaign less that of the second, run by run.

    Attributes:
        figure: which.
        pairs: runs that have a finite value in both.
        mean: of the differences.
        mean_low: end of its 95 % interval (Student's t).
        mean_high: the other end.
        median: of the differences.
        median_low: end of its 95 % interval (order statistics).
        median_high: the other end.
        lower: pairs in which the first is lower.
        higher: pairs in which it is higher.
        p_value: that both are as likely: the sign test, exact, two-sided.
        curve: differences at `shares`, ascending, a few hundred.
        shares: of pairs at or below.

    """

    figure: Figure
    pairs: int
    mean: float
    mean_low: float
    mean_high: float
    median: float
    median_low: float
    median_high: float
    lower: int
    higher: int
    p_value: float
    curve: Float[np.ndarray, "points"]
    shares: Float[np.ndarray, "points"]


@dataclass(frozen=True, eq=False)
class Comparison:
    """Two campaigns compared. Make with `compare`.

    Attributes:
        first: one campaign.
        second: the other.
        differing: entries of what they are in which they differ, with both values.
        paired: runs that drew the same in both, bit for bit; None where the two are no pairs.
        unlike: runs of both numbers that did not, and are left out of the pairs.
        rates: differences of the rates.
        quantiles: differences of quantiles.
        differences: by run; empty without pairs.

    """

    first: Reading
    second: Reading
    differing: tuple[tuple[str, Any, Any], ...]
    paired: int | None
    unlike: int
    rates: tuple[RateDifference, ...]
    quantiles: tuple[QuantileDifference, ...]
    differences: tuple[PairedDifference, ...]


def compare(first: Reading, second: Reading, *, progress: Progress = silent) -> Comparison:
    """Compare two finished campaigns.

    Runs are pairs where seed, dispersions and sampling are the same, so that run k draws the same in both; of these,
    only runs whose draws are equal bit for bit count (a start is drawn again where the chaser has no room).

    Raises:
        ScenarioError: one is not finished, or the tables have no common columns.
        FlightError: a file is damaged.

    """
    for reading in (first, second):
        if not reading.complete:
            raise ScenarioError(
                f"{reading.folder}: {len(reading.parts)} of {reading.chunks} parts are done; only finished campaigns "
                "can be compared: start it again to finish it"
            )
    needed = ("run", "status", "reason", "contact", "reached", *(figure.column for figure in FIGURES))
    for reading in (first, second):
        if not set(reading.names) & set(needed):
            raise ScenarioError(f"{reading.folder}: its table has none of the columns {', '.join(needed)}")
    one, other = read_outcomes(first), read_outcomes(second)
    progress(0.4, "pairs")
    same = _same_draws(first, second, min(one.runs, other.runs)) if _are_pairs(first, second) else None
    progress(0.6, "rates")
    compared = _rates(one, other, same)
    quantiles = tuple(found for figure in FIGURES for found in _quantiles(figure, one, other))
    progress(0.8, "differences")
    pairs = () if same is None else (_by_run(figure, one, other, same) for figure in FIGURES)
    return Comparison(
        first,
        second,
        tuple(_differing(first.identity, second.identity)),
        None if same is None else int(same.sum()),
        0 if same is None else int(np.sum(~same)),
        compared,
        quantiles,
        tuple(found for found in pairs if found is not None),
    )


def _are_pairs(first: Reading, second: Reading) -> bool:
    a, b = (_entries(reading.identity["scenario"]) for reading in (first, second))
    names = _DRAWS if first.scenario.campaign.sampling == "random" else (*_DRAWS, "campaign.runs")
    differing = {name for name in a.keys() | b.keys() if a.get(name) != b.get(name)}
    return not any(name == draw or name.startswith(f"{draw}.") for name in differing for draw in names)


def _same_draws(first: Reading, second: Reading, runs: int) -> Bool[np.ndarray, "runs"]:
    columns = [column for group in first.factor_columns().values() for column in group if column in second.names]
    same = np.ones(runs, bool)
    for column in columns:  # one at a time, as a million runs take 8 MB
        a, b = first.arrays([column])[column], second.arrays([column])[column]
        if isinstance(a, Words) and isinstance(b, Words):
            places = np.array([b.values.index(text) if text in b.values else -1 for text in a.values])
            same &= places[a.codes[:runs]] == b.codes[:runs]
        elif isinstance(a, Words) or isinstance(b, Words):
            same[:] = False
        else:
            same &= (a[:runs] == b[:runs]) | (np.isnan(a[:runs]) & np.isnan(b[:runs]))
    return same


def _rates(one: Outcomes, other: Outcomes, same: Bool[np.ndarray, "runs"] | None) -> tuple[RateDifference, ...]:
    found = []
    for first, second, a, b in zip(rates(one), rates(other), _events(one), _events(other), strict=True):
        if same is None:
            counts = (first.count, first.total), (second.count, second.total)
            found.append(RateDifference(first, second, *newcombe(*counts), fisher(*counts), None))
            continue
        n = len(same)
        # Both must have been flown for a pair of flights, and be drawn for a pair of runs.
        known = same & a[1][:n] & b[1][:n]
        x, y = a[0][:n][known], b[0][:n][known]
        pairs = tuple(int(np.sum(both)) for both in (x & y, x & ~y, ~x & y, ~x & ~y))
        found.append(
            RateDifference(first, second, *newcombe_paired(*pairs), mcnemar(pairs[1], pairs[2]), pairs)  # pyright: ignore
        )
    return tuple(found)


def _events(of: Outcomes) -> list[tuple[np.ndarray, np.ndarray]]:
    """Give of each of `rates` which runs it happened in, and which runs it is counted among, in the same order."""
    undecided = of.flown & ~of.touched & ~of.cleared
    happened = (of.reached & of.cleared, of.reached, of.touched, undecided, of.touched | undecided)
    return [*((event, of.flown) for event in happened), (~of.flown, np.ones(of.runs, bool))]


def _finite(figure: Figure, of: Outcomes) -> Float[np.ndarray, "n"]:
    values = of.figures[figure.column][of.has(figure)]
    return np.sort(values[np.isfinite(values)])


def _quantiles(figure: Figure, one: Outcomes, other: Outcomes) -> Iterator[QuantileDifference]:
    a, b = _finite(figure, one), _finite(figure, other)
    if not (len(a) and len(b)):
        return
    for share in SHARES:
        first, second = float(a[rank(len(a), share)]), float(b[rank(len(b), share)])
        sides: tuple[Interval, Interval] = quantile_interval(a, share), quantile_interval(b, share)
        interval = difference_of_quantiles((first, sides[0]), (second, sides[1]))
        yield QuantileDifference(figure, share, first, second, *interval)


def _by_run(figure: Figure, one: Outcomes, other: Outcomes, same: Bool[np.ndarray, "runs"]) -> PairedDifference | None:
    n = len(same)
    a, b = one.figures[figure.column][:n], other.figures[figure.column][:n]
    known = same & one.has(figure)[:n] & other.has(figure)[:n] & np.isfinite(a) & np.isfinite(b)
    ordered = np.sort(a[known] - b[known])
    count = len(ordered)
    if count == 0:
        return None
    mean = float(ordered.mean())
    wide = float(stats.t.ppf(0.975, count - 1) * ordered.std(ddof=1) / np.sqrt(count)) if count > 1 else np.inf
    lower, higher = int(np.sum(ordered < 0.0)), int(np.sum(ordered > 0.0))
    places = np.unique(np.linspace(0, count - 1, min(count, 401)).astype(int))
    return PairedDifference(
        figure,
        count,
        mean,
        mean - wide,
        mean + wide,
        float(ordered[rank(count, 0.5)]),
        *quantile_interval(ordered, 0.5),
        lower,
        higher,
        mcnemar(lower, higher),
        ordered[places],
        (places + 1.0) / count,
    )


def _differing(first: dict[str, Any], second: dict[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    a, b = _entries(first), _entries(second)
    for name in dict.fromkeys((*a, *b)):
        if a.get(name) != b.get(name):
            yield name.removeprefix("scenario."), a.get(name), b.get(name)


def _entries(tree: dict[str, Any], above: str = "") -> dict[str, Any]:
    """Give a tree's leaves by dotted name."""
    found: dict[str, Any] = {}
    for key, value in tree.items():
        name = f"{above}.{key}" if above else str(key)
        found |= _entries(value, name) if isinstance(value, dict) else {name: value}
    return found
