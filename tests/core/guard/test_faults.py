"""Each fault does what its docstring says, within the bound it states, and the same seed gives the same fault."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from truths.guarded_worlds import WORLDS, motion_state

from keepout.core.control.law import Command, Law
from keepout.core.errors import ScenarioError
from keepout.core.flight.faults import (
    KINDS,
    BrokenLaw,
    CombinedFaults,
    DelayedCommands,
    DroppedCommands,
    GaussianEstimate,
    StuckThruster,
    ThrusterGain,
    WrongEstimate,
)
from keepout.core.flight.setup import NoFaults
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings

KEY = jax.random.key(4)
COMMANDS = np.random.default_rng(0).uniform(-0.1, 0.1, (200, 3))


def passed(fault):
    """What the thrusters give for COMMANDS."""

    def step(state, command_and_time):
        command, time = command_and_time
        state, arrived = fault.command(state, command, time)
        state, given = fault.actuate(state, jnp.clip(arrived, -0.1, 0.1), time)
        return state, given

    times = jnp.arange(float(len(COMMANDS)))
    return np.asarray(jax.lax.scan(step, fault.initial_state(KEY), (jnp.asarray(COMMANDS), times))[1])


def test_faults_of_the_delay_and_of_a_thruster_combine_in_order():
    given = passed(CombinedFaults((DelayedCommands(2), StuckThruster(0, 1, 0.0))))
    expected = np.concatenate([np.zeros((2, 3)), COMMANDS[:-2]])
    expected[:, 0] = np.minimum(expected[:, 0], 0.0)
    np.testing.assert_array_equal(given, expected)


def test_a_dropped_command_leaves_the_one_before():
    given = passed(DroppedCommands(0.3))
    kept = np.all(given == COMMANDS, axis=1)
    assert 0.55 < kept.mean() < 0.85
    np.testing.assert_array_equal(given[1:][~kept[1:]], given[:-1][~kept[1:]])
    np.testing.assert_array_equal(passed(DroppedCommands(0.3)), given)


def test_stuck_thrusters():
    on = passed(StuckThruster(1, 1, 0.1, start=50.0))
    np.testing.assert_array_equal(on[:50], COMMANDS[:50])
    np.testing.assert_allclose(on[50:, 1], 0.1 + np.minimum(COMMANDS[50:, 1], 0.0))
    off = passed(StuckThruster(2, -1, 0.0))
    np.testing.assert_allclose(off[:, 2], np.maximum(COMMANDS[:, 2], 0.0))
    np.testing.assert_array_equal(off[:, :2], COMMANDS[:, :2])
    with pytest.raises(ScenarioError, match="axis 3"):
        StuckThruster(3, 1, 0.1)


def test_gain_is_constant_and_within_its_error():
    factor = passed(ThrusterGain(0.05)) / COMMANDS
    np.testing.assert_allclose(factor, np.broadcast_to(factor[0], factor.shape), rtol=1e-9)
    assert 0.0 < np.abs(factor - 1).max() <= 0.05


def told(fault, steps, key=KEY):
    """Errors of the estimates of a state, (steps, 2, 3)."""
    truth = motion_state([5.0, 1.0, 0.0], [0.1, 0.0, -0.1])

    def step(state, _):
        state, told = fault.estimate(state, truth)
        return state, jnp.stack([told.position - truth.position, told.velocity - truth.velocity])

    return jax.lax.scan(step, fault.initial_state(key), length=steps)[1]


@pytest.mark.long
def test_estimate_errors_stay_in_their_balls_and_vary():
    errors = np.asarray(told(WrongEstimate(0.02, 1e-3, 0.01, 5e-4), 500))
    for error, bias, noise in ((errors[:, 0], 0.02, 0.01), (errors[:, 1], 1e-3, 5e-4)):
        assert np.linalg.norm(error, axis=1).max() <= bias + noise
        np.testing.assert_allclose(np.linalg.norm(error.mean(axis=0)), bias, rtol=0.1)
        assert np.linalg.norm(error - error.mean(axis=0), axis=1).max() > 0.8 * noise


@eqx.filter_jit
def told_often(fault):
    return jax.vmap(lambda key: told(fault, 60, key))(jax.random.split(KEY, 2000))


@pytest.mark.long
@pytest.mark.parametrize("memory", [0.0, 0.8])
def test_a_gaussian_estimate_has_its_spread_and_forgets_at_its_rate(memory):
    fault = GaussianEstimate(0.03, 0.002, memory)
    drawn = np.asarray(told_often(fault))
    errors = (drawn / np.array([[0.03], [0.002]])).reshape(2000, 60, 6)
    assert np.std(errors, axis=(0, 1)) == pytest.approx(np.ones(6), rel=0.03)
    assert np.std(errors[:, 0]) == pytest.approx(1.0, rel=0.03)
    assert np.mean(errors[:, 1:] * errors[:, :-1]) == pytest.approx(memory, abs=0.01)
    assert np.abs(errors).max() > 4.0  # no bound
    assert np.abs(np.mean(errors[..., 0] * errors[..., 1])) < 0.02
    np.testing.assert_array_equal(told_often(fault), drawn)


class Resting(Law):
    """A law that hardly pushes."""

    @property
    def goal(self):
        return jnp.array([0.0, 9.0, 0.0])

    def initial_state(self, state):
        return ()

    def step(self, state, estimate):
        nothing, zero = jnp.zeros(3), jnp.zeros(())
        return state, Command(jnp.full(3, 0.01), nothing, nothing, nothing, zero, zero, zero, jnp.zeros((), jnp.int32))


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_broken_laws(kind):
    law = BrokenLaw(Resting(), WORLDS["ball"], kind, 0.1, 20.0, 0.1)
    start = motion_state([5.0, 0.0, 0.0], np.zeros(3))

    def step(state, _):
        state, order = law.step(state, start)
        return state, order.force

    force = np.asarray(jax.lax.scan(step, law.initial_state(start), length=90)[1])
    finite = np.isfinite(force).all(axis=1)
    assert np.abs(force[finite]).max() <= 0.1 + 1e-15
    if kind == "not a number":
        np.testing.assert_array_equal(finite, np.arange(90) % law.hold != 0)
    if kind == "none":
        np.testing.assert_array_equal(force, 0.01)
    if kind == "into the body":
        np.testing.assert_allclose(force, np.broadcast_to([-0.1, 0, 0], force.shape), atol=1e-12)
    if kind == "through":
        assert (force[:, 0] < 0).all()
        assert (force[:, 1] > 0).all()
    if kind == "random":
        assert len(np.unique(force[:, 0])) == 90
    if kind == "bang-bang":
        assert np.all(np.abs(np.abs(force) - 0.1) < 1e-15)
        assert 3 <= len(np.unique(force, axis=0)) <= 6


def test_a_scenarios_entries_become_faults():
    assert isinstance(Surroundings(Scenario()).faults, NoFaults)
    entries = {"stuck": "-y", "stuck_force": 0.05, "stuck_from": 9.0, "delay": 2, "dropped": 0.1, "gain_error": 0.02}
    made = Surroundings(Scenario().replace(faults=entries | {"velocity_bias": 1e-4, "position_noise": 0.01})).faults
    estimate, dropped, delayed, gain, stuck = made.parts
    assert (float(estimate.velocity_bias), float(estimate.position_noise)) == (1e-4, 0.01)
    assert (float(dropped.probability), delayed.steps, float(gain.error)) == (0.1, 2, 0.02)
    assert (stuck.axis, stuck.sign, float(stuck.force), float(stuck.start)) == (1, -1, 0.05, 9.0)
    entry = {"position_noise_std": 0.03, "velocity_noise_std": 0.002, "noise_correlation_time": 4.0}
    [part] = Surroundings(Scenario().replace(faults=entry)).faults.parts
    assert isinstance(part, GaussianEstimate)
    assert float(part.memory) == pytest.approx(np.exp(-0.25))
