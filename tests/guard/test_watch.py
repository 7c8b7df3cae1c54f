"""`STATE_JUMP`: what it must see, within how many steps, what it cannot see, and that it is silent otherwise."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from truths.guarded_worlds import ASSUMED, PIECES, WORLDS, advance, motion_state, of_any_numbers

from keepout.guard import watch
from keepout.guard.guard import Guard
from keepout.guard.status import GuardFlag

AXIS = np.array([0.36, 0.48, 0.8])
NOISY = dataclasses.replace(ASSUMED, position_error=0.01, velocity_error=5e-4)


def told(assumed, pushes, position_errors, velocity_errors, start=(20.0, 0.0, 0.0)):
    """Steps in which a chaser far out raises STATE_JUMP, and its true path: pushes (steps, PIECES, 3), m/s²."""
    guard = Guard(WORLDS["ball"], threshold=0.5, lipschitz=1.0, assumptions=assumed)
    status, path = _told(
        of_any_numbers(guard), *map(jnp.asarray, (pushes, position_errors, velocity_errors, np.asarray(start)))
    )
    return np.asarray(status) & GuardFlag.STATE_JUMP != 0, np.asarray(path)


@eqx.filter_jit
def _told(guard, pushes, position_errors, velocity_errors, start):
    def step(carry, row):
        r, v, memory = carry
        push, off_position, off_velocity = row
        estimate = motion_state(r + off_position, v + off_velocity)
        memory, force, status = guard.filter(memory, estimate, jnp.zeros(3), jnp.zeros(3))
        r, v, path = advance(r, v, force / guard.assumptions.mass, push)
        return (r, v, memory), (status, path)

    memory = guard.initial_state(motion_state(start + position_errors[0], velocity_errors[0]))
    return jax.lax.scan(step, (start, jnp.zeros(3), memory), (pushes, position_errors[1:], velocity_errors[1:]))[1]


def constant(size, steps):
    return np.broadcast_to(size * AXIS, (steps, PIECES, 3))


def hiding(assumed, steps):
    """Velocity errors that hide a push along AXIS best: each later sample says too little, the early ones too much."""
    sign = np.where(np.arange(steps + 1) < steps // 2, 1.0, -1.0)
    return assumed.velocity_error * sign[:, None] * AXIS


@pytest.mark.long
def test_a_lasting_excess_of_two_hundredths_is_seen():
    steps = watch.seen_within(NOISY, 0.02 * NOISY.disturbance)
    assert steps is not None
    for errors in (hiding(NOISY, steps), -hiding(NOISY, steps), np.zeros((steps + 1, 3))):
        flagged, _ = told(NOISY, constant(1.02 * NOISY.disturbance, steps), 0.0 * errors, errors)
        assert flagged.any()
    # In no 32 steps can it be told from the errors: a sum begun anew that often never sees it.
    assert 32 * 0.02 * NOISY.disturbance * NOISY.period < 2 * NOISY.velocity_error


LASTING = given(
    share=st.sampled_from([0.01, 0.017, 0.1, 0.5, 3.0]),
    velocity_error=st.sampled_from([0.0, 1e-5, 5e-4, 2e-3]),
    before=st.sampled_from([-1.0, 0.0, 1.0]),
    onset=st.integers(0, 300),
    hidden=st.booleans(),
)
ADMISSIBLE = given(
    seed=st.integers(0, 2**32 - 1),
    kind=st.sampled_from(["constant", "bang-bang", "random"]),
    adversarial=st.booleans(),
)
FEW, MANY = settings(max_examples=8, deadline=None), settings(max_examples=200, deadline=None)


def check_seen(share, velocity_error, before, onset, hidden):
    assumed = dataclasses.replace(NOISY, velocity_error=velocity_error)
    D = assumed.disturbance
    needed = watch.seen_within(assumed, share * D)
    assert needed is not None
    assert needed < 3 * watch.steps_needed(assumed, share * D)
    total = 300 + watch.seen_within(dataclasses.replace(NOISY, velocity_error=2e-3), 0.01 * D)
    pushes = np.array(constant((1.0 + share) * D, total))
    pushes[:onset] = before * D * (1 - 1e-9) * AXIS
    # The flag comes with the estimate at the end of a step, so it is looked for one step later.
    errors = np.zeros((total + 1, 3))
    if hidden:
        errors[:] = -velocity_error * AXIS
        errors[: onset + needed // 2] *= -1.0
    flagged, _ = told(assumed, pushes, np.zeros((total + 1, 3)), errors)
    assert not flagged[: onset + 1].any()
    assert flagged[onset : onset + needed + 1].any()


def check_silent(seed, kind, adversarial):
    assumed, steps = NOISY, 600
    rng = np.random.default_rng(seed)
    D = assumed.disturbance * (1 - 1e-9)

    def unit(*shape):
        v = rng.normal(size=(*shape, 3))
        return v / np.linalg.norm(v, axis=-1, keepdims=True)

    pushes = np.array(constant(D, steps))
    if kind == "bang-bang":
        pushes *= np.sign(rng.normal(size=(steps, 1, 1)))
    if kind == "random":
        pushes = D * unit(steps, PIECES)
    errors = hiding(assumed, steps) if adversarial else assumed.velocity_error * unit(steps + 1)
    flagged, _ = told(assumed, pushes, assumed.position_error * unit(steps + 1), -errors if seed % 2 else errors)
    assert not flagged.any()


test_every_lasting_excess_is_seen_within_the_steps_stated = pytest.mark.long(FEW(LASTING(check_seen)))
test_it_is_silent_while_the_assumptions_hold = pytest.mark.long(FEW(ADMISSIBLE(check_silent)))
test_many_lasting_excesses = pytest.mark.slow(MANY(LASTING(check_seen)))
test_it_is_silent_many_times = pytest.mark.slow(MANY(ADMISSIBLE(check_silent)))


def test_a_pattern_of_zero_mean_within_a_step_is_not_seen():
    # ± 40 N, quarter by quarter: at every sample position and velocity are what no push would have left.
    steps, start = 50, np.array([2.56, 0.0, 0.0])
    signs = np.repeat([-1.0, 1.0, 1.0, -1.0], PIECES // 4)
    pushes = np.broadcast_to(40.0 / ASSUMED.mass * signs[:, None] * np.array([1.0, 0.0, 0.0]), (steps, PIECES, 3))
    still = np.zeros((steps + 1, 3))
    flagged, path = told(ASSUMED, pushes, still, still, start)
    assert not flagged.any()
    assert np.linalg.norm(path, axis=-1).min() < 2.5, "and the threshold was passed all the same"


def test_windows_double_up_to_what_the_errors_ask():
    assert watch.windows(ASSUMED) == (1,)
    lengths = watch.windows(NOISY)
    assert lengths == tuple(2**k for k in range(len(lengths)))
    assert lengths[-2] < watch.steps_needed(NOISY, watch.SHARE * NOISY.disturbance) <= lengths[-1]
    lost = dataclasses.replace(NOISY, disturbance_force=0.0, angular_rate=0.0, gravity_gradient=0.0)
    assert watch.windows(lost)[-1] == watch.LONGEST
    assert watch.seen_within(lost, 1e-9) is None
    assert watch.seen_within(NOISY, 1e-7 * NOISY.disturbance) is None
