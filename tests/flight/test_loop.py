import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from truths.flights import GOAL, KEY, STEPS, Delayed, Halving, make_setup, start_state

from keepout.errors import ScenarioError
from keepout.flight import fly, outcome
from keepout.flight.loop import start, step
from keepout.motion import MotionState, Thrusters


@pytest.fixture(scope="module")
def flown():
    setup = make_setup(guard=Halving(), faults=Delayed(), thrusters=Thrusters([0.1, 0.05, 0.1]))
    return setup, fly(setup, start_state(setup), 40, KEY)


def test_rows_are_steps_plus_the_end(flown):
    _, log = flown
    np.testing.assert_allclose(log.time, np.arange(41.0), rtol=0, atol=0)
    assert log.position.shape == (41, 3)
    assert log.target_orbit is None


def test_layers_act_in_their_fixed_order(flown):
    _, log = flown
    np.testing.assert_array_equal(log.estimated_position, log.position + 1.0)
    np.testing.assert_array_equal(log.estimated_velocity, log.velocity)
    np.testing.assert_array_equal(log.guarded_force, log.commanded_force / 2)
    arrived = np.concatenate([np.zeros((1, 3)), log.guarded_force[:-1]])
    limit = np.array([0.1, 0.05, 0.1])
    np.testing.assert_array_equal(log.force, np.clip(arrived, -limit, limit) * [0, 1, 1])
    np.testing.assert_array_equal(log.saturated, np.any(np.abs(arrived) >= limit * (1 - 1e-9), axis=1))
    assert 0 < np.mean(log.saturated) < 1
    np.testing.assert_array_equal(log.guard_status, 2 + 8 * (np.arange(41) == 5))
    np.testing.assert_array_equal(log.control_status, np.arange(41) % 3)


def test_the_control_law_saw_the_estimate_and_not_the_truth(flown):
    _, log = flown
    np.testing.assert_allclose(log.desired_velocity, GOAL - log.estimated_position, atol=1e-14)
    np.testing.assert_allclose(log.barrier, np.linalg.norm(log.estimated_position, axis=1) - 2.0, atol=1e-14)
    time = np.asarray(log.time)
    expected = 0.01 * np.stack([np.sin(0.02 * time), np.cos(0.02 * time), np.sin(0.01 * time)], axis=1)
    np.testing.assert_allclose(log.disturbance, expected, atol=1e-16)


def test_each_row_leads_to_the_next_through_the_motion(flown):
    setup, log = flown
    advance = eqx.filter_jit(lambda state, force: setup.motion.step(state, force, setup.disturbance, 1.0, 20.0))
    for row in (0, 17, 39):
        state = MotionState(
            log.time[row], log.position[row], log.velocity[row], log.attitude[row], log.angular_velocity[row]
        )
        after = advance(state, log.force[row])
        np.testing.assert_allclose(after.position, log.position[row + 1], atol=1e-14)
        np.testing.assert_allclose(after.velocity, log.velocity[row + 1], atol=1e-15)


def test_stepping_by_hand_is_the_same_flight(flown):
    setup, log = flown
    one = eqx.filter_jit(step)
    state = start(setup, start_state(setup), KEY)
    for row in range(5):
        state, entry = one(setup, state)
        np.testing.assert_allclose(entry.position, log.position[row], atol=1e-14)
        np.testing.assert_allclose(entry.force, log.force[row], atol=1e-16)


@pytest.mark.long
def test_batches_are_the_same_flights():
    setup = make_setup()
    starts = jnp.array([[0.0, 10.0, 6.0], [8.0, 1.0, -3.0], [-5.0, 5.0, 0.0]])
    states = jax.vmap(lambda r: start_state(setup, r))(starts)
    logs = eqx.filter_vmap(fly, in_axes=(None, 0, None, None))(setup, states, STEPS, KEY)
    alone = fly(setup, start_state(setup, starts[1]), STEPS, KEY)
    np.testing.assert_allclose(logs.position[1], alone.position, atol=1e-12)
    np.testing.assert_allclose(logs.force[1], alone.force, atol=1e-13)
    np.testing.assert_array_equal(alone.guard_status, 0)
    assert np.all(np.isnan(alone.field_value))


def test_outcome_against_numpy():
    setup = make_setup()
    log = fly(setup, start_state(setup, (0.5, -9.0, -4.0)), 400, KEY)
    summary = outcome(setup, log)
    error = np.linalg.norm(np.asarray(log.position) - np.asarray(GOAL), axis=1)
    assert bool(summary.reached) == bool(error[-1] < 0.1)
    np.testing.assert_allclose(summary.final_error, error[-1])
    np.testing.assert_allclose(summary.minimum_barrier, np.min(log.barrier))
    np.testing.assert_allclose(summary.delta_v, np.linalg.norm(log.force[:-1], axis=1).sum() / 20.0)
    np.testing.assert_allclose(summary.saturated_fraction, np.mean(log.saturated[:-1]))
    np.testing.assert_array_equal(summary.control_status_counts[:4], [134, 133, 133, 0])
    assert summary.guard_interventions == 0
    assert summary.guard_status_counts[0] == 400


def shaped_log(distances):
    """A log that is at the given distances from the goal, one a second from t = 5 s."""
    setup = make_setup()
    log = jax.tree.map(lambda column: column[: len(distances)], fly(setup, start_state(setup), STEPS, KEY))
    position = GOAL + jnp.asarray(distances)[:, None] * jnp.array([1.0, 0.0, 0.0])
    time = 5.0 + jnp.arange(float(len(distances)))
    return setup, eqx.tree_at(lambda x: (x.position, x.time), log, (position, time))


@pytest.mark.parametrize(
    ("distances", "reached", "time"),
    [
        ([5.0, 0.05, 0.05, 0.05], True, 1.0),
        ([5.0, 0.05, 0.2, 0.05], True, 3.0),  # it left the goal again: only the last arrival counts
        ([5.0, 0.05, 0.05, 0.2], False, np.inf),
        ([0.05, 0.05, 0.05, 0.0], True, 0.0),
        ([5.0, 0.05, 0.05, 0.1], False, np.inf),  # the tolerance itself is outside
        ([5.0, 0.05, np.nan, 0.05], False, np.inf),
        ([5.0, 0.05, 0.05, np.nan], False, np.inf),
    ],
)
def test_reached_means_near_until_the_end(distances, reached, time):
    summary = outcome(*shaped_log(distances))
    assert bool(summary.reached) is reached
    assert float(summary.time_to_reach) == time
    assert bool(summary.finite) is bool(np.all(np.isfinite(distances)))


@pytest.mark.parametrize("change", [{"mass": 0.0}, {"period": -1.0}, {"tolerance": float("nan")}])
def test_impossible_setups_are_refused(change):
    with pytest.raises(ScenarioError, match=next(iter(change))):
        make_setup(**change)
