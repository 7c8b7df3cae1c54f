"""What the runs of a simulation say together: a mean, its 95 % interval, and what is known where nothing was found."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy import stats

from keepout.rare_events.subset import Simulation

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


def interval(runs: Float[np.ndarray, "runs"]) -> tuple[float, float, float]:
    """Give mean and 95 % interval of the probability that independent runs estimate without bias.

    Student's t with the runs' spread, laid on the logarithm of the mean: m exp(± t s / (m √n)). The runs' products are
    skewed to the right, as products are; on the mean itself the interval would end too low, and on the mean of the
    logarithms it would be of their median (docs/rare.md has what each of them covers).
    """
    mean = float(np.mean(runs))
    if mean == 0.0:
        return 0.0, 0.0, math.nan
    count = len(runs)
    half = float(stats.t.ppf(0.5 + CONFIDENCE / 2, count - 1) * np.std(runs, ddof=1) / math.sqrt(count) / mean)
    return mean, mean * math.exp(-half), min(mean * math.exp(min(half, 700.0)), 1.0)


def estimate(simulation: Simulation, below: float) -> Estimate:
    """Estimate the probability that the performance is below a number.

    Where a run found no tape below it, the spread of the runs is no error of their mean. Then only an upper bound is
    given: the least of the upper ends of the intervals of the thresholds passed, below which the number lies; and of
    what none in so many independent tapes of the first level allows with 95 %.
    """
    runs = simulation.below(below)
    mean, lower, upper = interval(runs)
    if np.all(runs > 0.0):
        return Estimate(mean, lower, upper, runs)
    ends = [interval(level.probability)[2] for level in simulation.levels if level.threshold >= below]
    first = simulation.levels[0].values
    found = int(np.sum(first < below))
    ends.append(float(stats.beta.ppf(CONFIDENCE, found + 1, first.size - found)))
    return Estimate(mean, 0.0, float(np.nanmin(ends)), runs, bounded_only=True)


def curve(simulation: Simulation, points: int = 60) -> Float[np.ndarray, "points 4"]:
    """Give performance, probability to be below it, and the interval of that, from the middle of the first level down.

    Only numbers that every run came below.
    """
    high = float(np.median(simulation.levels[0].values))
    last = simulation.levels[-1].values
    low = float(last[np.isfinite(last)].min(initial=high))
    rows = [
        (number, *interval(runs))
        for number in np.linspace(low, high, points)
        if (runs := simulation.below(number)).all()
    ]
    return np.array(rows).reshape(-1, 4)
