"""The loop's layers in their order, flights and segments by one program, and what is said of a flight."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from truths.flights import GOAL, KEY, STEPS, Delayed, Halving, Spring, make_setup, start_state

from keepout.core.errors import FlightError, ScenarioError
from keepout.core.flight.loop import begin, fly, fly_segment, joined, outcome
from keepout.core.motion.chaser import Thrusters

LIMIT = np.array([0.1, 0.05, 0.1])


def layered():
    return make_setup(guard=Halving(), faults=Delayed(), thrusters=Thrusters(LIMIT))


@pytest.fixture(scope="module")
def flown():
    setup = layered()
    return setup, jax.device_get(fly(setup, start_state(setup), STEPS, KEY))


@pytest.mark.long
def test_layers_act_in_their_fixed_order(flown):
    _, log = flown
    rows = np.arange(STEPS + 1)
    np.testing.assert_allclose(log.time, rows, rtol=0, atol=0)
    assert log.target_orbit is None
    np.testing.assert_array_equal(log.estimated_position, log.position + 1.0)
    np.testing.assert_array_equal(log.estimated_velocity, log.velocity)
    np.testing.assert_array_equal(log.guarded_force, log.commanded_force / 2)
    arrived = np.concatenate([np.zeros((1, 3)), log.guarded_force[:-1]])
    np.testing.assert_array_equal(log.force, np.clip(arrived, -LIMIT, LIMIT) * [0, 1, 1])
    np.testing.assert_array_equal(log.saturated, np.any(np.abs(arrived) >= LIMIT * (1 - 1e-9), axis=1))
    assert 0 < np.mean(log.saturated) < 1
    np.testing.assert_array_equal(log.guard_status, 2 + 8 * (rows == 5))
    np.testing.assert_array_equal(log.control_status, rows % 3)
    # The law saw the estimate and not the truth.
    np.testing.assert_allclose(log.desired_velocity, GOAL - log.estimated_position, atol=1e-14)
    np.testing.assert_allclose(log.barrier, np.linalg.norm(log.estimated_position, axis=1) - 2.0, atol=1e-14)
    expected = 0.01 * np.stack([np.sin(0.02 * rows), np.cos(0.02 * rows), np.sin(0.01 * rows)], axis=1)
    np.testing.assert_allclose(log.disturbance, expected, atol=1e-16)


@pytest.mark.long
def test_outcome_against_numpy():
    setup = make_setup()
    log = fly(setup, start_state(setup, (0.5, -9.0, -4.0)), STEPS, KEY)
    summary = outcome(setup, log)
    np.testing.assert_allclose(summary.final_error, np.linalg.norm(np.asarray(log.position)[-1] - np.asarray(GOAL)))
    np.testing.assert_allclose(summary.minimum_barrier, np.min(log.barrier))
    np.testing.assert_allclose(summary.delta_v, np.linalg.norm(log.force[:-1], axis=1).sum() / 20.0)
    np.testing.assert_allclose(summary.saturated_fraction, np.mean(log.saturated[:-1]))
    np.testing.assert_array_equal(summary.control_status_counts[:4], [10, 10, 10, 0])
    assert summary.guard_interventions == 0
    assert summary.guard_status_counts[0] == STEPS
    # Without a guard nothing is said of one, and held forces burn nothing that is known.
    np.testing.assert_array_equal(log.guard_status, 0)
    assert np.all(np.isnan(log.field_value))
    assert log.propellant is None
    assert summary.propellant is None


@pytest.mark.long
@pytest.mark.parametrize(
    ("first", "rest", "reached", "time"),
    [
        (5.0, [0.05, 0.05, 0.05], True, STEPS - 2.0),
        (5.0, [0.05, 0.2, 0.05], True, STEPS),  # it left the goal again: only the last arrival counts
        (5.0, [0.05, 0.05, 0.2], False, np.inf),
        (0.05, [0.05, 0.05, 0.0], True, 0.0),
        (5.0, [0.05, 0.05, 0.1], False, np.inf),  # the tolerance itself is outside
        (5.0, [0.05, np.nan, 0.05], False, np.inf),
        (5.0, [0.05, 0.05, np.nan], False, np.inf),
    ],
)
def test_reached_means_near_until_the_end(first, rest, reached, time):
    setup, distances = make_setup(), np.array([first] * (STEPS - 2) + rest)
    position = np.asarray(GOAL) + distances[:, None] * np.array([1.0, 0.0, 0.0])
    log = fly(setup, start_state(setup), STEPS, KEY)
    changed = jnp.asarray(position), 5.0 + jnp.arange(STEPS + 1.0)
    summary = outcome(setup, eqx.tree_at(lambda x: (x.position, x.time), log, changed))
    assert bool(summary.reached) is reached
    assert float(summary.time_to_reach) == time
    assert bool(summary.finite) is bool(np.all(np.isfinite(distances)))


@pytest.mark.parametrize("change", [{"mass": 0.0}, {"period": -1.0}, {"tolerance": float("nan")}])
def test_impossible_setups_are_refused(change):
    with pytest.raises(ScenarioError, match=next(iter(change))):
        make_setup(**change)


def segments(setup, lengths, **options):
    state, logs = begin(setup, start_state(setup), KEY), []
    for length in lengths:
        state, log = fly_segment(setup, state, length, **options)
        assert len(log.time) == length
        logs.append(log)
    return state, joined(logs)


@pytest.mark.as_used
@pytest.mark.long
def test_segments_joined_are_one_flight_to_the_bit(flown):
    setup, whole = flown
    for lengths, options in (([10, 14, 7], {}), ([1, 7, 4, 7, 2, 7, 3], {"longest": 7})):
        rows = segments(setup, lengths, **options)[1]
        for field in dataclasses.fields(whole):
            one, other = getattr(whole, field.name), getattr(rows, field.name)
            assert (one is None) == (other is None)
            np.testing.assert_array_equal(one, other, err_msg=f"{field.name} in {lengths}")


@pytest.mark.long
def test_a_new_goal_leaves_every_memory():
    setup = layered()
    state, _ = segments(setup, [10])
    moved = GOAL + jnp.array([3.0, 0.0, 0.0])
    other = dataclasses.replace(setup, controller=Spring(setup.motion, moved), goal=moved)
    _, log = fly_segment(other, state, 1)
    _, usual = fly_segment(setup, state, 1)
    for name in ("time", "position", "velocity", "estimated_position", "disturbance_estimate"):
        np.testing.assert_array_equal(getattr(log, name), getattr(usual, name))
    # The law's count and the command under way go on; only what follows from the goal is new.
    assert int(log.control_status[0]) == int(usual.control_status[0]) == 10 % 3
    np.testing.assert_array_equal(log.force, usual.force)
    assert not np.array_equal(log.commanded_force, usual.commanded_force)


def test_a_segment_has_a_step_and_no_more_than_the_longest():
    setup = make_setup()
    with pytest.raises(FlightError, match="steps is 0"):
        fly_segment(setup, begin(setup, start_state(setup), KEY), 0)
    with pytest.raises(FlightError, match="steps is 6; longest is 5"):
        fly_segment(setup, begin(setup, start_state(setup), KEY), 6, longest=5)


@pytest.mark.long
def test_one_program_flies_every_goal_and_every_number_of_steps_that_it_has_room_for():
    setup, traces = make_setup(), []

    class Counting(Spring):
        def step(self, count, estimate):
            traces.append(1)  # runs when traced, not when flown
            return super().step(count, estimate)

    def led(shift):
        return dataclasses.replace(setup, controller=Counting(setup.motion, GOAL + shift), goal=GOAL + shift)

    whole = fly(led(0.0), start_state(setup), 30, KEY)
    shorter, traced = fly(led(1.0), start_state(setup), 20, KEY), len(traces)
    state = begin(led(0.0), start_state(setup), KEY)
    assert len(whole.time) == 31
    assert len(shorter.time) == 21
    flown = []
    for shift, steps in ((0.0, 6), (0.0, 3), (1.0, 6), (2.0, 5)):
        fly_segment(led(shift), state, steps, longest=7)
        flown.append(len(traces))
    assert flown[0] > traced > 0
    assert set(flown) == {flown[0]}
    assert fly(led(2.0), start_state(setup), 25, KEY).time.shape == (26,)
    assert len(traces) == flown[0]
