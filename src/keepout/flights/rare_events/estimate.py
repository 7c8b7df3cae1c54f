"""What the runs of a simulation say together: a mean, its 95 % interval, and what is known where nothing was found.

An interval answers one question that was asked beforehand; a band answers several at once.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy import stats

from keepout.flights.rare_events.subset import Simulation

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Estimate:
    """A probability as measured.

    Attributes:
        mean: of the runs; 0 where none of them found any.
        lower: lower end of the 95 % interval.
        upper: upper end of it, or, where no interval can be given, what the probability is below with 95 %.
        runs: each run's own.
        bounded_only: whether `upper` is all that is known: some run found none at all.

    """

    mean: float
    lower: float
    upper: float
    runs: Float[np.ndarray, "runs"]
    bounded_only: bool = False

    @property
    def relative_error(self) -> float:
        """Standard error of the mean, relative to it; infinite where the mean is 0."""
        if self.mean == 0.0:
            return math.inf
        return float(np.std(self.runs, ddof=1) / math.sqrt(len(self.runs)) / self.mean)

    def summary(self) -> dict[str, Any]:
        """Give plain numbers for JSON: None for what is not known."""
        if self.bounded_only:
            return {"probability": None, "interval": None, "below": self.upper}
        return {
            "probability": self.mean,
            "interval": [self.lower, self.upper],
            "relative_error": self.relative_error,
        }


def interval(runs: Float[np.ndarray, "runs"], confidence: float = CONFIDENCE) -> tuple[float, float, float]:
    """Give mean and interval, of 95 % if nothing else is said, of the probability that runs estimate without bias.

    Student's t with the runs' spread, laid on the logarithm of the mean: m exp(± t s / (m √n)). The runs' products are
    skewed to the right, as products are; on the mean itself the interval would end too low, and on the mean of the
    logarithms it would be of their median (docs/rare.md has what each of them covers).
    """
    mean = float(np.mean(runs))
    if mean == 0.0:
        return 0.0, 0.0, math.nan
    count = len(runs)
    half = float(stats.t.ppf(0.5 + confidence / 2, count - 1) * np.std(runs, ddof=1) / math.sqrt(count) / mean)
    return mean, mean * math.exp(-half), min(mean * math.exp(min(half, 700.0)), 1.0)


def estimate(simulation: Simulation, below: float) -> Estimate:
    """Estimate the probability that the performance is below a number.

    Where a run found no tape below it, the spread of the runs is no error of their mean. Then only an upper bound is
    given: the lesser of the upper end at the last threshold passed, below which the number lies, and of what none in
    so many independent tapes of the first level allows. Each of the two is wrong with half of 5 %, so that the lesser
    is wrong with 5 % at most.
    """
    runs = simulation.below(below)
    mean, lower, upper = interval(runs)
    if np.all(runs > 0.0):
        return Estimate(mean, lower, upper, runs)
    passed = [level for level in simulation.levels[1:] if level.threshold >= below][-1:]
    wrong = (1.0 - CONFIDENCE) / (len(passed) + 1)
    ends = [interval(level.probability, 1.0 - 2.0 * wrong)[2] for level in passed]
    first = simulation.levels[0].values
    found = int(np.sum(first < below))
    ends.append(float(stats.beta.ppf(1.0 - wrong, found + 1, first.size - found)))
    return Estimate(mean, 0.0, float(np.nanmin(ends)), runs, bounded_only=True)


def band(numbers: Sequence[float], runs: Sequence[Float[np.ndarray, "runs"]]) -> Float[np.ndarray, "numbers 4"]:
    """Give a band that holds the probabilities to be below several numbers, all at once, with 95 %.

    Of K numbers each has an interval that is wrong with 5 %/K, so that with 95 % none is. The probability rises with
    the number: where all intervals hold, so does the largest of the lower ends up to a number, and the least of the
    upper ends from it on. The band so drawn in rises too, and costs no confidence. With intervals of 95 % each the same
    would cost some: of many lower ends the largest is more often wrong than each is.

    Args:
        numbers: rising.
        runs: of each number, the probability that each run found; none of which falls from number to number.

    Returns:
        A row for each number: the number, the mean, and the lower and upper end; an end is NaN where no run found any.

    """
    confidence = 1.0 - (1.0 - CONFIDENCE) / max(len(numbers), 1)
    rows = np.array([(number, *interval(of, confidence)) for number, of in zip(numbers, runs, strict=True)])
    rows = rows.reshape(-1, 4)
    rows[:, 2] = np.maximum.accumulate(rows[:, 2])
    rows[:, 3] = np.fmin.accumulate(rows[::-1, 3])[::-1]
    return rows


def curve(simulation: Simulation, points: int = 60) -> Float[np.ndarray, "points 4"]:
    """Give performance, probability to be below it, and the `band` of that, from the middle of the first level down.

    Only numbers that every run came below.
    """
    high = float(np.median(simulation.levels[0].values))
    last = simulation.levels[-1].values
    low = float(last[np.isfinite(last)].min(initial=high))
    found = [(number, simulation.below(number)) for number in np.linspace(low, high, points).tolist()]
    found = [(number, runs) for number, runs in found if runs.all()]
    return band([number for number, _ in found], [runs for _, runs in found])
