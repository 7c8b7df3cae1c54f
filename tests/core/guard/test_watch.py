"""`STATE_JUMP`: what it must see, within how many steps, what it cannot see, and that it is silent otherwise."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from truths.guarded_worlds import ASSUMED, PIECES, advance, units

from keepout.core.guard import watch
from keepout.core.motion.arrays import numbers_as_arrays

AXIS = np.array([0.36, 0.48, 0.8])
NOISY = dataclasses.replace(ASSUMED, position_error=0.01, velocity_error=5e-4)
MOST = 2000
"""Steps of every flight: those that are added are not looked at."""


def flagged(assumed, pushes, position_errors, velocity_errors):
    """Steps in which a coasting chaser is seen to be pushed (steps, PIECES, 3), m/s², and its true path."""
    steps, whole = len(pushes), np.zeros((MOST, PIECES, 3))
    whole[:steps] = pushes
    told = np.zeros((MOST + 1, 2, 3))
    told[: steps + 1] = np.stack([position_errors, velocity_errors], axis=1)
    jumped, path = _flagged(numbers_as_arrays(assumed), watch.windows(assumed), whole, told)
    return np.asarray(jumped)[:steps], np.asarray(path)[:steps]


@eqx.filter_jit
def _flagged(assumed, lengths, pushes, errors):
    def step(carry, row):
        state, expected, watched = carry
        push, error = row
        told = jnp.stack(state) + error
        moved, changed = told - expected
        *watched, jumped = watch.watch(assumed, lengths, *watched, moved, changed)
        *state, path = advance(*state, jnp.zeros(3), push)
        return (tuple(state), told.at[0].add(told[1]), tuple(watched)), (jumped, path)

    rest = (jnp.array([2.56, 0.0, 0.0]), jnp.zeros(3))
    first = rest, jnp.stack(rest) + errors[0], watch.begin(lengths)
    return jax.lax.scan(step, first, (jnp.asarray(pushes), jnp.asarray(errors[1:])))[1]


def constant(size, steps):
    return np.broadcast_to(size * AXIS, (steps, PIECES, 3))


def hiding(assumed, steps):
    """Velocity errors that hide a push along AXIS best: each later sample says too little, the early ones too much."""
    sign = np.where(np.arange(steps + 1) < steps // 2, 1.0, -1.0)
    return assumed.velocity_error * sign[:, None] * AXIS


def test_a_lasting_excess_of_two_hundredths_is_seen():
    steps = watch.seen_within(NOISY, 0.02 * NOISY.disturbance)
    assert steps is not None
    for errors in (hiding(NOISY, steps), -hiding(NOISY, steps), np.zeros((steps + 1, 3))):
        assert flagged(NOISY, constant(1.02 * NOISY.disturbance, steps), 0.0 * errors, errors)[0].any()
    # In no 32 steps can it be told from the errors: a sum begun anew that often never sees it.
    assert 32 * 0.02 * NOISY.disturbance * NOISY.period < 2 * NOISY.velocity_error


@pytest.mark.long
@given(
    share=st.sampled_from([0.01, 0.017, 0.1, 0.5, 3.0]),
    velocity_error=st.sampled_from([0.0, 1e-5, 5e-4, 2e-3]),
    before=st.sampled_from([-1.0, 0.0, 1.0]),
    onset=st.integers(0, 300),
    hidden=st.booleans(),
)
def test_every_lasting_excess_is_seen_within_the_steps_stated(share, velocity_error, before, onset, hidden):
    assumed = dataclasses.replace(NOISY, velocity_error=velocity_error)
    D = assumed.disturbance
    needed = watch.seen_within(assumed, share * D)
    assert needed is not None
    assert needed < 3 * watch.steps_needed(assumed, share * D)
    total = onset + needed + 1
    pushes = np.array(constant((1.0 + share) * D, total))
    pushes[:onset] = before * D * (1 - 1e-9) * AXIS
    # The flag comes with the estimate at the end of a step, so it is looked for one step later.
    errors = np.zeros((total + 1, 3))
    if hidden:
        errors[:] = -velocity_error * AXIS
        errors[: onset + needed // 2] *= -1.0
    found, _ = flagged(assumed, pushes, np.zeros((total + 1, 3)), errors)
    assert not found[: onset + 1].any()
    assert found[onset:].any()


@given(
    seed=st.integers(0, 2**32 - 1),
    kind=st.sampled_from(["constant", "bang-bang", "random"]),
    adversarial=st.booleans(),
)
def test_it_is_silent_while_the_assumptions_hold(seed, kind, adversarial):
    rng, D, steps = np.random.default_rng(seed), NOISY.disturbance * (1 - 1e-9), 600
    pushes = np.array(constant(D, steps))
    if kind == "bang-bang":
        pushes *= np.sign(rng.normal(size=(steps, 1, 1)))
    if kind == "random":
        pushes = D * units(rng, steps, PIECES)
    errors = hiding(NOISY, steps) if adversarial else NOISY.velocity_error * units(rng, steps + 1)
    found, _ = flagged(NOISY, pushes, NOISY.position_error * units(rng, steps + 1), -errors if seed % 2 else errors)
    assert not found.any()


def test_a_pattern_of_zero_mean_within_a_step_is_not_seen():
    # ± 40 N, quarter by quarter: at every sample position and velocity are what no push would have left.
    signs = np.repeat([-1.0, 1.0, 1.0, -1.0], PIECES // 4)
    pushes = np.tile(40.0 / ASSUMED.mass * signs[:, None] * np.array([1.0, 0.0, 0.0]), (50, 1, 1))
    found, path = flagged(ASSUMED, pushes, np.zeros((51, 3)), np.zeros((51, 3)))
    assert not found.any()
    assert np.linalg.norm(path, axis=-1).min() < 2.5, "and the threshold was passed all the same"


def test_what_is_too_small_to_be_seen_is_said_not_to_be():
    lost = dataclasses.replace(NOISY, disturbance_force=0.0, angular_rate=0.0, gravity_gradient=0.0)
    assert watch.seen_within(lost, 1e-9) is None
    assert watch.seen_within(NOISY, 1e-7 * NOISY.disturbance) is None
