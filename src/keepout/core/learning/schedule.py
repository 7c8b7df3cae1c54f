"""When a fit does what: its phases, the learning rate of each step, and when it may end.

A fit is a row of blocks of steps. In time that does not suffice for all of them, some are left out, evenly, so that the
learning rates fall as they would; where time is left and the bound is not there, the last phase is taken once more.
"""

import dataclasses
import math
import time

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Float32

from keepout.core.errors import FieldError, require_finite
from keepout.core.learning.losses import TrainingProfile

BLOCK = 250
"""Steps between progress reports, checkpoints and searches for counter-examples; the last phase has its own."""
TUNING_RATE, POLISH_RATE = 0.4, 0.1
"""Learning rates at the start of the second and of the third phase, to that of the first."""
SETTLING = 1 / 3
"""Last share of the counter-example phase, from which on under-statement is no longer hunted: it holds what it has
gained, and the certified side settles last."""
POLISH = 300
"""Steps of the last phase of a fit that is to end by bound or time, where its profile has none."""
SECOND_SHARE, SECOND_ROUND = 0.25, 100
"""Largest share of its profile's steps that a fit takes which begins with another field, and the steps between searches
in its polish."""
_HUNTS_TO_EXPECT = 4
_HUNT = 200
"""Steps that a search for counter-examples is taken to last as long as, until there was one."""


def phase_blocks(profile: TrainingProfile) -> tuple[int, int, int]:
    """Count the blocks of each phase of a fit."""
    return profile.steps // BLOCK, profile.tuning_steps // BLOCK, profile.polish_steps // profile.polish_round


def phase_of(profile: TrainingProfile, block: int) -> int:
    """Give 0 for a block of the first phase, 1 for one that learns from counter-examples, 2 for the polish."""
    return int(np.searchsorted(np.cumsum(phase_blocks(profile)), block, side="right"))


def block_lengths(profile: TrainingProfile) -> list[int]:
    """Give the steps of each block of a fit."""
    first, second, third = phase_blocks(profile)
    return [BLOCK] * (first + second) + [profile.polish_round] * third


def settling(profile: TrainingProfile, block: int) -> bool:
    """Say whether under-statement is no longer hunted before a block."""
    return block >= (profile.steps + (1.0 - SETTLING) * profile.tuning_steps) // BLOCK


def learning_rates(profile: TrainingProfile, block: int) -> Float32[np.ndarray, "steps"]:
    """Give the learning rate of each step of a block, to the profile's: a schedule for each phase, from its begin.

    The first phase ends at the rate at which the second begins: what it would gain by coming to rest is lost again.
    """
    lengths, phase = block_lengths(profile), phase_of(profile, block)
    first, last = sum(phase_blocks(profile)[:phase]), sum(phase_blocks(profile)[: phase + 1])
    steps, done = sum(lengths[first:last]), sum(lengths[first:block])
    start = (1.0, TUNING_RATE, POLISH_RATE)[phase]
    end = TUNING_RATE if phase == 0 and profile.tuning_steps else 0.01 * start
    if profile.halving:
        schedule = optax.exponential_decay(start, profile.halving, 0.5, staircase=True)
    elif phase == 2:
        schedule = optax.cosine_decay_schedule(start, steps, 0.01)
    else:
        schedule = optax.warmup_cosine_decay_schedule(0.1 * start, start, min(100, steps // 10), steps, end)
    return np.asarray(jax.vmap(schedule)(jnp.arange(done, done + lengths[block])), np.float32)


def shortened(profile: TrainingProfile, error: float) -> TrainingProfile:
    """Give the numbers of a fit that begins with another field, without a first phase.

    Args:
        profile: of a fit anew.
        error: mean |f̃ - d| / (|d| + `near`) of that field on the new mesh's samples: the share of the steps it takes.

    """
    steps = math.ceil(min(error, SECOND_SHARE) * (profile.steps + profile.tuning_steps) / BLOCK) * BLOCK
    polish = math.ceil((profile.polish_steps or POLISH) / SECOND_ROUND) * SECOND_ROUND
    return dataclasses.replace(profile, steps=0, tuning_steps=steps, polish_steps=polish, polish_round=SECOND_ROUND)


@dataclasses.dataclass(frozen=True)
class Ending:
    """When a fit ends, other than after its profile's steps.

    Attributes:
        until_bound: m; a fit whose largest over-statement found is no more goes over to its polish, and ends after it.
        at_most: s, of the whole fit.

    Raises:
        FieldError: a bound that is no number, or a time that is not above 0.

    """

    until_bound: float | None = None
    at_most: float | None = None

    def __post_init__(self) -> None:
        if self.until_bound is not None and not math.isfinite(self.until_bound):
            raise FieldError(f"until_bound: {self.until_bound} m; it must be a number")
        if self.at_most is not None:
            require_finite(self.at_most, f"at_most: {self.at_most} s", FieldError, positive=True)

    def of_profile(self, profile: TrainingProfile) -> TrainingProfile:
        """Give the numbers of a fit that ends so: it needs a last phase.

        Raises:
            FieldError: the profile searches for no over-statement, so that no bound is ever found.

        """
        if self.until_bound is None and self.at_most is None:
            return profile
        if profile.tuning_steps:
            return dataclasses.replace(profile, polish_steps=profile.polish_steps or POLISH)
        if self.until_bound is not None:
            raise FieldError(
                f"until_bound: {self.until_bound:g} m; the profile searches for no over-statement, so that it never "
                "knows; leave it out, or take the profile default or quick"
            )
        return profile


class Pace:
    """Which block of a fit comes next, by what is asked of its end and by what blocks have taken so far.

    Attributes:
        ending: what is asked.
        begun: time.perf_counter() when the fit began.
        left_out: blocks that there was no time for.
        worst: the largest over-statement that the last hunt found, m.
        met: whether the fit has been found to be within the bound that is asked for.

    """

    def __init__(self, profile: TrainingProfile, ending: Ending, begun: float):
        self.profile, self.ending, self.begun = profile, ending, begun
        self.left_out, self.worst, self.met = 0, math.inf, False
        self._lengths = block_lengths(profile)
        self._hunts: list[float] = []
        self._steps: list[float] = []
        self._seen: list[tuple[float, float]] = []
        self._first = True

    @property
    def blocks(self) -> int:
        """Of the profile."""
        return len(self._lengths)

    @property
    def time_left(self) -> float:
        """Give the seconds until the fit must end; infinite where that is not said."""
        at_most = self.ending.at_most
        return math.inf if at_most is None else at_most - (time.perf_counter() - self.begun)

    def took(self, place: int, hunt: float, steps: float) -> None:
        """Take in what the hunt before a block and its steps took, s; the first block compiles, and tells nothing."""
        if self._first:
            self._first = False
            return
        self._steps.append(steps / self._lengths[place])
        if phase_of(self.profile, place) > 0:
            self._hunts.append(hunt)

    def seconds(self, first: int) -> float:
        """Give the seconds that the blocks from a place on are expected to take; 0 while nothing is known."""
        if not self._steps:
            return 0.0
        # A program compiled on the way makes one block slow, and no later one.
        step = min(self._steps[-3:])
        hunt = min(self._hunts[-3:], default=_HUNT * step)
        places = range(first, self.blocks)
        return math.fsum(step * self._lengths[n] + hunt * (phase_of(self.profile, n) > 0) for n in places)

    def found(self, worst: float, place: int) -> None:
        """Take in the largest over-statement that a hunt before a block, or after the last, found, m."""
        self.worst = worst
        if phase_of(self.profile, place) == phase_of(self.profile, place - 1) == 1:
            self._seen.append((float(learning_rates(self.profile, place)[0]), worst))
        self.met = self.ending.until_bound is not None and worst <= self.ending.until_bound

    def onward(self, place: int) -> int:
        """Give the place of the block after one that was taken; the number of `blocks` where the fit is over."""
        end, polish, left = self.blocks, self.blocks - phase_blocks(self.profile)[2], self.time_left
        if left <= 0.0:
            return end
        if place == end - 1:
            wanted = self.ending.until_bound is not None and math.isfinite(left) and not self.met
            return polish if wanted and polish < end and self.seconds(polish) <= left else end
        onward = place + 1
        if self.met and onward < polish:
            onward = polish
        else:
            # The last block is taken: its rate is the smallest.
            onward = min(place + max(1, round(self.seconds(onward) / left)), end - 1)
            self.left_out += onward - place - 1
        return onward

    @property
    def expected(self) -> float | None:
        """Give the largest over-statement that the fit is expected to come to, m: it falls as the learning rate does.

        A line through what the hunts of the second phase found, at rate 0; None before there are four. A guess, within
        some centimetres.
        """
        if len(self._seen) < _HUNTS_TO_EXPECT:
            return None
        rate, worst = np.array(self._seen).T
        slope, at_rest = np.polyfit(rate, worst, 1)
        return float(min(at_rest if slope > 0.0 else worst.mean(), self.worst))

    def share(self, place: int) -> float:
        """Give the share of a fit's steps that is done after a block, 0 to 1."""
        return sum(self._lengths[: place + 1]) / sum(self._lengths)

    def told(self, place: int, onward: int) -> str:
        """Say what was found before a block, and how long the fit will go on after it."""
        said = f", worst over-statement {self.worst:+.3f} m" if phase_of(self.profile, place) else ""
        if phase_of(self.profile, place) == 1 and self.expected is not None:
            said += f", about {self.expected:+.2f} m to be expected"
        if self._steps:
            said += f", {min(self.seconds(onward), self.time_left):.0f} s left"
        return said

    @property
    def ended(self) -> str:
        """Say why the fit is over, in a word: "bound", "time" or "steps"."""
        if self.met:
            return "bound"
        polished_on = self.ending.until_bound is not None and self.ending.at_most is not None
        return "time" if self.time_left <= 0.0 or self.left_out or polished_on else "steps"
