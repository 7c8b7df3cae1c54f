"""Which gains the guard's observer and its feedback take: those that need least room (docs/guard.md, section 3)."""

import itertools
import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float

from keepout.core.guard.responses import FEEDBACK, POSITION, Gains, Loop, before, largest_window, line_integral

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
    a_b = np.maximum(task.authority - reserve, 1e-300)
    rest = np.fmod(task.speed, a_b * task.period)
    stop = (task.speed**2 - rest**2) / (2.0 * a_b) + 0.5 * rest * task.period
    return np.stack([reserve, np.where(reserve < task.authority, stop + AT_REST * radius, math.inf)])
