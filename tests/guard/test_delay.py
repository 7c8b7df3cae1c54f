"""Commands that take effect late: what the law is shown, and what the guard still sees beyond estimate errors."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from truths.guarded_worlds import ASSUMED, WORLDS, directions, motion_state

from keepout.control import profiles
from keepout.control.delay import AheadOfDelay
from keepout.errors import ControlError
from keepout.fields.analytic import SphereField
from keepout.flight import FlightSetup, fly
from keepout.flight.faults import DelayedCommands
from keepout.guard.guard import WATCHED, Guard, GuardFlag, flag_names
from keepout.motion import ConstantDisturbance, Orbit, RelativeMotion, Thrusters

PUSH = np.array([0.01, -0.008, 0.006])
FIELD = SphereField(jnp.zeros(3), jnp.asarray(2.0))


def delayed_setup(delay, told):
    motion = RelativeMotion(Orbit(42_164_000.0))
    law = profiles.default(
        FIELD,
        error_bound=0.01,
        chaser_radius=0.5,
        margin=0.1,
        goal=np.array([0.0, -6.0, 0.0]),
        motion=motion,
        mass=20.0,
        force_limit=0.1,
        speed_limit=0.1,
        period=1.0,
        disturbance_bound=0.0142,
        guidance="straight",
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


def flags_under(push, assumed, errors, seed, steps=3 * WATCHED):
    """Which flags a chaser raises that coasts far out under a steady push, m/s², with errors of its estimate."""
    guard = Guard(WORLDS["ball"], threshold=0.5, lipschitz=1.0, assumptions=assumed)
    generator = np.random.default_rng(seed)
    off_position = errors[0] * directions(generator, steps + 1)
    off_velocity = errors[1] * directions(generator, steps + 1)
    start = jnp.array([20.0, 0.0, 0.0])

    @eqx.filter_jit
    def flown(push):
        def step(carry, row):
            r, v, memory = carry
            memory, force, status = guard.filter(
                memory, motion_state(r + row[0], v + row[1]), jnp.zeros(3), jnp.zeros(3)
            )
            u = force / 20.0 + push
            return (r + v + 0.5 * u, v + u, memory), status

        memory = guard.initial_state(motion_state(start + off_position[0], off_velocity[0]))
        return jax.lax.scan(step, (start, jnp.zeros(3), memory), (off_position[1:], off_velocity[1:]))[1]

    return np.asarray(flown(jnp.asarray(push)))


@pytest.mark.long
def test_a_push_beyond_the_bound_is_seen_through_estimate_errors():
    errors = (0.01, 1e-3)
    assumed = dataclasses.replace(ASSUMED, position_error=errors[0], velocity_error=errors[1])
    D = assumed.disturbance
    for seed in range(3):
        assert not np.any(flags_under([0.0, D * (1 - 1e-9), 0.0], assumed, errors, seed) & GuardFlag.STATE_JUMP)
        # 30 % beyond the bound is less than the errors of two samples, and is seen all the same.
        assert 2 * errors[1] > 0.3 * D
        status = flags_under([0.0, 1.3 * D, 0.0], assumed, errors, seed)
        first = int(np.argmax(status & GuardFlag.STATE_JUMP != 0))
        assert 0 < first < 2 * WATCHED
        assert "state_jump" in flag_names(int(np.bitwise_or.reduce(status)))
