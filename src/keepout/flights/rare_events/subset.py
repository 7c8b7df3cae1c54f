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
within a run, is the error of their mean (`estimate.py`): many tapes of one level descend from few of the level before.

Every random number is a function of seed, run, level and sweep, so that a simulation that was stopped goes on, bit for
bit, from the level it was in.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from keepout.core.errors import ScenarioError
from keepout.core.progress import Progress, silent

Performance = Callable[[Float[np.ndarray, "tapes numbers"]], Float[np.ndarray, "tapes"]]
"""The performance of tapes of standard normals, one number a tape: pure, and the same for a tape in any company."""

SHARE = 8
"""One in so many tapes of a level starts a chain of the next, of so many tapes."""

_ACCEPTANCE = 0.3
"""The step β is driven to where this share of moves is taken."""

_FIRST_STEP = 0.6
_STEPS = (1e-3, 1.0)
"""Least and largest β."""


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


def simulate(
    performance: Performance,
    numbers: int,
    *,
    below: float,
    runs: int = 8,
    tapes: int = 1024,
    seed: int = 0,
    most_levels: int = 16,
    resumed: Simulation | None = None,
    kept: Callable[[Simulation], None] | None = None,
    progress: Progress = silent,
) -> Simulation:
    """Run subset simulation to its end.

    Args:
        performance: to fall below a number.
        numbers: standard normals in a tape.
        below: the number.
        runs: side by side; their spread is the error of their mean.
        tapes: a level and run; a multiple of 8.
        seed: of everything drawn.
        most_levels: it ends with so many, below the number or not: 16 reach down to 8⁻¹⁵, 3e-14.
        resumed: what `kept` was given, to go on from; of the same arguments.
        kept: given the simulation after each level, to be written down.
        progress: told after each sweep.

    Raises:
        ScenarioError: numbers out of range, or a performance that is not a number.

    """
    _check(numbers, below, runs, tapes, seed, most_levels)
    if resumed is None:
        progress(0.0, "level 1")
        drawn = np.empty((runs, tapes, numbers))
        for run in range(runs):
            _generator(seed, run, 0, 0).standard_normal(out=drawn[run])
        first = Level(_evaluated(performance, drawn), math.inf, np.ones(runs), 1.0, _FIRST_STEP)
        found = _after_level(drawn, first, None, below, seed, most_levels)
    else:
        found = resumed
    while True:
        if kept is not None:
            kept(found)
        if found.ended:
            progress(1.0, "")
            return found
        found = _advance(performance, found, below, seed, most_levels, progress)


def _advance(
    performance: Performance, found: Simulation, below: float, seed: int, most_levels: int, progress: Progress
) -> Simulation:
    """Fly one more level of every run."""
    number = len(found.levels)
    tapes, values, step = found.seeds, found.seed_values, found.levels[-1].step
    chains = tapes.shape[1]
    # Filled sweep by sweep: the tapes of a level are most of the memory that this takes.
    all_tapes = np.empty((len(tapes), SHARE * chains, tapes.shape[2]))
    all_values, shares = np.empty(all_tapes.shape[:2]), []
    all_tapes[:, :chains], all_values[:, :chains] = tapes, values
    for sweep in range(1, SHARE):
        # Nobody knows how many levels there will be: as far as the last ones went, and as far again to go, at least.
        done = (number + sweep / SHARE) / max(_levels_needed(found, below), number + 1)
        progress(min(done, 0.99), f"level {number + 1}: P(≤ {found.next_threshold:.3g})")
        drawn = [_generator(seed, run, number, sweep).standard_normal(tapes.shape[1:]) for run in range(len(tapes))]
        proposed = math.sqrt(1.0 - step**2) * tapes + step * np.stack(drawn)
        reached = _evaluated(performance, proposed)
        taken = reached <= found.next_threshold
        tapes = np.where(taken[:, :, None], proposed, tapes)
        values = np.where(taken, reached, values)
        now = slice(sweep * chains, (sweep + 1) * chains)
        all_tapes[:, now], all_values[:, now] = tapes, values
        shares.append(float(taken.mean()))
        step = float(np.clip(step * math.exp(shares[-1] - _ACCEPTANCE), *_STEPS))
    level = Level(all_values, found.next_threshold, found.next_probability, float(np.mean(shares)), step)
    return _after_level(all_tapes, level, found, below, seed, most_levels)


def _after_level(
    tapes: Float[np.ndarray, "runs tapes numbers"],
    level: Level,
    before: Simulation | None,
    below: float,
    seed: int,
    most_levels: int,
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
    if np.mean(values < below) >= 1.0 / SHARE:
        ended = "reached"
    elif threshold == -math.inf:
        ended = "stuck"
    elif len(levels) >= most_levels:
        ended = "levels"
    if ended:
        none = tapes[:, :0]
        return Simulation(levels, none, values[:, :0], level.threshold, level.probability, lowest, lowest_value, ended)
    inside = values <= threshold
    chosen = np.stack([_chosen(inside, run, chains, _generator(seed, run, len(levels), 0)) for run in range(runs)])
    return Simulation(
        levels,
        seeds=tapes[chosen[..., 0], chosen[..., 1]],
        seed_values=values[chosen[..., 0], chosen[..., 1]],
        next_threshold=threshold,
        next_probability=level.probability * inside.mean(axis=1),
        lowest=lowest,
        lowest_value=lowest_value,
    )


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


def _check(numbers: int, below: float, runs: int, tapes: int, seed: int, most_levels: int) -> None:
    for name, value, least in (
        ("tape: numbers", numbers, 1),
        ("runs", runs, 2),
        ("seed", seed, 0),
        ("most_levels", most_levels, 1),
    ):
        if value < least:
            raise ScenarioError(f"{name}: {value}; it must be at least {least}")
    if tapes < 8 * SHARE or tapes % SHARE:
        raise ScenarioError(f"flights: {tapes} a level and run; it must be a multiple of {SHARE}, at least {8 * SHARE}")
    if not math.isfinite(below):
        raise ScenarioError(f"below: {below}; it must be finite")
