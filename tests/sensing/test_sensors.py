"""The sensors: what they say without error, their covariances and balls, and their order in time."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from keepout.errors import ScenarioError
from keepout.motion.relative import MotionState
from keepout.sensing.error_parts import BallNoise, GaussianNoise, WanderingBias
from keepout.sensing.sensors import RangeBearing, RangeRate, RelativePosition, RelativeVelocity, TargetAttitude

COUNT = 20_000
TURN = Rotation.from_rotvec([0.4, -1.1, 0.7])  # body <- VVLH
POSITION, VELOCITY = np.array([3.0, -20.0, 8.0]), np.array([0.02, 0.05, -0.01])


def state(position=POSITION, velocity=VELOCITY, turn=TURN):
    attitude = turn.as_quat(scalar_first=True)
    return MotionState(jnp.zeros(()), *map(jnp.asarray, (position, velocity, attitude)), jnp.zeros(3))


def sampled(sensor, truth=None, count=COUNT):
    """Values of many sensors, one sample each."""
    truth = state() if truth is None else truth

    def one(key):
        return sensor.sample(sensor.initial_state(key, truth), truth)[1].value

    return np.asarray(jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(0), count)))


def test_what_is_said_without_error():
    position, velocity = RelativePosition(()), RelativeVelocity(())
    assert np.asarray(position.ideal(state())) == pytest.approx(POSITION)
    assert np.asarray(velocity.ideal(state())) == pytest.approx(VELOCITY)
    in_vvlh = RelativePosition((), axes="vvlh").ideal(state())
    assert np.asarray(in_vvlh) == pytest.approx(TURN.inv().apply(POSITION))
    in_vvlh = RelativeVelocity((), axes="vvlh").ideal(state())
    assert np.asarray(in_vvlh) == pytest.approx(TURN.inv().apply(VELOCITY))
    assert np.asarray(RangeBearing((), ()).ideal(state())) == pytest.approx(POSITION)
    rate = POSITION @ VELOCITY / np.linalg.norm(POSITION)
    assert np.asarray(RangeRate(()).ideal(state())) == pytest.approx([rate])
    assert np.asarray(TargetAttitude(()).ideal(state())) == pytest.approx(TURN.as_quat(scalar_first=True))


@pytest.mark.parametrize("sensor", [RelativePosition(()), RangeBearing((), ()), RangeRate(())])
def test_at_the_origin_all_is_a_number(sensor):
    nowhere = state(position=np.zeros(3))
    assert np.isfinite(np.asarray(sensor.ideal(nowhere))).all()
    slope = jax.jacfwd(lambda r: sensor.ideal(state(position=r)))(jnp.zeros(3))
    assert np.isfinite(np.asarray(slope)).all()
    assert np.isfinite(sampled(sensor, nowhere, count=3)).all()


PARTS = (BallNoise(0.02), GaussianNoise(0.01), WanderingBias(0.03, 0.001))
SMALL = (BallNoise(0.002), GaussianNoise(0.001), WanderingBias(0.003, 0.0001))


@pytest.mark.parametrize(
    "sensor",
    [
        RelativePosition(PARTS),
        RelativePosition(PARTS, axes="vvlh"),
        RelativeVelocity(PARTS),
        RangeBearing(PARTS, SMALL),
        RangeBearing(PARTS, SMALL, axes="vvlh"),
        RangeRate(PARTS),
        TargetAttitude(SMALL),
    ],
)
def test_the_covariance_is_that_of_the_samples(sensor):
    error = sampled(sensor) - np.asarray(sensor.ideal(state()))
    told = np.asarray(sensor.covariance(sensor.ideal(state())))
    scale = np.trace(told)
    assert np.abs(np.cov(error.T).reshape(told.shape) - told).max() < 0.04 * scale
    assert np.abs(error.mean(axis=0)).max() < 0.03 * np.sqrt(scale)


ATTITUDE_ERROR = 0.03


@pytest.mark.parametrize("at", [POSITION, np.zeros(3), np.array([1e3, 0.0, 0.0])])
@pytest.mark.parametrize("axes", ["body", "vvlh"])
@pytest.mark.parametrize("kind", ["position", "velocity", "bearing", "wide bearing"])
def test_the_truth_is_in_the_ball(kind, axes, at):
    """With noise anywhere in its ball and an attitude that is off by all it may be, about any axis."""
    bearing = 0.02 if kind == "bearing" else 2.0
    numbers = {"axes": axes, "attitude_error": ATTITUDE_ERROR}
    sensor = {
        "position": RelativePosition((BallNoise(0.3),), **numbers),
        "velocity": RelativeVelocity((BallNoise(0.3),), **numbers),
    }.get(kind, RangeBearing((BallNoise(0.3),), (BallNoise(bearing),), **numbers))
    truth = state(position=at, velocity=at)
    axis = np.random.default_rng(1).normal(size=(2000, 3))
    axis *= ATTITUDE_ERROR / np.linalg.norm(axis, axis=1, keepdims=True)
    known = (Rotation.from_rotvec(axis) * TURN).as_quat(scalar_first=True)

    def ball(value, attitude):
        estimate = MotionState(jnp.zeros(()), jnp.zeros(3), jnp.zeros(3), attitude, jnp.zeros(3))
        told = sensor.velocity_ball(value, estimate) if kind == "velocity" else sensor.position_ball(value, estimate)
        return told.centre, told.radius

    centre, radius = map(
        np.asarray, jax.jit(jax.vmap(ball))(jnp.asarray(sampled(sensor, truth, 2000)), jnp.asarray(known))
    )
    off = np.linalg.norm(centre - at, axis=1)
    assert (off <= radius).all()
    # No ball is much wider than it need be; a range of nothing has no direction to err along.
    assert off.max() > 0.75 * radius.max() or (not at.any() and "bearing" in kind)


def test_a_sensor_that_proves_nothing_says_so():
    for sensor in (RangeRate(()), TargetAttitude(())):
        value = sensor.ideal(state())
        assert sensor.position_ball(value, state()) is None
        assert sensor.velocity_ball(value, state()) is None
    assert RelativePosition(()).velocity_ball(jnp.zeros(3), state()) is None
    assert RelativeVelocity(()).position_ball(jnp.zeros(3), state()) is None


def test_the_attitude_is_off_by_the_angle_that_was_drawn():
    sensor = TargetAttitude((BallNoise(0.1),))
    told = sampled(sensor, count=5000)
    off = (Rotation.from_quat(told, scalar_first=True) * TURN.inv()).magnitude()
    assert off.max() <= 0.1 * (1 + 1e-9)
    assert off.max() > 0.095


def test_a_sample_says_what_was_true_when_it_was_taken():
    sensor = RelativePosition((), every=2, latency=3)

    def step(memory, number):
        memory, sample = sensor.sample(memory, state(position=number * jnp.ones(3)))
        return memory, (sample.value[0], sample.came)

    start = sensor.initial_state(jax.random.key(0), state())
    values, came = map(np.asarray, jax.lax.scan(step, start, jnp.arange(12.0))[1])
    assert np.flatnonzero(came).tolist() == [3, 5, 7, 9, 11]
    assert values[came].tolist() == [0.0, 2.0, 4.0, 6.0, 8.0]


def test_the_same_key_gives_the_same_samples_and_another_one_others():
    sensor = RelativePosition(PARTS)
    values = [sensor.sample(sensor.initial_state(jax.random.key(k), state()), state())[1].value for k in (1, 1, 2)]
    assert np.array_equal(values[0], values[1])
    assert not np.array_equal(values[0], values[2])


def test_refused():
    with pytest.raises(ScenarioError, match=r"^sensor: axes are 'eci'; valid are body, vvlh$"):
        RelativePosition((), axes="eci")
    with pytest.raises(ScenarioError, match=r"^sensor: attitude_error is -0.1 rad; it must lie in \[0, pi\]$"):
        RelativeVelocity((), attitude_error=-0.1)
    with pytest.raises(ScenarioError, match=r"^sensor: every is 0 control periods"):
        RangeRate((), every=0)
