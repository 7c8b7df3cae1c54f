"""What the guard answers, one situation at a time."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from truths.guarded_worlds import ASSUMED, WORLDS, advance, motion_state

from keepout.errors import ControlError
from keepout.guard.guard import Guard
from keepout.guard.start import require_flyable
from keepout.guard.status import GuardFlag, GuardStatus

GUARD = Guard(WORLDS["ball"], threshold=0.5, lipschitz=1.0, assumptions=ASSUMED)
STILL = jnp.zeros(3)
step = eqx.filter_jit(lambda *a: GUARD.filter(*a))
first = eqx.filter_jit(lambda state: GUARD.initial_state(state))


def at(*position, velocity=(0.0, 0.0, 0.0)):
    return motion_state(jnp.array(position, float), jnp.array(velocity, float))


def answer(state, force, disturbance=STILL, told=None):
    return step(first(state), told or state, jnp.asarray(force, float), disturbance)


def test_a_harmless_command_passes_unchanged():
    _, force, status = answer(at(5.0, 0, 0), [0.05, -0.1, 0.02])
    np.testing.assert_allclose(force, [0.05, -0.1, 0.02], rtol=1e-14)
    assert status == GuardStatus.CLEAR


def test_a_command_beyond_the_thrusters_is_cut():
    _, force, status = answer(at(5.0, 0, 0), [0.5, 0.0, -7.0])
    np.testing.assert_allclose(force, [0.1, 0.0, -0.1], rtol=1e-14)
    assert status == GuardStatus.CLEAR


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_command_that_is_no_number_is_replaced_by_braking(bad):
    _, force, status = answer(at(5.0, 0, 0, velocity=(0.0, 0.1, 0.0)), [bad, 0, 0])
    assert status == GuardStatus.BRAKING + GuardFlag.COMMAND
    np.testing.assert_allclose(force, [0, -20 * GUARD.braking.deceleration, 0], rtol=1e-9)


def test_an_estimate_that_is_no_number_leaves_the_plan():
    moving = at(5.0, 0, 0, velocity=(0.0, 0.1, 0.0))
    state, force, status = answer(moving, [0.1, 0, 0], told=at(np.nan, 0, 0))
    assert status == GuardStatus.BRAKING + GuardFlag.ESTIMATE
    np.testing.assert_allclose(force, [0, -20 * GUARD.braking.deceleration, 0], rtol=1e-9)
    assert bool(state.certified)


def test_flags():
    assert answer(at(5.0, 0, 0), [0, 0, 0], disturbance=jnp.array([0.0215, 0, 0]))[2] == GuardFlag.DISTURBANCE
    assert answer(at(5.0, 0, 0), [0, 0, 0], disturbance=jnp.array([0.0142, 0, 0]))[2] == 0
    # Where nothing pushes, what an observer leaves of the drift is no disturbance.
    calm = dataclasses.replace(GUARD.assumptions, disturbance_force=0.0)
    quiet = Guard(GUARD.field, GUARD.threshold, GUARD.lipschitz, calm)
    drift = calm.mass * calm.drift
    judged = eqx.filter_jit(lambda state, told: quiet.filter(quiet.initial_state(state), state, STILL, told))
    for share, flags in ((0.9, 0), (1.1, GuardFlag.DISTURBANCE)):
        told = jnp.array([share * drift, 0.0, 0.0])
        assert judged(at(5.0, 0, 0), told)[2] == flags
    status = answer(at(2.45, 0, 0), [0, 0, 0])[2]
    assert status & GuardFlag.FIELD
    assert status & 3 == GuardStatus.ESCAPING
    assert answer(at(41.0, 0, 0), [0, 0, 0])[2] & GuardFlag.REGION
    state, _, _ = answer(at(5.0, 0, 0), [0, 0, 0])
    assert step(state, at(5.01, 0, 0), STILL, STILL)[2] & GuardFlag.STATE_JUMP
    assert not step(state, at(5.0 + 5e-4, 0, 0, velocity=(1e-3, 0, 0)), STILL, STILL)[2] & GuardFlag.STATE_JUMP


@pytest.mark.long
def test_escape_leaves_the_margin_and_ends_certified():
    state = at(2.3, 0, 0, velocity=(-0.01, 0, 0))
    memory, moved = first(state), eqx.filter_jit(advance)
    assert not bool(memory.certified)
    statuses, lowest, field = [], np.inf, eqx.filter_jit(GUARD.field.value)
    for _ in range(60):
        memory, force, status = step(memory, state, jnp.array([-0.1, 0, 0]), STILL)
        r, v, path = moved(state.position, state.velocity, force / 20.0, jnp.zeros((8, 3)))
        lowest = min(lowest, float(field(path).min()))
        state = motion_state(r, v)
        statuses.append(int(status) & 3)
    assert statuses[0] == GuardStatus.ESCAPING
    assert statuses[-1] != GuardStatus.ESCAPING
    assert bool(memory.certified)
    assert float(GUARD.field.value(state.position)) > 0.5
    assert lowest > 0.27


def test_requirements():
    assert require_flyable(GUARD, at(5.0, 0, 0), jnp.array([0, 3.0, 0]))
    assert not require_flyable(GUARD, at(2.4, 0, 0), jnp.array([0, 3.0, 0]))
    with pytest.raises(ControlError, match=r"0\.510 m at the goal"):
        require_flyable(GUARD, at(5.0, 0, 0), jnp.array([0, 2.51, 0]))
    with pytest.raises(ControlError, match="inside the target"):
        require_flyable(GUARD, at(1.0, 0, 0), jnp.array([0, 3.0, 0]))
    with pytest.raises(ControlError, match=r"start.position is \[nan"):
        require_flyable(GUARD, at(np.nan, 0, 0), jnp.array([0, 3.0, 0]))
    with pytest.raises(ControlError, match="range_limit is 40"):
        require_flyable(GUARD, at(5.0, 0, 0), jnp.array([0, 43.0, 0]))


@pytest.mark.parametrize(
    ("name", "value"),
    [("mass", -1.0), ("mass", np.nan), ("period", 0.0), ("disturbance_force", -0.1), ("mass_error", 1.0), ("delay", 9)],
)
def test_assumptions_out_of_range_are_refused(name, value):
    with pytest.raises(ControlError, match=f"guard: {name} is"):
        dataclasses.replace(ASSUMED, **{name: value})


def test_weak_thrusters_are_refused():
    weak = dataclasses.replace(ASSUMED, force_limit=0.02)
    with pytest.raises(ControlError, match=r"force_limit is 0\.02 N"):
        Guard(WORLDS["ball"], threshold=0.5, lipschitz=1.0, assumptions=weak)


def test_more_than_twenty_field_values_are_refused():
    with pytest.raises(ControlError, match="from 1 to 18"):
        Guard(WORLDS["ball"], threshold=0.5, lipschitz=1.0, assumptions=ASSUMED, samples=19)
