"""What became of a campaign's runs: how often, and how their figures are distributed."""

import math
import re
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from keepout.core.audit.audit import Contact
from keepout.flights.campaign.intervals import clopper_pearson
from keepout.flights.campaign.reading import Reading, Words
from keepout.flights.campaign.table import FLOWN

QUANTILES = (0.0, 0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99, 1.0)
CURVE = 401
"""Points of a kept distribution."""
_NUMBER = re.compile(r"[-+]?\b\d+(\.\d+)?([eE][-+]?\d+)?\b")
"""A number in a reason, and no digits in a name."""


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


def read_outcomes(reading: Reading) -> Outcomes:
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


def without_numbers(reason: str) -> str:
    """Give a reason with # for each number, so that runs refused for the same reason have the same text."""
    return _NUMBER.sub("#", reason)


def rates(outcomes: Outcomes) -> tuple[Rate, ...]:
    """Count success, contact and the rest, with their intervals."""
    flown, undecided = outcomes.flown, outcomes.flown & ~outcomes.touched & ~outcomes.cleared
    return (
        _rate("success: reached, no contact", outcomes.reached & outcomes.cleared, flown, "flown"),
        _rate("reached", outcomes.reached, flown, "flown"),
        _rate("contact", outcomes.touched, flown, "flown"),
        _rate("undecided", undecided, flown, "flown"),
        _rate("contact or undecided", outcomes.touched | undecided, flown, "flown"),
        _rate("refused", ~flown, np.ones(outcomes.runs, bool), "drawn"),
    )


def distribution(outcomes: Outcomes, figure: Figure) -> Distribution:
    """Measure how a figure is distributed."""
    values = outcomes.figures[figure.column][outcomes.has(figure)]
    ordered = np.sort(values[np.isfinite(values)])
    n = len(ordered)
    lost = len(values) - n
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


def rank(n: int, share: float) -> int:
    """Give the place, from 0 on, of a quantile among n ordered values: of rank ⌈q n⌉."""
    return min(max(math.ceil(share * n - 1e-9 * n * share), 1), n) - 1


def _rate(name: str, happened: np.ndarray, among: np.ndarray, which: str) -> Rate:
    count, total = int(np.sum(happened)), int(np.sum(among))
    return Rate(name, count, total, which, *clopper_pearson(count, total))
