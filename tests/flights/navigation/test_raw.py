"""The estimate that takes the last samples for the truth."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from truths.plain_sensors import Height, Pace, Place, Sight, Turned

from keepout.core.flight.navigation import Sample
from keepout.core.motion import rotation
from keepout.core.motion.disturbance import NoDisturbance
from keepout.core.motion.orbit import Orbit
from keepout.core.motion.relative import RelativeMotion
from keepout.flights.navigation.estimators import RawSamples

MOTION = RelativeMotion(Orbit(6_778_137.0))
START = MOTION.initial_state([8.0, -5.0, 3.0], [0.02, -0.01, 0.03])
ERRORS = jnp.array([0.1, 0.01])


def sample(value, came=True):
    return Sample(jnp.asarray(value, float), jnp.asarray(came))


@pytest.mark.long
def test_the_last_samples_are_the_estimate():
    raw = RawSamples.build(MOTION, [Place(1.0), Pace(1.0), Turned(1.0)], mass=20.0, period=1.0)
    there, pace = np.array([1.0, 2.0, -3.0]), np.array([0.3, 0.1, -0.2])
    turn = rotation.normalise(jnp.array([0.9, 0.1, -0.3, 0.2]))
    memory = raw.initial_state(START, ERRORS)
    memory, estimate, left_out = raw.correct(memory, (sample(there), sample(pace), sample(-turn)))
    np.testing.assert_allclose(estimate.position, there, atol=1e-10)
    np.testing.assert_allclose(estimate.velocity, pace, atol=1e-10)
    np.testing.assert_allclose(estimate.attitude, turn, atol=1e-14)
    assert estimate.disturbance is None
    assert int(left_out) == 0
    # What did not come, and what is no number, changes nothing; only the latter is counted.
    nothing = (sample(np.full(3, np.nan)), sample(np.zeros(3), came=False), sample(np.zeros(4)))
    _, after, left_out = raw.correct(memory, nothing)
    for a, b in zip(jax.tree.leaves(after), jax.tree.leaves(estimate)):
        np.testing.assert_array_equal(a, b)
    assert int(left_out) == 2


@pytest.mark.long
def test_between_samples_only_time_and_attitude_move():
    force = jnp.array([0.05, 0.0, -0.02])
    moved = MOTION.step(START, force, NoDisturbance(), 1.0, 20.0)
    raw = RawSamples.build(MOTION, [Place(1.0)], mass=20.0, period=1.0)
    after = raw.advance(raw.initial_state(START, ERRORS), force)
    np.testing.assert_array_equal(after.position, START.position)
    np.testing.assert_array_equal(after.velocity, START.velocity)
    np.testing.assert_allclose(after.attitude, moved.attitude, rtol=0, atol=1e-12)
    assert float(after.time) == 1.0


@pytest.mark.long
def test_a_part_of_the_state_moves_as_little_as_it_must():
    raw = RawSamples.build(MOTION, [Height(1.0)], mass=20.0, period=1.0)
    _, estimate, _ = raw.correct(raw.initial_state(START, ERRORS), (sample([9.0]),))
    np.testing.assert_allclose(estimate.position, [8.0, -5.0, 9.0], atol=1e-9)
    sight = RawSamples.build(MOTION, [Sight(1.0)], mass=20.0, period=1.0)
    there = MOTION.initial_state([8.3, -5.2, 3.1], np.zeros(3))
    memory = sight.initial_state(START, ERRORS)
    for _ in range(3):  # a direction is not linear in the position
        memory, estimate, _ = sight.correct(memory, (sample(Sight(1.0).ideal(there)),))
    np.testing.assert_allclose(estimate.position, there.position, atol=1e-6)
