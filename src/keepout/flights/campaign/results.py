"""What campaigns say, as numbers: rates, distributions, influences, worst flights, refusals, and two side by side."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy import stats

from keepout.core.audit.audit import Contact
from keepout.core.cores import available_cores
from keepout.core.errors import ScenarioError
from keepout.core.progress import Progress, part_of, silent
from keepout.flights.campaign import statistics
from keepout.flights.campaign.dataset import Dataset, Words, differences, entries
from keepout.flights.campaign.statistics import Factor, Influence, rank
from keepout.flights.campaign.table import FLOWN, without_numbers

QUANTILES = (0.0, 0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99, 1.0)
CURVE = 401
"""Points of a kept distribution."""
WORST = 10
SIGNIFICANT = 0.05
SCATTERED = 4
"""Pairs of factor and figure that points are kept of, the strongest."""
POINTS = 1500
"""Runs drawn in a scatter plot, at most."""
_ROOM = 12
"""Factors read at once: at a million runs 8 MB each."""
_THREADS = 2
"""Columns ranked at once, at most: each takes some 60 MB at a million runs."""
_SEED = 20261
"""Of the choice of runs that are drawn as points."""
COMPARED = (0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99)
_DRAWS = ("seed", "campaign.sampling", "campaign.dispersions", "campaign.lower", "campaign.upper")
"""Entries that draws depend on; with a design over all runs, their number too."""


@dataclass(frozen=True)
class Figure:
    """A number that every flight has.

    Attributes:
        column: of the campaign's table.
        label: for people, with its unit.
        name: in tables and file names.
        flights: which flights it is of, in words.

    """

    column: str
    label: str
    name: str
    flights: str


FIGURES = (
    Figure("minimum_clearance", "least clearance, m", "clearance", "flown"),
    Figure("delta_v", "Δv, m/s", "delta_v", "flown"),
    Figure("time_to_reach", "time to reach, s", "time_to_reach", "reached"),
    Figure("final_error", "final error, m", "final_error", "flown"),
)


@dataclass(frozen=True)
class Rate:
    """How often something happened.

    Attributes:
        name: what, one or few words.
        count: of `total` runs.
        total: runs or flights it is counted among.
        among: which, in a word.
        low: end of the 95 % interval (Clopper and Pearson).
        high: the other end.

    """

    name: str
    count: int
    total: int
    among: str
    low: float
    high: float

    @property
    def rate(self) -> float | None:
        """Share; None of nothing."""
        return self.count / self.total if self.total else None


@dataclass(frozen=True, eq=False)
class Distribution:
    """How a figure is distributed over the flights that have it.

    Attributes:
        figure: which.
        flights: that have it as a finite number.
        not_finite: flights of the same kind in which it is no finite number.
        mean: of the finite ones; None of none.
        quantiles: at `QUANTILES` (of n values that of rank ⌈q n⌉); None of none.
        curve: values at `shares`, ascending.
        shares: of flights at or below each value of the curve.

    """

    figure: Figure
    flights: int
    not_finite: int
    mean: float | None
    quantiles: tuple[float, ...] | None
    curve: Float[np.ndarray, "points"]
    shares: Float[np.ndarray, "points"]


@dataclass(frozen=True, eq=False)
class Outcomes:
    """Columns of all runs that are done, one entry a run.

    Attributes:
        run: numbers.
        flown: whether it was flown, and not refused.
        reached: whether it reached the goal.
        touched: whether the audit proved a contact.
        cleared: whether the audit proved that there was none.
        figures: by column of `FIGURES`; not a number where refused.
        reason: why it was refused, `without_numbers`.

    """

    run: np.ndarray
    flown: Bool[np.ndarray, "runs"]
    reached: Bool[np.ndarray, "runs"]
    touched: Bool[np.ndarray, "runs"]
    cleared: Bool[np.ndarray, "runs"]
    figures: dict[str, Float[np.ndarray, "runs"]]
    reason: Words

    @property
    def runs(self) -> int:
        """How many."""
        return len(self.run)

    def has(self, figure: Figure) -> Bool[np.ndarray, "runs"]:
        """Which runs are of the kind that has a figure."""
        return self.reached if figure.flights == "reached" else self.flown

    def known(self, figure: Figure) -> Bool[np.ndarray, "runs"]:
        """Which runs have a figure as a finite number."""
        return self.has(figure) & np.isfinite(self.figures[figure.column])

    def ordered(self, figure: Figure) -> Float[np.ndarray, "flights"]:
        """Give a figure's finite values, ascending."""
        return np.sort(self.figures[figure.column][self.known(figure)])

    def events(self) -> tuple[tuple[str, Bool[np.ndarray, "runs"], Bool[np.ndarray, "runs"], str], ...]:
        """Give what is counted: its name, the runs in which it happened, those that it is counted among, their name."""
        undecided = self.flown & ~self.touched & ~self.cleared
        happened = {
            "success: reached, no contact": self.reached & self.cleared,
            "reached": self.reached,
            "contact": self.touched,
            "undecided": undecided,
            "contact or undecided": self.touched | undecided,
        }
        return (
            *((name, event, self.flown, "flown") for name, event in happened.items()),
            ("refused", ~self.flown, np.ones(self.runs, bool), "drawn"),
        )


def read_outcomes(reading: Dataset) -> Outcomes:
    """Read what became of all runs that are done.

    Raises:
        FlightError: none is, or a part is damaged.

    """
    columns = ["run", "status", "reason", "contact", "reached", *(figure.column for figure in FIGURES)]
    found = reading.arrays(columns, grouped={"reason": without_numbers})
    flown = found["status"].equal(FLOWN)
    return Outcomes(
        found["run"].astype(np.int64),
        flown,
        flown & (found["reached"] == 1.0),
        flown & found["contact"].equal(str(Contact.YES)),
        flown & found["contact"].equal(str(Contact.NO)),
        {figure.column: found[figure.column] for figure in FIGURES},
        found["reason"],
    )


def rates(outcomes: Outcomes) -> tuple[Rate, ...]:
    """Count success, contact and the rest, with their intervals."""
    found = []
    for name, happened, among, which in outcomes.events():
        count, total = int(np.sum(happened & among)), int(np.sum(among))
        found.append(Rate(name, count, total, which, *statistics.clopper_pearson(count, total)))
    return tuple(found)


def distribution(outcomes: Outcomes, figure: Figure) -> Distribution:
    """Measure how a figure is distributed."""
    ordered = outcomes.ordered(figure)
    n = len(ordered)
    lost = int(np.sum(outcomes.has(figure))) - n
    if n == 0:
        return Distribution(figure, 0, lost, None, None, np.empty(0), np.empty(0))
    if n <= CURVE:
        places = np.arange(n)
    else:  # the lowest and highest twenty as they are, the rest evenly
        places = np.unique(np.r_[0:20, np.linspace(0, n - 1, CURVE - 40).astype(int), n - 20 : n])
    return Distribution(
        figure,
        n,
        lost,
        float(ordered.mean()),
        tuple(float(ordered[rank(n, share)]) for share in QUANTILES),
        ordered[places],
        (places + 1.0) / n,
    )


@dataclass(frozen=True, eq=False)
class Scatter:
    """Some runs of a strong pair, to be drawn.

    Attributes:
        influence: of the pair.
        figure: drawn upwards.
        factor: drawn to the right, with the draws of the runs at hand.
        values: of the figure.
        contact: whether the audit did not exclude one.

    """

    influence: Influence
    figure: Figure
    factor: Factor
    values: Float[np.ndarray, "points"]
    contact: Bool[np.ndarray, "points"]

    @property
    def drawn(self) -> list[Any]:
        """What was drawn for the factor: numbers, or of a choice its values as text."""
        levels = self.factor.levels
        return self.factor.values.astype(float).tolist() if levels is None else [levels[k] for k in self.factor.values]


@dataclass(frozen=True)
class Refusal:
    """Runs refused for one reason, numbers in it apart.

    Attributes:
        reason: with # for each number.
        example: of the first run, as it stands.
        runs: their numbers, ascending.

    """

    reason: str
    example: str
    runs: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Results:
    """A campaign's report as numbers. Make with `results`.

    Attributes:
        reading: the campaign.
        runs: that are done.
        flown: of these.
        rates: first of the flown, last of all.
        distributions: one of each of `FIGURES`.
        influences: of each factor on each figure.
        corrected: of each influence the smaller of its p-values, corrected for being one of two and for so many pairs
            (`holm`); below `SIGNIFICANT` it is no chance.
        scatters: of the strongest.
        worst: rows of the table of the flights with least clearance, worst first.
        refusals: the most frequent first.

    """

    reading: Dataset
    runs: int
    flown: int
    rates: tuple[Rate, ...]
    distributions: tuple[Distribution, ...]
    influences: tuple[Influence, ...]
    corrected: tuple[float | None, ...]
    scatters: tuple[Scatter, ...]
    worst: tuple[dict[str, Any], ...]
    refusals: tuple[Refusal, ...]


def results(reading: Dataset, *, progress: Progress = silent) -> Results:
    """Work out what a campaign's report says, from the parts that are done.

    Args:
        reading: of its folder.
        progress: told how far it is.

    Raises:
        FlightError: none of it is done, or a part is damaged.

    """
    outcomes = read_outcomes(reading)
    progress(0.2, "distributions")
    with ThreadPoolExecutor(min(available_cores(), _THREADS)) as pool:
        measured = tuple(pool.map(lambda figure: distribution(outcomes, figure), FIGURES))
        progress(0.3, "influences")
        found = _influences(reading, outcomes, pool, part_of(progress, 0.3, 0.9))
    influences = tuple(one for one, _ in found)
    # What goes up and down again has no ρ: the groups are tested beside it, the smaller p-value counting as one of two.
    known = ([p for p in (one.p_value, one.p_groups) if p is not None] for one in influences)
    corrected = tuple(statistics.holm([min(2.0 * min(some), 1.0) if some else None for some in known]))
    telling = [i for i, p in enumerate(corrected) if p is not None and p < SIGNIFICANT]
    strongest = sorted(telling, key=lambda i: -influences[i].strength)[:SCATTERED]
    progress(0.9, "worst flights")
    return Results(
        reading,
        outcomes.runs,
        int(outcomes.flown.sum()),
        rates(outcomes),
        measured,
        influences,
        corrected,
        tuple(found[i][1] for i in strongest),
        _worst(reading, outcomes),
        _refusals(reading, outcomes),
    )


def _influences(
    reading: Dataset, outcomes: Outcomes, pool: ThreadPoolExecutor, progress: Progress
) -> list[tuple[Influence, Scatter]]:
    """Measure every factor against every figure, a few columns in memory at once."""
    known = {figure: outcomes.known(figure) for figure in FIGURES}
    points = {figure: _points(has) for figure, has in known.items()}
    names, found = list(reading.factor_columns), []
    for first in range(0, len(names), _ROOM):
        some = names[first : first + _ROOM]
        arrays = reading.arrays([column for name in some for column in reading.factor_columns[name]])

        def measure(name: str, arrays: dict[str, Any] = arrays) -> list[tuple[Influence, Scatter]]:
            factor, made = Factor(name, *reading.drawn(name, arrays)), []
            for figure, has in known.items():
                values, rows = outcomes.figures[figure.column], points[figure]
                one = statistics.influence(Factor(name, factor.values[has], factor.levels), figure.name, values[has])
                drawn = Factor(name, factor.values[rows], factor.levels)
                made.append((one, Scatter(one, figure, drawn, values[rows], ~outcomes.cleared[rows])))
            return made

        for place, some_found in enumerate(pool.map(measure, some)):
            found += some_found
            progress((first + place + 1) / len(names), some[place])
    return found


def _points(has: Bool[np.ndarray, "runs"]) -> np.ndarray:
    rows = np.flatnonzero(has)
    if len(rows) <= POINTS:
        return rows
    return np.sort(np.random.default_rng(_SEED).choice(rows, POINTS, replace=False, shuffle=False))


def _worst(reading: Dataset, outcomes: Outcomes) -> tuple[dict[str, Any], ...]:
    flown = np.flatnonzero(outcomes.flown)
    clearance = outcomes.figures["minimum_clearance"][flown]
    chosen = outcomes.run[flown[np.argsort(clearance, kind="stable")[:WORST]]].tolist()
    columns = ["run", "contact", "reached", *(figure.column for figure in FIGURES)]
    columns += [name for name in ("guard_interventions", "remarks") if name in reading.names]
    factors = [column for group in reading.factor_columns.values() for column in group]
    rows = {row["run"]: row for row in reading.rows(chosen, [*columns, *factors])}
    return tuple(rows[run] for run in chosen)


def _refusals(reading: Dataset, outcomes: Outcomes) -> tuple[Refusal, ...]:
    refused = np.flatnonzero(~outcomes.flown)
    groups = []
    for place in np.unique(outcomes.reason.codes[refused]):
        runs = outcomes.run[refused[outcomes.reason.codes[refused] == place]].tolist()
        [example] = reading.rows(runs[:1], ["run", "reason"])
        groups.append(Refusal(outcomes.reason.values[place], example["reason"], tuple(runs)))
    return tuple(sorted(groups, key=lambda group: (-len(group.runs), group.runs[0])))


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


@dataclass(frozen=True, eq=False)
class PairedDifference:
    """A figure of the first campaign less that of the second, run by run.

    Attributes:
        figure: which.
        row: of a table: how many pairs have a finite value in both; mean and median of the differences with their 95 %
            intervals (Student's t, order statistics); the pairs in which the first is lower and in which it is higher,
            and the p-value of both being as likely (the sign test, exact, two-sided). None stands for what is infinite.
        curve: differences at `shares`, ascending, a few hundred.
        shares: of pairs at or below.

    """

    figure: Figure
    row: dict[str, Any]
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
        quantiles: a row of a table for each quantile of a figure in both, of all flights that have a finite value, and
            the interval of the first less the second (`statistics.difference`), about 95 %, None where the
            flights are too few.
        differences: by run; empty without pairs.

    """

    first: Dataset
    second: Dataset
    differing: tuple[tuple[str, Any, Any], ...]
    paired: int | None
    unlike: int
    rates: tuple[RateDifference, ...]
    quantiles: tuple[dict[str, Any], ...]
    differences: tuple[PairedDifference, ...]


def compare(first: Dataset, second: Dataset, *, progress: Progress = silent) -> Comparison:
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
    differing = differences(entries(first.identity), entries(second.identity))
    return Comparison(
        first,
        second,
        tuple((name.removeprefix("scenario."), *values) for name, *values in differing),
        None if same is None else int(same.sum()),
        0 if same is None else int(np.sum(~same)),
        compared,
        quantiles,
        tuple(found for found in pairs if found is not None),
    )


def _are_pairs(first: Dataset, second: Dataset) -> bool:
    names = _DRAWS if first.scenario.campaign.sampling == "random" else (*_DRAWS, "campaign.runs")
    differing = differences(*(entries(reading.identity["scenario"]) for reading in (first, second)))
    return not any(name == draw or name.startswith(f"{draw}.") for name, *_ in differing for draw in names)


def _same_draws(first: Dataset, second: Dataset, runs: int) -> Bool[np.ndarray, "runs"]:
    columns = [column for group in first.factor_columns.values() for column in group if column in second.names]
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
    for first, second, a, b in zip(rates(one), rates(other), one.events(), other.events(), strict=True):
        if same is None:
            counts = (first.count, first.total), (second.count, second.total)
            found.append(RateDifference(first, second, *statistics.newcombe(*counts), statistics.fisher(*counts), None))
            continue
        n = len(same)
        # Both must have been flown for a pair of flights, and be drawn for a pair of runs.
        (x, among), (y, among_other) = (event[1:3] for event in (a, b))
        known = same & among[:n] & among_other[:n]
        x, y = x[:n][known], y[:n][known]
        both, only, other_only, neither = (int(np.sum(of)) for of in (x & y, x & ~y, ~x & y, ~x & ~y))
        pairs, p_value = (both, only, other_only, neither), statistics.mcnemar(only, other_only)
        found.append(RateDifference(first, second, *statistics.newcombe_paired(*pairs), p_value, pairs))
    return tuple(found)


def _quantiles(figure: Figure, one: Outcomes, other: Outcomes) -> Iterator[dict[str, Any]]:
    a, b = one.ordered(figure), other.ordered(figure)
    if not (len(a) and len(b)):
        return
    for share in COMPARED:
        first, second = (float(of[rank(len(of), share)]) for of in (a, b))
        sides = statistics.quantile_interval(a, share), statistics.quantile_interval(b, share)
        low, high = statistics.difference((first, second), sides)
        row = {"figure": figure.label, "quantile": f"{100.0 * share:g} %", "A": first, "B": second}
        yield _known(row | {"A - B": first - second, "low": low, "high": high})


def _known(row: dict[str, Any]) -> dict[str, Any]:
    """Give a row with None for each number that is not finite."""
    return {key: None if isinstance(value, float) and not np.isfinite(value) else value for key, value in row.items()}


def _by_run(figure: Figure, one: Outcomes, other: Outcomes, same: Bool[np.ndarray, "runs"]) -> PairedDifference | None:
    n = len(same)
    a, b = one.figures[figure.column][:n], other.figures[figure.column][:n]
    known = same & one.known(figure)[:n] & other.known(figure)[:n]
    ordered = np.sort(a[known] - b[known])
    count = len(ordered)
    if count == 0:
        return None
    mean = float(ordered.mean())
    wide = float(stats.t.ppf(0.975, count - 1) * ordered.std(ddof=1) / np.sqrt(count)) if count > 1 else np.inf
    lower, higher = int(np.sum(ordered < 0.0)), int(np.sum(ordered > 0.0))
    low, high = statistics.quantile_interval(ordered, 0.5)
    row = {"figure": figure.label, "pairs": count}
    row |= {"mean A - B": mean, "mean low": mean - wide, "mean high": mean + wide}
    row |= {"median A - B": float(ordered[rank(count, 0.5)]), "median low": low, "median high": high}
    row |= {"A lower": lower, "A higher": higher, "p of sign": statistics.mcnemar(lower, higher)}
    places = np.unique(np.linspace(0, count - 1, min(count, CURVE)).astype(int))
    return PairedDifference(figure, _known(row), ordered[places], (places + 1.0) / count)
