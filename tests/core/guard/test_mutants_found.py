"""Edges of the guard's acceptance that random flights seldom meet, each scanned in fine steps."""

import numpy as np
import pytest
from truths.guarded_worlds import begun, filtered, guard_in, motion_state

from keepout.core.guard.safety_layer import GuardFlag, GuardStatus
from keepout.core.motion.arrays import numbers_as_arrays

GUARD = numbers_as_arrays(guard_in("ball"))
LEAST = float(GUARD.least_value)
OUT = np.full(3, 3.0**-0.5)


def answers(heights, speed, push, jump=0.0):
    """Ask at heights (m) over the ball, at an outward speed (m/s), for a push outward (N), told a place farther out.

    Gives whether a plan is certified after it, the outward acceleration (m/s²), and the status.
    """
    rows = []
    for height in heights:
        own = motion_state((2.0 + height) * OUT, speed * OUT)
        told = motion_state((2.0 + height + jump) * OUT, speed * OUT)
        memory, force, status = filtered(GUARD, begun(GUARD, own), told, push * OUT)
        rows.append((bool(memory.certified), float(force @ OUT) / 20.0, int(status)))
    return map(np.array, zip(*rows, strict=True))


@pytest.mark.long
def test_a_step_stays_free_between_its_ends():
    """A chaser that turns round within a step comes nearer than at both of its ends."""
    speed, heights = -0.0025, LEAST + np.arange(0.0, 2e-3, 5e-5)
    certified, acceleration, _ = answers(heights, speed, 0.1)
    time = np.linspace(0.0, 1.0, 101)
    lowest = np.min(heights[:, None] + speed * time + 0.5 * acceleration[:, None] * time**2, axis=1)
    assert 0 < certified.sum() < len(heights)
    assert lowest[certified].min() > LEAST


@pytest.mark.long
def test_a_command_after_a_jump_is_safe_from_where_the_guard_takes_itself_to_be():
    """A state told a little farther out than explained leads to no command that is safe from there alone."""
    heights = LEAST + np.arange(0.0, 0.04, 1e-3)
    _, acceleration, status = answers(heights, 0.0, -1.0, jump=0.9 * float(GUARD.braking.position_radius))
    passed = status == GuardStatus.CLEAR + GuardFlag.STATE_JUMP
    assert 0 < passed.sum() < len(heights)
    # From rest: a step under the command, then a step in which the speed that it left is braked.
    assert (heights + 0.5 * acceleration + 0.5 * acceleration)[passed].min() > LEAST
