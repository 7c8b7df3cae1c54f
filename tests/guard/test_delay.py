"""Commands that take effect late: what the law is shown."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from truths.guarded_worlds import ASSUMED
from truths.operations import operation

from keepout.control import profiles
from keepout.control.delay import AheadOfDelay
from keepout.control.guidance.plan import Straight
from keepout.errors import ControlError
from keepout.fields.analytic import SphereField
from keepout.flight import FlightSetup, fly
from keepout.flight.faults import DelayedCommands
from keepout.guard.guard import Guard
from keepout.guard.status import GuardFlag
from keepout.motion import ConstantDisturbance, Orbit, RelativeMotion, Thrusters

PUSH = np.array([0.01, -0.008, 0.006])
FIELD = SphereField(jnp.zeros(3), jnp.asarray(2.0))


def delayed_setup(delay, told):
    motion = RelativeMotion(Orbit(42_164_000.0))
    law = profiles.default(
        FIELD, operation(motion=motion, error_bound=0.01), np.array([0.0, -6.0, 0.0]), guidance=Straight()
    )
    if told:
        law = AheadOfDelay(law, motion, 20.0, 1.0, delay)
    assumptions = dataclasses.replace(ASSUMED, delay=delay)
    return FlightSetup(
        motion=motion,
        disturbance=ConstantDisturbance(PUSH),
        thrusters=Thrusters(0.1),
        controller=law,
        goal=np.array([0.0, -6.0, 0.0]),
        mass=20.0,
        guard=Guard(FIELD, threshold=0.5, lipschitz=1.0, assumptions=assumptions),
        faults=DelayedCommands(delay),
    )


@pytest.mark.long
@pytest.mark.parametrize("delay", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_a_law_told_of_the_delay_estimates_the_disturbance_and_arrives(delay):
    setup = delayed_setup(delay, told=True)
    start = setup.motion.initial_state(np.array([3.0, -9.0, 0.0]), np.zeros(3))
    log = fly(setup, start, 400, jax.random.key(0))
    # Under way a constant push is seen as it is; the drift's model error over the delay is all that is left.
    np.testing.assert_allclose(np.asarray(log.disturbance_estimate)[60:], np.broadcast_to(PUSH, (341, 3)), atol=2e-4)
    assert not np.any(np.asarray(log.guard_status) & int(GuardFlag.DISTURBANCE | GuardFlag.STATE_JUMP))
    assert np.linalg.norm(np.asarray(log.position)[-1] - np.asarray(setup.goal)) < 0.1
    assert np.linalg.norm(np.diff(np.asarray(log.velocity)[200:], axis=0), axis=1).max() < 2e-3


def test_a_delay_of_no_steps_is_refused():
    with pytest.raises(ControlError, match="0 periods; it must be at least 1"):
        delayed_setup(0, told=True)
