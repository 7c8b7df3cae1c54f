"""The guard broken on purpose: each break must be caught by a check that the whole guard passes."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from truths.guarded_worlds import ASSUMED, WORLDS, fly_batch, fly_too_fast

from keepout.guard.guard import Guard

THRESHOLD = 0.5


class HalfTube(Guard):
    """Keeps half the tube's radius free around a plan."""

    @property
    def least_value(self):
        return self.threshold + 0.5 * self.lipschitz * self.braking.position_radius


class NoPath(Guard):
    """Takes every braking path to be free."""

    def _free(self, *_):
        return jnp.asarray(True)


class LastSpeedOnly(Guard):
    """Looks at the speed at the end of the commands under way, not before it."""

    def _free(self, position, value, points, velocities, *rest):
        return super()._free(position, value, points, velocities[-1:], *rest)


def too_near(kind):
    """Count certified flights that pass the threshold, under a steady push of norm D and full thrust into the body."""
    guard = kind(WORLDS["ball"], threshold=THRESHOLD, lipschitz=1.0, assumptions=ASSUMED)
    certified, (_, _, _, lowest, *_) = fly_batch(
        guard, 3, 150, steps=300, size=ASSUMED.disturbance * (1 - 1e-9), kind="constant", intent="into the body"
    )
    assert np.asarray(certified).sum() > 15
    return int((np.asarray(lowest)[np.asarray(certified)].min(axis=1) <= THRESHOLD).sum())


def too_fast(kind):
    """Count flights that pass the speed limit after the guard has certified a plan, with a delay of three steps."""
    assumed = dataclasses.replace(ASSUMED, delay=3, disturbance_force=0.004)
    certified, _, speed = fly_too_fast(kind(WORLDS["ball"], THRESHOLD, 1.0, assumed), 5, 200)
    promised = np.maximum.accumulate(certified, axis=1)
    return int(((speed > assumed.speed_limit) & promised).any(axis=1).sum())


@pytest.mark.long
@pytest.mark.parametrize(("broken", "count"), [(HalfTube, too_near), (NoPath, too_near), (LastSpeedOnly, too_fast)])
def test_the_break_is_caught_and_the_whole_guard_passes(broken, count):
    assert count(broken) > 0
    assert count(Guard) == 0
