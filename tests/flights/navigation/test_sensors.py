"""Sensors: what they say, how wrong, when it arrives, and what suites of them observe and prove."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from scipy.spatial.transform import Rotation

from keepout.core.errors import ScenarioError
from keepout.core.flight.navigation import Suite
from keepout.core.motion.relative import MotionState
from keepout.flights.navigation.sensor_errors import (
    Arrival,
    BallNoise,
    ErrorModel,
    GaussianNoise,
    Outliers,
    WanderingBias,
)
from keepout.flights.navigation.sensors import (
    RangeBearing,
    RangeRate,
    RelativePosition,
    RelativeVelocity,
    TargetAttitude,
)
from keepout.flights.navigation.suites import SUITES, check_observability, close

COUNT = 20_000
TURN = Rotation.from_rotvec([0.4, -1.1, 0.7])  # body <- VVLH
POSITION, VELOCITY = np.array([3.0, -20.0, 8.0]), np.array([0.02, 0.05, -0.01])


def state(position=POSITION, velocity=VELOCITY, turn=TURN):
    attitude = turn.as_quat(scalar_first=True)
    return MotionState(jnp.zeros(()), *map(jnp.asarray, (position, velocity, attitude)), jnp.zeros(3))


@eqx.filter_jit
def _sampled(sensor, truth, keys):
    return jax.vmap(lambda key: sensor.sample(sensor.initial_state(key, truth), truth)[1].value)(keys)


def sampled(sensor, truth=None, count=COUNT):
    """Values of many sensors, one sample each."""
    return np.asarray(_sampled(sensor, state() if truth is None else truth, jax.random.split(jax.random.key(0), count)))


@eqx.filter_jit
def ideal(sensor, truth):
    return sensor.ideal(truth)


@pytest.mark.parametrize(
    ("sensor", "said"),
    [
        (RelativePosition(()), POSITION),
        (RelativeVelocity(()), VELOCITY),
        (RelativePosition((), axes="vvlh"), TURN.inv().apply(POSITION)),
        (RelativeVelocity((), axes="vvlh"), TURN.inv().apply(VELOCITY)),
        (RangeBearing((), ()), POSITION),
        (RangeRate(()), [POSITION @ VELOCITY / np.linalg.norm(POSITION)]),
        (TargetAttitude(()), TURN.as_quat(scalar_first=True)),
    ],
)
def test_what_is_said_without_error(sensor, said):
    assert np.asarray(ideal(sensor, state())) == pytest.approx(np.asarray(said))


@pytest.mark.parametrize("sensor", [RelativePosition(()), RangeBearing((), ()), RangeRate(())])
def test_at_the_origin_all_is_a_number(sensor):
    nowhere = state(position=np.zeros(3))
    assert np.isfinite(np.asarray(ideal(sensor, nowhere))).all()
    slope = jax.jit(jax.jacfwd(lambda r: sensor.ideal(eqx.tree_at(lambda s: s.position, nowhere, r))))(np.zeros(3))
    assert np.isfinite(np.asarray(slope)).all()
    assert np.isfinite(sampled(sensor, nowhere, count=3)).all()


PARTS = (BallNoise(0.02), GaussianNoise(0.01), WanderingBias(0.03, 0.001))
SMALL = (BallNoise(0.002), GaussianNoise(0.001), WanderingBias(0.003, 0.0001))


@pytest.mark.long
@pytest.mark.parametrize(
    "sensor",
    [
        RelativePosition(PARTS, axes="vvlh"),
        RelativeVelocity(PARTS),
        RangeBearing(PARTS, SMALL, axes="vvlh"),
        RangeRate(PARTS),
        TargetAttitude(SMALL),
    ],
)
def test_the_covariance_is_that_of_the_samples(sensor):
    said = ideal(sensor, state())
    error, told = sampled(sensor) - np.asarray(said), np.asarray(sensor.covariance(said))
    scale = np.trace(told)
    assert np.abs(np.cov(error.T).reshape(told.shape) - told).max() < 0.04 * scale
    assert np.abs(error.mean(axis=0)).max() < 0.03 * np.sqrt(scale)


ATTITUDE_ERROR = 0.03


@eqx.filter_jit
def balls(sensor, values, attitudes):
    """Centres and radii of what the samples prove, by estimates of those attitudes."""

    def ball(value, attitude):
        estimate = MotionState(jnp.zeros(()), jnp.zeros(3), jnp.zeros(3), attitude, jnp.zeros(3))
        told = sensor.position_ball(value, estimate) or sensor.velocity_ball(value, estimate)
        return told.centre, told.radius

    return jax.vmap(ball)(values, attitudes)


@pytest.mark.long
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
    centre, radius = map(np.asarray, balls(sensor, sampled(sensor, truth, 2000), known))
    off = np.linalg.norm(centre - at, axis=1)
    assert (off <= radius).all()
    # No ball is much wider than it need be; a range of nothing has no direction to err along.
    assert off.max() > 0.75 * radius.max() or (not at.any() and "bearing" in kind)


DRAWS = 100_000


@eqx.filter_jit
def _drawn(model, first, second):
    return jax.vmap(lambda a, b: model.draw(model.initial_state(a), b)[1])(first, second)


def drawn(model):
    """Errors of many sensors, one draw each."""
    return np.asarray(_drawn(model, *np.random.default_rng(0).normal(size=(2, DRAWS, model.normals()))))


@eqx.filter_jit
def _path(model, memory, normals):
    return jax.lax.scan(lambda state, some: model.draw(state, some), memory, normals)[1]


@pytest.mark.parametrize("dimension", [1, 3])
def test_noise_is_even_in_its_ball(dimension):
    length = np.linalg.norm(drawn(ErrorModel((BallNoise(2.0),), dimension)), axis=1)
    assert length.max() <= 2.0
    assert stats.kstest((length / 2.0) ** dimension, "uniform").pvalue > 1e-3


def test_bounds_of_independent_parts_add_up():
    model = ErrorModel((BallNoise(0.2), GaussianNoise(0.1), WanderingBias(0.3)), 3)
    assert float(model.bound()) == pytest.approx(0.2 + 6 * 0.1 + 0.3)


@given(st.floats(1e-6, 1e3), st.floats(0.0, 1.0), st.integers(0, 2**31))
def test_a_bias_stays_in_its_ball_and_moves_by_its_step(radius, share, seed):
    model = ErrorModel((WanderingBias(radius, share * radius),), 3)
    normals = np.random.default_rng(seed).normal(size=(301, model.normals()))
    path = np.asarray(_path(model, model.initial_state(jnp.asarray(normals[0])), normals[1:]))
    assert np.linalg.norm(path, axis=1).max() <= radius * (1 + 1e-12)
    # A step is as told, or reflected: then it leads no further than it would have.
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() <= 2 * share * radius * (1 + 1e-9)


def test_outliers_are_as_many_and_as_large_as_told():
    model = ErrorModel((Outliers(0.01, 7.0),), 3)
    length = np.linalg.norm(drawn(model), axis=1)
    assert set(np.round(length, 9)) == {0.0, 7.0}
    assert stats.binomtest(int((length > 1).sum()), DRAWS, 0.01).pvalue > 1e-3
    assert float(model.bound()) == 0.0
    assert model.beyond() == 0.01


@pytest.mark.parametrize(("sigmas", "dimension"), [(2.0, 1), (1.0, 3), (3.0, 3)])
def test_gaussian_noise_passes_its_bound_as_often_as_told(sigmas, dimension):
    model = ErrorModel((GaussianNoise(0.4, sigmas),), dimension)
    passed = int((np.linalg.norm(drawn(model), axis=1) > float(model.bound())).sum())
    assert stats.binomtest(passed, DRAWS, model.beyond()).pvalue > 1e-3


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: RelativePosition((), axes="eci"), "'eci'"),
        (lambda: RelativeVelocity((), attitude_error=-0.1), "attitude_error is -0.1 rad"),
        (lambda: BallNoise(-1.0), "noise radius: -1.0"),
        (lambda: GaussianNoise(np.nan), "standard deviation: nan"),
        (lambda: WanderingBias(0.1, 0.2), "bias step: 0.2; it must be at most the radius 0.1"),
        (lambda: Outliers(1.5, 1.0), "outlier probability: 1.5"),
        (lambda: Arrival(every=0), "every is 0 control periods"),
        (lambda: Arrival(latency=-1), "latency is -1 control periods"),
        (lambda: Arrival(most_missed=-1), "most_missed is -1"),
        (lambda: Arrival(dropout=1.1, most_missed=1), "dropout is 1.1"),
        (lambda: Arrival(dropout=0.1), "dropout is 0.1 but most_missed is 0"),
    ],
)
def test_numbers_out_of_range_are_refused(make, said):
    with pytest.raises(ScenarioError, match=said):
        make()


def followed(arrival, steps, seed=0):
    """Values and whether they came, of a line into which the step's number is put."""
    normals = np.random.default_rng(seed).normal(size=(steps, arrival.normals))

    def step(state, row):
        number, some = row
        state, sample = arrival.step(state, jnp.array([number, -number]), some)
        return state, (sample.value, sample.came)

    rows = np.arange(1.0, steps + 1), normals
    values, came = jax.lax.scan(step, arrival.initial_state(jnp.zeros(2)), rows)[1]
    return np.asarray(values), np.asarray(came), normals


SHARES = st.sampled_from([0.0, 0.3, 0.9, 1.0])


@pytest.mark.long
@settings(max_examples=settings().max_examples // 2)  # each is a program of its own
@given(st.integers(1, 5), st.integers(0, 4), SHARES, st.integers(1, 3), st.integers(0, 99))
def test_rate_latency_and_losses_are_exactly_as_told(every, latency, dropout, most_missed, seed):
    arrival = Arrival(every, latency, dropout, most_missed)
    steps = 60
    values, came, normals = followed(arrival, steps, seed)
    missed, expected = 0, np.zeros(steps + latency, bool)
    for step in range(0, steps, every):
        lost = dropout > 0 and stats.norm.cdf(normals[step, 0]) < dropout and missed < most_missed
        missed = missed + 1 if lost else 0
        expected[step + latency] = not lost
    assert came.tolist() == expected[:steps].tolist()
    arrived = np.flatnonzero(came)
    # What arrives is what was measured `latency` steps ago, and the first `latency` steps bring nothing.
    assert (values[arrived, 0] == arrived - latency + 1).all()
    assert not came[:latency].any()
    gaps = np.diff(arrived)
    assert gaps.max(initial=0) <= every * (most_missed + 1)
    if dropout == 1.0 and len(gaps):
        assert (gaps == every * (most_missed + 1)).all()
    ages = [step - arrived[arrived <= step][-1] + latency for step in range(arrived[0], steps)] if len(arrived) else [0]
    assert max(ages) <= arrival.oldest


NOISE = (BallNoise(0.05),)


@pytest.mark.long
@pytest.mark.parametrize("name", SUITES)
def test_the_worked_suites_observe_position_and_velocity(name):
    assert check_observability(SUITES[name](), state(), period=1.0) > 0.01


@eqx.filter_jit
def sampled_together(suite, seeds):
    def one(seed):
        return suite.sample(suite.initial_state(jax.random.key(seed), state()), state())[1]

    return jax.vmap(one)(seeds)


def test_sensors_alike_have_errors_of_their_own():
    one, other = sampled_together(Suite((RelativePosition(NOISE), RelativePosition(NOISE))), np.arange(1))
    assert not np.allclose(one.value, other.value)


@pytest.mark.parametrize(
    ("sensors", "part", "remedy"),
    [
        ((RelativePosition(NOISE, every=61),), "velocity", "add a RelativeVelocity"),
        ((RelativePosition(NOISE, every=25, dropout=0.1, most_missed=2),), "velocity", "lost samples counted"),
        ((RelativeVelocity(NOISE),), "position", "add a RelativePosition"),
        ((RangeRate(NOISE), RelativeVelocity(NOISE)), "position", "add a RelativePosition"),
    ],
)
def test_a_suite_that_cannot_observe_the_motion_is_refused_with_numbers(sensors, part, remedy):
    with pytest.raises(ScenarioError) as caught:
        check_observability(Suite(sensors), state(), period=1.0)
    assert "\n" not in str(caught.value)
    for words in (f"do not determine the {part}", "singular value", "it must be at least 1e-06", remedy):
        assert words in str(caught.value)


def test_the_probability_per_flight_is_a_union_bound_over_its_samples():
    """How often one sample passes its bound is tried above."""
    suite = Suite((RelativePosition((GaussianNoise(0.1, 3.0),), every=2),))
    assert suite.probability_beyond(20) == pytest.approx(11 * stats.chi2.sf(9.0, 3))


def test_bounded_noise_is_never_beyond_and_outliers_count():
    assert close().probability_beyond(10**6) == 0.0
    suite = Suite((RelativePosition((BallNoise(0.05), Outliers(1e-4, 5.0))), RelativeVelocity(NOISE)))
    assert suite.probability_beyond(99) == pytest.approx(100 * 1e-4)
