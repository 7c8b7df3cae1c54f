"""Subset simulation: how probable it is that a function of many standard normals falls below a number.

The probability of a rare event is the product of probabilities that are not rare (Au and Beck, Probabilistic
Engineering Mechanics 16, 2001): a first level of independent tapes, and at each further level tapes given that the
performance is at most a threshold, the one that an eighth of the level before reached. The tapes of a level that
reached it start chains of preconditioned Crank–Nicolson moves (Cotter, Roberts, Stuart and White, Statistical Science
28, 2013), x' = √(1 − β²) x + β ξ with ξ standard normal, which keep the normal law in any dimension; a move to above
the threshold is refused, which keeps the normal law given the threshold. As the seeds already have that law, no move is
wasted on a burn-in.

Several runs advance side by side. They share the thresholds and the step β, which are chosen from the tapes of all of
them, and nothing else: no tape of one run descends from a tape of another. For thresholds and steps given beforehand
each run's product is free of bias, whatever its chains mix like: the tapes at most a threshold are counted one by one,
and each has the same expected number of chains. What is left is that the thresholds depend a little on the run itself:
the bias of choosing them from one run alone is so many times smaller as there are runs. The runs' spread, and nothing
within a run, is the error of their mean (`estimate`): many tapes of one level descend from few of the level before.

Every random number is a function of seed, run, level and sweep, so that a simulation that was stopped goes on, bit for
bit, from the level it was in: as a file it is kept after each level.

Of what the runs say together, an interval answers one question that was asked beforehand; a band answers several at
once.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy import stats

from keepout.core.errors import ScenarioError
from keepout.core.kept import UNREADABLE, packed, unpacked
from keepout.core.progress import Progress, silent
from keepout.core.whole_file import write_whole

Performance = Callable[[Float[np.ndarray, "tapes numbers"]], Float[np.ndarray, "tapes"]]
"""The performance of tapes of standard normals, one number a tape: pure, and the same for a tape in any company."""

SHARE = 8
"""One in so many tapes of a level starts a chain of the next, of so many tapes."""

_ACCEPTANCE = 0.3
"""The step β is driven to where this share of moves is taken."""

_FIRST_STEP = 0.6
_STEPS = (1e-3, 1.0)
"""Least and largest β."""
CONFIDENCE = 0.95
_POINTS = 60
"""Of a curve."""
_PARTS = ("seeds", "seed_values", "next_threshold", "next_probability", "lowest", "lowest_value")
_OF_LEVEL = ("values", "threshold", "probability", "acceptance", "step")


@dataclass(frozen=True)
class Level:
    """One level of all runs.

    Attributes:
        values: the performance of all tapes.
        threshold: that the tapes of this level were given to be at most; infinite for the first level.
        probability: that the performance is at most `threshold`, as each run found it: its product so far.
        acceptance: share of moves taken; 1 for the first level, which has none.
        step: β at its end.

    """

    values: Float[np.ndarray, "runs tapes"]
    threshold: float
    probability: Float[np.ndarray, "runs"]
    acceptance: float
    step: float


@dataclass(frozen=True)
class Simulation:
    """A simulation under way or at its end.

    Attributes:
        levels: so far.
        seeds: tapes that start the next level's chains.
        seed_values: their performances.
        next_threshold: of the next level.
        next_probability: that the performance is at most that, as each run found it.
        lowest: the tape with the least performance of all.
        lowest_value: its performance.
        ended: "" while under way; "reached" where an eighth of the last level is below the number asked for; "levels"
            where the number of levels ran out before; "stuck" where no tape of a level was below its threshold.

    """

    levels: tuple[Level, ...]
    seeds: Float[np.ndarray, "runs chains numbers"]
    seed_values: Float[np.ndarray, "runs chains"]
    next_threshold: float
    next_probability: Float[np.ndarray, "runs"]
    lowest: Float[np.ndarray, "numbers"]
    lowest_value: float
    ended: str = ""

    def below(self, number: float) -> Float[np.ndarray, "runs"]:
        """Give each run's probability that the performance is below a number."""
        last = [level for level in self.levels if level.threshold >= number][-1]
        return last.probability * np.mean(last.values < number, axis=1)

    @property
    def evaluations(self) -> int:
        """Tapes whose performance was asked for, in all runs."""
        first = self.levels[0].values.size
        return first + (len(self.levels) - 1) * (first - first // SHARE)

    def save(self, path: Path) -> None:
        """Write it to a file, whole or not at all."""
        arrays = {name: np.asarray(getattr(self, name)) for name in _PARTS}
        for name in _OF_LEVEL:
            arrays[f"level_{name}"] = np.stack([np.asarray(getattr(level, name)) for level in self.levels])
        write_whole(path, packed(arrays | {"ended": np.asarray(self.ended)}), refusal=ScenarioError)

    @classmethod
    def load(cls, path: Path) -> "Simulation":
        """Read one.

        Raises:
            ScenarioError: the file cannot be read, or is not one of `save`.

        """
        try:
            kept = unpacked(path.read_bytes())
            parts: dict[str, Any] = {name: kept[name] for name in _PARTS}
            levels = [kept[f"level_{name}"] for name in _OF_LEVEL]
            ended = str(kept["ended"])
        except UNREADABLE as error:
            raise ScenarioError(
                f"{path}: not a simulation that can go on ({type(error).__name__}); remove it to begin anew"
            ) from None
        parts |= {name: float(parts[name]) for name in ("next_threshold", "lowest_value")}
        plain = (each if each.ndim > 1 else each.tolist() for each in levels)
        return cls(tuple(Level(*level) for level in zip(*plain, strict=True)), **parts, ended=ended)


@dataclass(frozen=True)
class Question:
    """What is asked of a simulation, and how much work goes into the answer.

    Attributes:
        below: the number that the performance is to fall below.
        runs: side by side; their spread is the error of their mean.
        tapes: a level and run; a multiple of 8.
        seed: of everything drawn.
        most_levels: it ends with so many, below the number or not: 16 reach down to 8⁻¹⁵, 3e-14.

    Raises:
        ScenarioError: a number out of range.

    """

    below: float
    runs: int = 8
    tapes: int = 1024
    seed: int = 0
    most_levels: int = 16

    def __post_init__(self) -> None:
        """Check each number against its range."""
        for name, least in (("runs", 2), ("seed", 0), ("most_levels", 1)):
            if getattr(self, name) < least:
                raise ScenarioError(f"{name}: {getattr(self, name)}; it must be at least {least}")
        if self.tapes < 8 * SHARE or self.tapes % SHARE:
            raise ScenarioError(
                f"flights: {self.tapes} a level and run; it must be a multiple of {SHARE}, at least {8 * SHARE}"
            )
        if not math.isfinite(self.below):
            raise ScenarioError(f"below: {self.below}; it must be finite")


def simulate(
    performance: Performance,
    numbers: int,
    question: Question,
    *,
    state: Path | None = None,
    progress: Progress = silent,
) -> Simulation:
    """Run subset simulation to its end.

    Args:
        performance: to fall below a number.
        numbers: standard normals in a tape, at least 1.
        question: what is asked.
        state: file in which it is kept after each level, and gone on with if it is there; of the same arguments.
        progress: told after each sweep.

    Raises:
        ScenarioError: a performance that is not a number, or a file that cannot be read.

    """
    search = _Search(performance, question, progress)
    found = search.begun(numbers) if state is None or not state.exists() else Simulation.load(state)
    while True:
        if state is not None:
            found.save(state)
        if found.ended:
            progress(1.0, "")
            return found
        found = search.advanced(found)


@dataclass(frozen=True)
class _Search:
    """What a simulation goes on by."""

    performance: Performance
    question: Question
    progress: Progress

    def begun(self, numbers: int) -> Simulation:
        """Fly the first level of every run."""
        self.progress(0.0, "level 1")
        drawn = self._drawn((self.question.runs, self.question.tapes, numbers), 0, 0)
        first = Level(_evaluated(self.performance, drawn), math.inf, np.ones(len(drawn)), 1.0, _FIRST_STEP)
        return self._after(drawn, first, None)

    def advanced(self, found: Simulation) -> Simulation:
        """Fly one more level of every run."""
        number = len(found.levels)
        tapes, values, step = found.seeds, found.seed_values, found.levels[-1].step
        chains = tapes.shape[1]
        # Filled sweep by sweep: the tapes of a level are most of the memory that this takes.
        all_tapes = np.empty((len(tapes), SHARE * chains, tapes.shape[2]))
        all_values, shares = np.empty(all_tapes.shape[:2]), []
        all_tapes[:, :chains], all_values[:, :chains] = tapes, values
        for sweep in range(1, SHARE):
            # Nobody knows how many levels there will be: as far as the last ones went, and as far again at least.
            done = (number + sweep / SHARE) / max(_levels_needed(found, self.question.below), number + 1)
            self.progress(min(done, 0.99), f"level {number + 1}: P(≤ {found.next_threshold:.3g})")
            proposed = math.sqrt(1.0 - step**2) * tapes + step * self._drawn(tapes.shape, number, sweep)
            reached = _evaluated(self.performance, proposed)
            taken = reached <= found.next_threshold
            tapes = np.where(taken[:, :, None], proposed, tapes)
            values = np.where(taken, reached, values)
            now = slice(sweep * chains, (sweep + 1) * chains)
            all_tapes[:, now], all_values[:, now] = tapes, values
            shares.append(float(taken.mean()))
            step = float(np.clip(step * math.exp(shares[-1] - _ACCEPTANCE), *_STEPS))
        level = Level(all_values, found.next_threshold, found.next_probability, float(np.mean(shares)), step)
        return self._after(all_tapes, level, found)

    def _drawn(self, shape: tuple[int, ...], level: int, sweep: int) -> Float[np.ndarray, "runs tapes numbers"]:
        drawn = np.empty(shape)
        for run, own in enumerate(drawn):
            _generator(self.question.seed, run, level, sweep).standard_normal(out=own)
        return drawn

    def _after(
        self, tapes: Float[np.ndarray, "runs tapes numbers"], level: Level, before: Simulation | None
    ) -> Simulation:
        """Choose the next threshold and the seeds of its chains, or end the simulation."""
        values = level.values
        runs, count = values.shape
        chains = count // SHARE
        least = np.unravel_index(np.argmin(values), values.shape)
        lowest, lowest_value = tapes[least].copy(), float(values[least])
        if before is not None and before.lowest_value <= lowest_value:
            lowest, lowest_value = before.lowest, before.lowest_value
        levels = (*(before.levels if before else ()), level)
        threshold, ended = float(np.partition(values.ravel(), runs * chains - 1)[runs * chains - 1]), ""
        if threshold >= level.threshold:
            # Many tapes share one value, such as the clearance of the start: the threshold goes below all of these.
            threshold = float(values[values < level.threshold].max(initial=-math.inf))
        if np.mean(values < self.question.below) >= 1.0 / SHARE:
            ended = "reached"
        elif threshold == -math.inf:
            ended = "stuck"
        elif len(levels) >= self.question.most_levels:
            ended = "levels"
        if ended:
            seeds, seed_values, threshold, below = tapes[:, :0], values[:, :0], level.threshold, level.probability
        else:
            inside = values <= threshold
            generators = [_generator(self.question.seed, run, len(levels), 0) for run in range(runs)]
            places = [_chosen(inside, run, chains, generator) for run, generator in enumerate(generators)]
            rows, columns = np.moveaxis(np.stack(places), -1, 0)
            seeds, seed_values = tapes[rows, columns], values[rows, columns]
            below = level.probability * inside.mean(axis=1)
        return Simulation(levels, seeds, seed_values, threshold, below, lowest, lowest_value, ended)


def _chosen(inside: np.ndarray, run: int, chains: int, generator: np.random.Generator) -> np.ndarray:
    """Give run and place of the tapes that start a run's chains: each of those inside equally often, give or take one.

    A run without any has probability 0, whatever its chains find; they then start from another run's tapes.
    """
    own = np.argwhere(inside[run])[:, 0]
    places = np.column_stack([np.full(len(own), run), own]) if len(own) else np.argwhere(inside)
    order = generator.permutation(len(places))
    return places[np.resize(order, chains)]


def _levels_needed(found: Simulation, below: float) -> float:
    """Guess how many levels it takes to come down to a number: as if each came down as far as the last one did."""
    before, now = found.levels[-1].threshold, found.next_threshold
    if not math.isfinite(before):
        before = float(np.median(found.levels[-1].values))
    descent = before - now
    return len(found.levels) + 1 + (max(now - below, 0.0) / descent if descent > 0.0 else 16.0)


def _generator(seed: int, run: int, level: int, sweep: int) -> np.random.Generator:
    return np.random.default_rng([seed, run, level, sweep])


def _evaluated(performance: Performance, tapes: Float[np.ndarray, "runs tapes numbers"]) -> np.ndarray:
    flat = tapes.reshape(-1, tapes.shape[-1])
    values = np.asarray(performance(flat), np.float64)
    if values.shape != flat.shape[:1]:
        raise ScenarioError(f"performance: shape {values.shape}; it must be one number a tape, {flat.shape[:1]}")
    if np.isnan(values).any():
        raise ScenarioError(f"performance: {int(np.isnan(values).sum())} of {len(values)} tapes gave no number")
    return values.reshape(tapes.shape[:2])


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
    logarithms it would be of their median (docs/motion.md has what each of them covers).
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


def curve(simulation: Simulation) -> Float[np.ndarray, "points 4"]:
    """Give performance, probability to be below it, and the `band` of that, from the middle of the first level down.

    Only numbers that every run came below.
    """
    high = float(np.median(simulation.levels[0].values))
    last = simulation.levels[-1].values
    low = float(last[np.isfinite(last)].min(initial=high))
    found = [(number, simulation.below(number)) for number in np.linspace(low, high, _POINTS).tolist()]
    found = [(number, runs) for number, runs in found if runs.all()]
    return band([number for number, _ in found], [runs for _, runs in found])
