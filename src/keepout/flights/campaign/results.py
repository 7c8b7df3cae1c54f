"""What a campaign's report says, as numbers: rates, distributions, influences, worst flights, refusals."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy import stats

from keepout.core.cores import available_cores
from keepout.core.progress import Progress, part_of, silent
from keepout.flights.campaign.influence import Factor, Influence, Ranked, holm, influence, ranked
from keepout.flights.campaign.outcomes import (
    FIGURES,
    Distribution,
    Figure,
    Outcomes,
    Rate,
    distribution,
    rates,
    read_outcomes,
)
from keepout.flights.campaign.reading import Reading

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

    reading: Reading
    runs: int
    flown: int
    rates: tuple[Rate, ...]
    distributions: tuple[Distribution, ...]
    influences: tuple[Influence, ...]
    corrected: tuple[float | None, ...]
    scatters: tuple[Scatter, ...]
    worst: tuple[dict[str, Any], ...]
    refusals: tuple[Refusal, ...]


def results(reading: Reading, *, progress: Progress = silent) -> Results:
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
    corrected = tuple(holm([_least_of(one.p_value, one.p_groups) for one in influences]))
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
    reading: Reading, outcomes: Outcomes, pool: ThreadPoolExecutor, progress: Progress
) -> list[tuple[Influence, Scatter]]:
    """Measure every factor against every figure, a few columns in memory at once."""
    known = {f.column: outcomes.has(f) & np.isfinite(outcomes.figures[f.column]) for f in FIGURES}
    ranks = dict(zip(known, pool.map(lambda c: stats.rankdata(outcomes.figures[c][known[c]]), known), strict=True))
    points = {column: _points(has) for column, has in known.items()}
    columns = reading.factor_columns()
    names, found = list(columns), []
    for first in range(0, len(names), _ROOM):
        some = names[first : first + _ROOM]
        arrays = reading.arrays([column for name in some for column in columns[name]])

        def measure(name: str, arrays: dict[str, Any] = arrays) -> list[tuple[Influence, Scatter]]:
            factor = reading.factor(name, arrays)
            made = {}
            of: tuple[np.ndarray, Ranked] | None = None
            for figure in sorted(FIGURES, key=lambda figure: figure.flights):
                has, rows = known[figure.column], points[figure.column]
                if of is None or not np.array_equal(of[0], has):  # figures of the same runs follow one another
                    of = has, ranked(Factor(name, factor.values[has], factor.levels))
                one = influence(of[1], figure.name, ranks[figure.column])
                drawn = Factor(name, factor.values[rows], factor.levels)
                values = outcomes.figures[figure.column][rows]
                made[figure] = one, Scatter(one, figure, drawn, values, ~outcomes.cleared[rows])
            return [made[figure] for figure in FIGURES]

        for place, some_found in enumerate(pool.map(measure, some)):
            found += some_found
            progress((first + place + 1) / len(names), some[place])
    return found


def _points(has: Bool[np.ndarray, "runs"]) -> np.ndarray:
    rows = np.flatnonzero(has)
    if len(rows) <= POINTS:
        return rows
    return np.sort(np.random.default_rng(_SEED).choice(rows, POINTS, replace=False, shuffle=False))


def _worst(reading: Reading, outcomes: Outcomes) -> tuple[dict[str, Any], ...]:
    flown = np.flatnonzero(outcomes.flown)
    clearance = outcomes.figures["minimum_clearance"][flown]
    chosen = outcomes.run[flown[np.argsort(clearance, kind="stable")[:WORST]]].tolist()
    columns = ["run", "contact", "reached", *(figure.column for figure in FIGURES)]
    columns += [name for name in ("guard_interventions", "remarks") if name in reading.names]
    factors = [column for group in reading.factor_columns().values() for column in group]
    rows = {row["run"]: row for row in reading.rows(chosen, [*columns, *factors])}
    return tuple(rows[run] for run in chosen)


def _refusals(reading: Reading, outcomes: Outcomes) -> tuple[Refusal, ...]:
    refused = np.flatnonzero(~outcomes.flown)
    groups = []
    for place in np.unique(outcomes.reason.codes[refused]):
        runs = outcomes.run[refused[outcomes.reason.codes[refused] == place]].tolist()
        [example] = reading.rows(runs[:1], ["run", "reason"])
        groups.append(Refusal(outcomes.reason.values[place], example["reason"], tuple(runs)))
    return tuple(sorted(groups, key=lambda group: (-len(group.runs), group.runs[0])))


def _least_of(first: float | None, second: float | None) -> float | None:
    known: Sequence[float] = [p for p in (first, second) if p is not None]
    return min(2.0 * min(known), 1.0) if known else None
