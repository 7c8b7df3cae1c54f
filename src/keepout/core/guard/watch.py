"""What the guard measures of its own assumptions: `STATE_JUMP`, `DISTURBANCE`, `REGION`, `EXPIRED` (docs/guard.md, 5).

`watch` is the exact test, of ‖w‖ ≤ D. Over any c steps the estimated velocities differ from what the commands explain
by at most c T D and the errors of the first and the last, 2 ε_v at most, as those of the samples between cancel. The
longer the window, the smaller the excess that cannot hide behind ε_v; the shorter, the sooner a large one is seen. So
several windows run at once, each twice as long as the one before.
"""

import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from keepout.core.guard.braking import GuardAssumptions, Number
from keepout.core.motion.arrays import Flag, Vector

SHARE = 0.01
"""A lasting excess of this share of D is within reach of the longest window, unless that would pass `LONGEST`."""
LONGEST = 2**14
"""Steps in the longest window that is ever run."""
_LOOSE, _ROUNDING = 1e-6, 1e-9
"""Relative and absolute (m, m/s) slack of the tests, against rounding."""


class Doubts(eqx.Module):
    """Errors of the estimates that the tests compare, where they differ from step to step.

    Attributes:
        last: bounds ε_r (m) and ε_v (m/s) of the estimate told last.
        begun: ε_v of the estimate with which each window was begun, m/s.

    """

    last: Float[Array, "2"]
    begun: Float[Array, "windows"]


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


def next_doubts(lengths: tuple[int, ...], counted: Int[Array, ""], doubts: Doubts, errors: Float[Array, "2"]) -> Doubts:
    """Take the errors (m, m/s) of the estimate told now; `watch` needs what was before and what is then."""
    anew = counted % jnp.asarray(lengths, jnp.int32) == 0
    return Doubts(errors, jnp.where(anew, doubts.last[1], doubts.begun))


def watch(
    assumptions: GuardAssumptions,
    lengths: tuple[int, ...],
    unexplained: Float[Array, "windows 3"],
    counted: Int[Array, ""],
    moved: Vector,
    changed: Vector,
    doubts: tuple[Doubts, Doubts] | None = None,
) -> tuple[Float[Array, "windows 3"], Int[Array, ""], Flag]:
    """Test one more step.

    Args:
        assumptions: of the guard.
        lengths: of the windows that follow from them, in steps.
        unexplained: for each window, the velocity since it was begun that no command accounts for, m/s.
        counted: steps since the longest window was begun.
        moved: the position told less the one expected without a disturbance, m.
        changed: the same of the velocity, m/s.
        doubts: as of the step before, and as of this; without them every estimate's errors are those assumed.

    Returns:
        The sums and the count with this step in them, and whether an assumption was seen not to hold.

    """
    a, T = assumptions, assumptions.period
    place = counted % jnp.asarray(lengths, jnp.int32)
    unexplained = jnp.where((place == 0)[:, None], 0.0, unexplained) + changed
    if doubts is None:
        turned, shifted = 2.0 * a.velocity_error, 2.0 * a.position_error + T * a.velocity_error
    else:
        before, now = doubts
        turned = now.begun + now.last[1]
        shifted = before.last[0] + now.last[0] + T * before.last[1]
    allowed = a.disturbance * T * (place + 1) + turned
    pushed = jnp.any(jnp.linalg.norm(unexplained, axis=-1) > loosened(allowed))
    jumped = jnp.linalg.norm(moved) > loosened(0.5 * a.disturbance * T**2 + shifted)
    return unexplained, (counted + 1) % lengths[-1], jumped | pushed


def loosened(bound: Number | Float[Array, "windows"]) -> Number | Float[Array, "windows"]:
    """Give a bound (m or m/s) with the slack that rounding needs."""
    return bound * (1.0 + _LOOSE) + _ROUNDING


def too_strong(assumptions: GuardAssumptions, disturbance_estimate: Vector) -> Flag:
    """Whether a law's estimate (N) of the disturbance is above what is assumed: flag `DISTURBANCE`."""
    a = assumptions
    # An observer overshoots, takes noise and scale errors for a force, and, where there is next to none of these,
    # what its own model leaves of the drift; `watch` is the exact test.
    seen = 1.5 * a.mass * (a.disturbance - a.drift + 2.0 * a.velocity_error / a.period)
    return ~(jnp.linalg.norm(disturbance_estimate) <= jnp.maximum(seen, a.mass * a.drift))


def outside_region(assumptions: GuardAssumptions, position: Vector, velocity: Vector) -> Flag:
    """Whether what is told (m, m/s) is beyond the range or speed within which the drift is bounded: flag `REGION`."""
    a = assumptions
    far = jnp.linalg.norm(position) > a.range_limit + a.position_error
    return far | (jnp.linalg.norm(velocity) > a.speed_limit + a.velocity_error)
