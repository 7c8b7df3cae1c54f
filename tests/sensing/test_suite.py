"""Suites: independent sensors, what is refused, and the probability that noise without a bound is beyond one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from keepout.errors import ScenarioError
from keepout.motion import rotation
from keepout.motion.relative import MotionState
from keepout.sensing.error_parts import BallNoise, GaussianNoise, Outliers
from keepout.sensing.observability import check_observability
from keepout.sensing.sensors import RangeBearing, RangeRate, RelativePosition, RelativeVelocity, TargetAttitude
from keepout.sensing.suite import Suite
from keepout.sensing.worked_suites import SUITES, close

NOISE = (BallNoise(0.05),)


def state(position=(3.0, -20.0, 8.0), velocity=(0.02, 0.05, -0.01)):
    position, velocity = jnp.asarray(position), jnp.asarray(velocity)
    return MotionState(jnp.zeros(()), position, velocity, rotation.identity(), jnp.zeros(3))


@pytest.mark.parametrize("name", SUITES)
def test_the_worked_suites_observe_position_and_velocity(name):
    assert check_observability(SUITES[name](), state(), period=1.0) > 0.01
    without = SUITES[name](dropout=0.0)
    assert all(sensor.most_missed == 0 for sensor in without.sensors)


@pytest.mark.long
def test_the_close_suite_is_the_one_of_the_figures():
    position, velocity = close().sensors
    assert (position.every, position.latency, position.dropout, position.most_missed) == (1, 0, 0.0, 0)
    assert (velocity.every, velocity.latency, velocity.dropout, velocity.most_missed) == (1, 0, 0.0, 0)
    values = []
    for seed in range(300):
        suite = close(dropout=0.1, most_missed=1)
        _, samples = suite.sample(suite.initial_state(jax.random.key(seed), state()), state())
        off = samples[0].value - state().position, samples[1].value - state().velocity
        values.append([float(jnp.linalg.norm(part)) for part in off])
    assert 0.045 < np.max(values, axis=0)[0] <= 0.05
    assert 0.0018 < np.max(values, axis=0)[1] <= 0.002


def test_sensors_alike_have_errors_of_their_own():
    suite = Suite((RelativePosition(NOISE), RelativePosition(NOISE)))
    _, samples = suite.sample(suite.initial_state(jax.random.key(0), state()), state())
    assert not np.allclose(samples[0].value, samples[1].value)


@pytest.mark.parametrize(
    ("sensors", "part", "remedy"),
    [
        ((RelativePosition(NOISE, every=61),), "velocity", "add a RelativeVelocity"),
        ((RelativePosition(NOISE, every=25, dropout=0.1, most_missed=2),), "velocity", "lost samples counted"),
        ((RelativePosition(NOISE, every=31, latency=30),), "velocity", "add a RelativeVelocity"),
        ((RelativeVelocity(NOISE),), "position", "add a RelativePosition"),
        ((TargetAttitude(NOISE),), "", "add a Relative"),
        ((RangeRate(NOISE), TargetAttitude(NOISE)), "position", "add a RelativePosition"),
        ((RangeRate(NOISE), RelativeVelocity(NOISE)), "position", "add a RelativePosition"),
    ],
)
def test_a_suite_that_cannot_observe_the_motion_is_refused_with_numbers(sensors, part, remedy):
    with pytest.raises(ScenarioError) as caught:
        check_observability(Suite(sensors), state(), period=1.0)
    said = str(caught.value)
    assert f"do not determine the {part}" in said
    assert "singular value" in said
    assert "it must be at least 1e-06" in said
    assert remedy in said
    assert "\n" not in said


@pytest.mark.parametrize(
    "sensors",
    [
        (RelativePosition(NOISE, every=60),),
        (RelativePosition(NOISE, every=25, dropout=0.1, most_missed=1),),
        (RangeBearing(NOISE, NOISE, every=10, latency=5),),
        (RelativePosition(NOISE, every=61), RelativeVelocity(NOISE, every=30)),
        (RelativePosition((BallNoise(0.0),)), RangeRate(NOISE)),
    ],
)
def test_a_suite_that_can_is_not(sensors):
    assert check_observability(Suite(sensors), state(), period=1.0) > 1e-3


def test_the_direction_that_is_named_is_the_one_not_observed():
    """Position in a plane only: no such sensor ships, but one may be brought."""

    class Shadow(RelativePosition):
        def ideal(self, state):
            return state.position.at[2].set(0.0)

    with pytest.raises(ScenarioError, match=r"position along \(-?0\.00, -?0\.00, -?1\.00\)"):
        check_observability(Suite((Shadow(NOISE), RelativeVelocity(NOISE))), state(), period=1.0)


def test_bounded_noise_is_never_beyond():
    assert close().probability_beyond(10**6) == 0.0


@pytest.mark.parametrize("sigmas", [3.0, 4.0])
def test_the_probability_per_flight_against_flights(sigmas):
    """A union bound over 3 axes and all samples: no less than the truth, and close to it while it is small."""
    steps, flights = 20, 20_000
    sensor = RelativePosition((GaussianNoise(0.1, sigmas),), every=2)
    suite = Suite((sensor,))
    told = suite.probability_beyond(steps)
    assert told == pytest.approx(min(1.0, 11 * stats.chi2.sf(sigmas**2, 3)))

    def one(key):
        def step(memory, _):
            memory, sample = sensor.sample(memory, state())
            off = jnp.linalg.norm(sample.value - state().position)
            return memory, sample.came & (off > sensor.errors.bound())

        return jnp.any(jax.lax.scan(step, sensor.initial_state(key, state()), length=steps + 1)[1])

    beyond = np.asarray(jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(0), flights)))
    assert stats.binomtest(int(beyond.sum()), flights, told, alternative="greater").pvalue > 1e-3
    independent = 1.0 - (1.0 - stats.chi2.sf(sigmas**2, 3)) ** 11
    assert stats.binomtest(int(beyond.sum()), flights, independent).pvalue > 1e-3


def test_outliers_count():
    suite = Suite((RelativePosition((BallNoise(0.05), Outliers(1e-4, 5.0))), RelativeVelocity(NOISE)))
    assert suite.probability_beyond(99) == pytest.approx(100 * 1e-4)
