"""What the guard measures of its own assumption ‖w‖ ≤ D: flag `STATE_JUMP` (docs/guard.md, section 5).

Over any c steps the estimated velocities differ from what the commands explain by at most c T D + 2 ε_v, as the errors
of the samples between cancel. The longer the window, the smaller the excess that cannot hide behind ε_v; the shorter,
the sooner a large one is seen. So several windows run at once, each twice as long as the one before.
"""

import math

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from keepout.guard.braking import GuardAssumptions

SHARE = 0.01
"""A lasting excess of this share of D is within reach of the longest window, unless that would pass `LONGEST`."""
LONGEST = 2**14
"""Steps in the longest window that is ever run."""
_LOOSE, _ROUNDING = 1e-6, 1e-9
"""Relative and absolute (m, m/s) slack of the tests, against rounding."""


def steps_needed(assumptions: GuardAssumptions, excess: float) -> float:
    """Count the steps c after which a constant push of D + `excess` (m/s²) is told from D, whatever the errors.

    The least c with c T (D + x) − 2 ε_v above what is allowed in c steps; infinite where rounding hides the excess.
    """
    gained = assumptions.period * (excess - _LOOSE * assumptions.disturbance)
    if gained <= 0.0:
        return math.inf
    return math.floor((2.0 * (2.0 + _LOOSE) * assumptions.velocity_error + _ROUNDING) / gained) + 1.0


def windows(assumptions: GuardAssumptions) -> tuple[int, ...]:
    """Give the windows' lengths in steps: 1, 2, 4, … up to one that sees a lasting excess of `SHARE` of D."""
    lengths = [1]
    needed = steps_needed(assumptions, SHARE * float(assumptions.disturbance)) if assumptions.velocity_error else 1.0
    while lengths[-1] < min(needed, LONGEST):
        lengths.append(2 * lengths[-1])
    return tuple(lengths)


def seen_within(assumptions: GuardAssumptions, excess: float) -> int | None:
    """Count the steps within which a push of D + `excess` (m/s²) or more along one direction is flagged, if it lasts.

    Where c steps are needed, the shortest window of N ≥ c steps begins anew at most N − 1 steps after the push does.
    None: no window is long enough, and such an excess may never be flagged.
    """
    needed = steps_needed(assumptions, excess)
    long_enough = [length for length in windows(assumptions) if length >= needed]
    return int(long_enough[0] - 1 + needed) if long_enough else None


def begin(lengths: tuple[int, ...]) -> tuple[Float[Array, "windows 3"], Int[Array, ""]]:
    """Give the sums of unexplained velocity (m/s) of the windows, and the steps counted, before the first step."""
    return jnp.zeros((len(lengths), 3)), jnp.zeros((), jnp.int32)


def watch(
    assumptions: GuardAssumptions,
    lengths: tuple[int, ...],
    unexplained: Float[Array, "windows 3"],
    counted: Int[Array, ""],
    moved: Float[Array, "3"],
    changed: Float[Array, "3"],
) -> tuple[Float[Array, "windows 3"], Int[Array, ""], Bool[Array, ""]]:
    """Test one more step.

    Args:
        assumptions: of the guard.
        lengths: of the windows that follow from them, in steps.
        unexplained: for each window, the velocity since it was begun that no command accounts for, m/s.
        counted: steps since the longest window was begun.
        moved: the position told less the one expected without a disturbance, m.
        changed: the same of the velocity, m/s.

    Returns:
        The sums and the count with this step in them, and whether an assumption was seen not to hold.

    """
    a, T = assumptions, assumptions.period
    place = counted % jnp.asarray(lengths, jnp.int32)
    unexplained = jnp.where((place == 0)[:, None], 0.0, unexplained) + changed
    allowed = a.disturbance * T * (place + 1) + 2.0 * a.velocity_error
    pushed = jnp.any(jnp.linalg.norm(unexplained, axis=-1) > allowed * (1.0 + _LOOSE) + _ROUNDING)
    shift = 0.5 * a.disturbance * T**2 + 2.0 * a.position_error + T * a.velocity_error
    jumped = jnp.linalg.norm(moved) > shift * (1.0 + _LOOSE) + _ROUNDING
    return unexplained, (counted + 1) % lengths[-1], jumped | pushed
