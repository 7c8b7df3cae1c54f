"""What errors can add up to where a braking plan is followed on an observer's estimate (docs/guard.md, section 3).

In every axis alike, with η the error of the estimate that is told, w̃ the pulse of a step's disturbance, ε the error
of the observer and q the distance of the predicted state from the plan,

    ε⁺ = (I − H)(Φ ε − w̃) + H η,   q⁺ = M q + Φⁿ H (η − Φ ε + w̃),   q = 0 when the plan is made,
    e = q − Φⁿ ε + w̃ of the last n steps,   H = [[l_r, (1 − l_r) T], [0, l_v]],   (I − H) Φ = diag(1 − l_r, 1 − l_v).

Everything is linear in the noise, in the disturbance and in the state at the start. So each bound is a sum of absolute
responses, over what came before the plan was made and what comes after it.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float

POSITION, VELOCITY, FEEDBACK, PREDICTED = range(4)
"""What is bounded: the two parts of e, K q, and the position part of q."""
_SMALL = 1e-13
"""What is left of a response is lost in the last digits of the sums below this."""

Poles = TypeVar("Poles", float, np.ndarray)
Gains = tuple[float, float, float, float]
"""Two poles of M, and l_r and l_v of the observer."""


@dataclass(frozen=True)
class Responses:
    """Sums of absolute responses, a row for each of POSITION to PREDICTED, a column for each time after the plan.

    The times are the n steps until the first command of the plan takes effect, and every one from then on.

    Attributes:
        pushed: to disturbances before and since the plan was made, per m/s².
        noisy: to the errors (ε_r, ε_v) of all estimates told, the one at the start of the flight included.
        struck: to a disturbance of a few consecutive steps at whatever time, per m/s².

    """

    pushed: Float[np.ndarray, "4 times"]
    noisy: Float[np.ndarray, "4 times 2"]
    struck: Float[np.ndarray, "4 times"]


def line_size(late: Float[np.ndarray, "*shape"], early: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Twice the mean of the absolute value of a line between two end values."""
    size = np.abs(late) + np.abs(early)
    crossing = (late**2 + early**2) / np.maximum(size, 1e-300)
    return np.where(late * early < 0.0, crossing, size)


def line_integral(row: Float[np.ndarray, "*shape 2"], period: float) -> Float[np.ndarray, "*shape"]:
    """∫|row · (T − τ, 1)| dτ over a step."""
    return 0.5 * period * line_size(row[..., 1], period * row[..., 0] + row[..., 1])


def stop_length(speed: Any, deceleration: Any, T: Any, fmod: Callable[[Any, Any], Any]) -> Any:
    """Length of the nominal braking motion from a speed (m/s), in m: full steps of T s, then one that ends at rest.

    `fmod` is that of the numbers' library.
    """
    rest = fmod(speed, deceleration * T)
    return (speed**2 - rest**2) / (2.0 * deceleration) + 0.5 * rest * T


def feedback_gains(period: float, first_pole: Poles, second_pole: Poles) -> tuple[Poles, Poles]:
    """k_p (1/s²) and k_d (1/s) that give M = Φ + Γ K, K = −[k_p, k_d], two real poles."""
    total, product = first_pole + second_pole, first_pole * second_pole
    k_p = (1.0 - total + product) / period**2
    return k_p, (1.0 - product) / period + 0.5 * k_p * period


class Loop:
    """The joint motion of (ε, q) for many gains at once, as matrices (docs/guard.md, section 3).

    Attributes:
        step: of (ε, q), (n, 4, 4).
        pushes, told: how w̃ and η enter, (n, 4, 2).
        outputs: rows of POSITION to PREDICTED, (n, 4, 4).
        free: position and velocity rows of the last `delay` pulses, which no feedback knows of, (delay, 2, 2).
        left: 1 − l_r and 1 − l_v, (n, 2).

    """

    def __init__(self, period: float, delay: int, gains: Float[np.ndarray, "n 4"]) -> None:
        first_pole, second_pole, l_r, l_v = gains.T
        count, zero = len(gains), np.zeros(len(gains))
        Phi = np.array([[1.0, period], [0.0, 1.0]])
        ahead = np.linalg.matrix_power(Phi, delay)
        K = -np.stack(feedback_gains(period, first_pole, second_pole), axis=-1)
        M = Phi + np.array([0.5 * period**2, period])[:, None] * K[:, None, :]
        H = np.stack([np.stack([l_r, (1.0 - l_r) * period], -1), np.stack([zero, l_v], -1)], axis=-2)
        kept = np.eye(2) - H
        heard = ahead @ H
        self.period, self.delay, self.gains = period, delay, gains
        self.left = 1.0 - gains[:, 2:]
        self.step = np.zeros((count, 4, 4))
        self.step[:, [0, 1], [0, 1]] = self.left
        self.step[:, 2:, :2] = -heard @ Phi
        self.step[:, 2:, 2:] = M
        self.pushes = np.concatenate([-kept, heard], axis=1)
        self.told = np.concatenate([H, heard], axis=1)
        self.outputs = np.zeros((count, 4, 4))
        self.outputs[:, POSITION:FEEDBACK, :2] = -ahead
        self.outputs[:, POSITION:FEEDBACK, 2:] = np.eye(2)
        self.outputs[:, FEEDBACK, 2:] = K
        self.outputs[:, PREDICTED, 2] = 1.0
        self.free = np.array([np.linalg.matrix_power(Phi, i) for i in range(delay)]).reshape(delay, 2, 2)

    def rows(self, outputs: Sequence[int], times: int | None) -> Float[np.ndarray, "n outputs times 4"]:
        """Give the outputs' responses to (ε, q) 0, 1, 2 … steps before: `times` of them, or until they are lost."""
        row = self.outputs[:, outputs]
        found = [row]
        while len(found) < times if times is not None else np.abs(row).max() > _SMALL:
            row = row @ self.step
            found.append(row)
        return np.stack(found, axis=2)


def before(
    loop: Loop, start: Float[np.ndarray, "n outputs times 2"], ages: int
) -> tuple[Float[np.ndarray, "n outputs times ages"], Float[np.ndarray, "n outputs times 2"]]:
    """Responses to what came before the plan was made, where its start's error ε is answered by the row `start`.

    Returns:
        Those to the disturbance of each step before, the last first; and sums of those to the errors told before. An
        observer that began k steps before is covered: its first error counts |start ((I − H) Φ)ᵏ|, and what that passes
        the sum of all that would have come before by is added (the position's part of both is the same).

    """
    r, v = start[..., :1], start[..., 1:]
    shape = (len(start), 1, 1, 1)
    l_v, alpha, beta = loop.gains[:, 3].reshape(shape), *(loop.left[:, i].reshape(shape) for i in (0, 1))
    age = np.arange(ages)
    slow, fast = r * loop.period * alpha ** (age + 1), v * beta**age
    # The disturbance's line at a step's end and at its beginning.
    pulses = 0.5 * loop.period * line_size(slow - beta * fast, -beta * fast)
    told = np.abs(slow + l_v * fast)
    rest = np.flip(np.cumsum(np.flip(told, axis=-1), axis=-1), axis=-1)
    more = np.maximum(np.max(np.abs(fast) - rest, axis=-1), 0.0)
    return pulses, np.stack([np.abs(r[..., 0]), rest[..., 0] + more], axis=-1)


def largest_window(pulses: Float[np.ndarray, "*shape steps"], length: int) -> Float[np.ndarray, "*shape steps+1"]:
    """Largest sum of at most `length` consecutive pulses among the first 0, 1, 2 … of them."""
    total = np.concatenate([np.zeros((*pulses.shape[:-1], 1)), np.cumsum(pulses, axis=-1)], axis=-1)
    first = np.maximum(np.arange(total.shape[-1]) - length, 0)
    return np.maximum.accumulate(total - total[..., first], axis=-1)


@lru_cache(maxsize=128)
def responses(period: float, delay: int, gains: Gains, fault_steps: int) -> Responses:
    """Give all of the radii that depends on period, delay, gains and a fault's length alone."""
    loop = Loop(period, delay, np.array([gains]))
    rows = loop.rows(range(4), None)
    ages = int(np.ceil(np.log(_SMALL) / np.log(max(loop.left.max(), 1e-3)))) + 1
    under_way = np.zeros((1, 4, delay, 2))
    under_way[0, POSITION:FEEDBACK] = -loop.free.swapaxes(0, 1)
    start = np.concatenate([under_way, rows[..., :2]], axis=2)
    free = np.zeros((1, 4, delay))
    free[0, POSITION:FEEDBACK] = line_integral(loop.free, period).T
    pulses = np.concatenate([free, line_integral(rows @ loop.pushes[:, None], period)], axis=2)[..., :-1]
    noise = np.concatenate([np.zeros((1, 4, delay + 1, 2)), np.abs(rows @ loop.told[:, None])[..., :-1, :]], axis=2)
    pushed = np.concatenate([np.zeros((1, 4, 1)), np.cumsum(pulses, axis=-1)], axis=-1)
    struck = largest_window(pulses, fault_steps)
    pushed_before, noisy_before = np.zeros_like(pushed), np.zeros_like(start)
    for output in range(4):
        past, noisy_before[:, output] = (a[:, 0] for a in before(loop, start[:, output : output + 1], ages))
        pushed_before[:, output] = past.sum(axis=-1)
        ever = np.maximum(struck[:, output], largest_window(past, fault_steps)[..., -1])
        for since in range(1, fault_steps):
            # A fault that lasts over the making of the plan: `since` of its steps come after that.
            after = pushed[:, output] - pushed[:, output, np.maximum(np.arange(pushed.shape[-1]) - since, 0)]
            ever = np.maximum(ever, after + past[..., : fault_steps - since].sum(axis=-1))
        struck[:, output] = ever
    return Responses((pushed + pushed_before)[0], (np.cumsum(noise, axis=2) + noisy_before)[0], struck[0])


AT_REST = 40.0
"""Weight of ρ against the stop length where the estimate has errors: ρ is kept everywhere, the stop length at speed."""
_DIGITS = 2
"""Of the numbers that the search is made for: guards whose numbers are near share it. No radius is rounded."""
_TIMES, _AGES = 160, 120
"""Steps after and before the plan is made that the search looks at; the radii of what it chooses look at all."""
_LOOKED_AT = np.array([0, 1, 2, 3, 4, 6, 8, 11, 15, 20, 27, 36, 48, 64, 90, _TIMES - 1])
_LEAST, _MOST = 0.04, 1.0
"""Of l_r, l_v and of 1 less a pole: what is slower is forgotten too late."""
_ROUNDS = 5


@dataclass(frozen=True)
class Task:
    """What gains are asked for.

    In the theorem's letters: T (s), n, D (m/s²), ε_r (m), ε_v (m/s), F_max/m (m/s²), V̄ (m/s), and a fault's push (m/s²)
    and steps.
    """

    period: float
    delay: int
    disturbance: float
    position_error: float
    velocity_error: float
    authority: float
    speed: float
    fault: float
    fault_steps: int

    def rounded(self) -> "Task":
        """Give the task with `_DIGITS` digits for every number but period, delay and steps."""
        near = {
            name: float(f"{value:.{_DIGITS - 1}e}")
            for name, value in vars(self).items()
            if isinstance(value, float) and name != "period"
        }
        return Task(**{**vars(self), **near})


@lru_cache(maxsize=256)
def least_room(task: Task) -> Gains:
    """Search gains for the least stop length + `AT_REST` ρ, or, where none can hold, for the least feedback.

    First on a grid, then on ever finer grids about the best found. Whatever is found, the radii belong to it.
    """
    slow = 1.0 - np.array([0.05, 0.3, 0.6, 0.8, 0.9, 0.95])
    pairs = list(itertools.combinations_with_replacement(slow, 2))
    grid = [(*pair, l_r, l_v) for pair in pairs for l_r in (1.0, 0.4, 0.15, 0.06) for l_v in (1.0, 0.5, 0.15)]
    found = np.log(np.array(grid))
    best, least = found[0], (math.inf, math.inf)
    shifts = np.array(list(itertools.product((-1.0, 0.0, 1.0), repeat=4)))
    size = 0.35
    for _ in range(_ROUNDS + 1):
        found = np.clip(found, math.log(_LEAST), math.log(_MOST))
        needed = _needed(task, np.exp(found))
        order = np.lexsort(needed)
        first = (float(needed[1, order[0]]), float(needed[0, order[0]]))
        if first < least:
            best, least = found[order[0]], first
        found = best + size * shifts
        size *= 0.55
    first_left, second_left, l_r, l_v = np.exp(best)
    return float(1.0 - first_left), float(1.0 - second_left), float(l_r), float(l_v)


def _needed(task: Task, left: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "2 n"]:
    """Give feedback (m/s²) and room (m, infinite where the feedback leaves nothing), nearly.

    Asked for by 1 less each pole, l_r and l_v.
    """
    gains = np.concatenate([1.0 - left[:, :2], left[:, 2:]], axis=1)
    loop = Loop(task.period, task.delay, gains)
    rows = loop.rows((POSITION, FEEDBACK), _TIMES)
    errors = np.array([task.position_error, task.velocity_error])
    pulses = line_integral(rows @ loop.pushes[:, None], task.period)
    each = task.disturbance * pulses + np.abs(rows @ loop.told[:, None]) @ errors
    since = np.cumsum(each, axis=-1) - each
    free = line_integral(loop.free[:, POSITION], task.period)
    since[:, 0] += task.disturbance * free.sum()
    past, told = before(loop, rows[:, :, _LOOKED_AT, :2], _AGES)
    reach = since[:, :, _LOOKED_AT] + task.disturbance * past.sum(axis=-1) + told @ errors
    if task.fault_steps:
        struck = largest_window(pulses, task.fault_steps)[:, :, _LOOKED_AT]
        reach = reach + task.fault * np.maximum(struck, past[..., : task.fault_steps].sum(axis=-1))
    radius, reserve = reach.max(axis=-1).T
    radius = radius + task.period**2 / 8.0 * (reserve + task.disturbance)
    stop = stop_length(task.speed, np.maximum(task.authority - reserve, 1e-300), task.period, np.fmod)
    return np.stack([reserve, np.where(reserve < task.authority, stop + AT_REST * radius, math.inf)])
