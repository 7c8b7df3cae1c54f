"""The law's filter against filters and least squares that others wrote, and against the statistics that it claims."""

import equinox as eqx
import filter_worlds
import filterpy.kalman
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from filter_worlds import BOUND, ERRORS, MASS, NEAR, PERIOD, START, ball, band, normalised
from scipy import linalg
from truths.plain_sensors import Height, Pace, Place, Sight, Turned

from keepout.core.errors import ScenarioError
from keepout.core.flight.navigation import Sample
from keepout.core.motion.attitude import Tumbling
from keepout.core.motion.disturbance import NoDisturbance
from keepout.core.motion.orbit import Orbit
from keepout.core.motion.relative import RelativeMotion
from keepout.flights.navigation.estimators import PATIENCE, kalman_filter, transition
from keepout.flights.navigation.suites import near

FREQUENCIES = (0.02, 0.01)
RATE = 1.13e-3
FAR = RelativeMotion(Orbit(1e12, gravitational_parameter=RATE**2 * 1e36))
"""The turning frame of a low orbit about so large an Earth that Hill's equations are exact to rounding."""


STEPS = 120
"""Of every flight through `flown`: those of the same sensors then share a program."""
PROMPT = (Place(1e-3), Pace(1e-6), Height(1e-3))
LATE = (Place(0.02, latency=3), Pace(1e-3, latency=2), Height(0.05, latency=1))


DRIFT = jax.jit(lambda state: NEAR.drift_acceleration(state))


def build(sensors=PROMPT, *, motion=NEAR, frequencies=FREQUENCIES, **changes):
    numbers = {"mass": MASS, "period": PERIOD, "disturbance_bound": BOUND} | changes
    return kalman_filter(motion, sensors, frequencies=frequencies, **numbers)


def started(filtering, x=START, errors=ERRORS):
    return filtering.initial_state(filtering.motion.initial_state(x[:3], x[3:]), jnp.asarray(errors))


def sample(value, came=True):
    return Sample(jnp.asarray(value, float), jnp.asarray(came))


def line(values, came=True):
    """Samples of one sensor, one a step."""
    return jax.vmap(Sample)(jnp.asarray(values, float), jnp.asarray(np.broadcast_to(came, STEPS)))


def nothing(size):
    """Samples of a sensor of which none comes."""
    return line(np.zeros((STEPS, size)), False)


def held(velocity=START[3:]):
    """Forces that hold a chaser near START at a velocity."""
    force = -MASS * np.asarray(DRIFT(NEAR.initial_state(START[:3], velocity)))
    return np.broadcast_to(force, (STEPS, 3))


@jax.jit
def flown(filtering, memory, samples, forces):
    """Run over samples (steps, ...) and forces (steps, 3): the memory, and all estimates and counts."""

    def step(memory, given):
        sampled, force = given
        memory, estimate, left_out = filtering.correct(memory, sampled)
        return filtering.advance(memory, force), (estimate, left_out, memory.settled)

    return jax.lax.scan(step, memory, (samples, forces))


@jax.jit
def corrected(filtering, memory, samples):
    return filtering.correct(memory, samples)


def hill(frequencies, period=PERIOD):
    """Hill's equations in VVLH axes with a held force and a held mean push: F and the input's matrix, by expm."""
    omega = np.array([0.0, -RATE, 0.0])
    turn = np.array([[0, -omega[2], omega[1]], [omega[2], 0, -omega[0]], [-omega[1], omega[0], 0]])
    whole = np.zeros((9, 9))
    whole[:3, 3:6] = np.eye(3)
    whole[3:6, :3] = -turn @ turn - RATE**2 * np.diag([1.0, 1.0, -2.0])
    whole[3:6, 3:6], whole[3:6, 6:] = -2 * turn, np.eye(3) / MASS
    moved = linalg.expm(whole * period)
    generator = linalg.block_diag(0.0, *([[0.0, w], [-w, 0.0]] for w in frequencies))
    q = len(generator)
    output = np.array([1.0, *([1.0, 0.0] * len(frequencies))])
    # the mean of C exp(A s) by Simpson's rule on a fine grid
    nodes = np.linspace(0.0, period, 201)
    weights = np.tile([2.0, 4.0], 101)[:201]
    weights[[0, -1]] = 1.0
    mean = sum(w * output @ linalg.expm(generator * s) for w, s in zip(weights, nodes)) / weights.sum()
    F = np.zeros((6 + 3 * q, 6 + 3 * q))
    F[:6, :6], F[:6, 6:] = moved[:6, :6], moved[:6, 6:] @ np.kron(mean, np.eye(3))
    F[6:, 6:] = np.kron(linalg.expm(generator * period), np.eye(3))
    return F, np.vstack([moved[:6, 6:], np.zeros((3 * q, 3))]), mean


def whole_state(belief):
    motion = belief.motion
    return np.concatenate([motion.position, motion.velocity, belief.disturbance.reshape(-1)])


ROWS = [[0, 1, 2], [3, 4, 5], [2]]
"""Of the state, that the three sensors say."""


def drawn(rng, share=0.7):
    """Draw samples about START, some missing, and forces."""
    values = [START[row] + 0.1 * rng.normal(size=(STEPS, len(row))) for row in ROWS]
    return values, [rng.random(STEPS) < share for _ in ROWS], 0.05 * rng.normal(size=(STEPS, 3))


@pytest.mark.long
@pytest.mark.parametrize("share", [1.0, 0.6])
def test_linear_cases_agree_with_filterpy(share):
    sensors = [Place(0.02), Pace(1e-3), Height(0.05)]
    filtering = build(sensors, motion=FAR, outlier_probability=1e-300)
    values, came, forces = drawn(np.random.default_rng(5), share)
    _, (estimates, left_out, beliefs) = flown(filtering, started(filtering), tuple(map(line, values, came)), forces)
    beliefs = jax.tree.map(np.asarray, beliefs)

    F, inputs, mean = hill(FREQUENCIES)
    n = len(F)
    other = filterpy.kalman.KalmanFilter(dim_x=n, dim_z=3, dim_u=3)
    other.x = np.concatenate([START, np.zeros(n - 6)])
    other.P = np.diag(np.concatenate([np.repeat(ERRORS**2 / 5, 3), np.full(n - 6, BOUND**2 / 5)]))
    a, walk = 5e-5**2, (BOUND / 500.0) ** 2
    Q = linalg.block_diag(np.kron([[a / 3, a / 2], [a / 2, a]], np.eye(3)), walk * np.eye(n - 6))
    for k in range(STEPS):
        if k:
            other.predict(u=forces[k - 1], F=F, B=inputs, Q=Q)
        for sensor, row, value, arrived in zip(sensors, ROWS, values, came):
            if arrived[k]:
                other.update(value[k], R=float(sensor.noise) * np.eye(len(row)), H=np.eye(n)[row])
        belief = jax.tree.map(lambda x, k=k: x[k], beliefs)
        np.testing.assert_allclose(whole_state(belief), other.x, rtol=0, atol=1e-9)
        np.testing.assert_allclose(belief.covariance, other.P, rtol=0, atol=1e-9)
        push = np.kron(mean, np.eye(3)) @ other.x[6:]
        np.testing.assert_allclose(estimates.disturbance[k], push, rtol=0, atol=1e-9)
    assert np.all(left_out == 0)


@pytest.mark.long
def test_late_and_seldom_samples_agree_with_least_squares_over_the_whole_past():
    compared = 14
    filtering = build(LATE, motion=FAR, frequencies=(0.02,), outlier_probability=1e-300, disturbance_walk=1e-3)
    values, came, forces = drawn(np.random.default_rng(6))
    came = [c & (np.arange(STEPS) % every == 0) for c, every in zip(came, (2, 3, 1))]
    _, (estimates, _, _) = flown(filtering, started(filtering), tuple(map(line, values, came)), forces)

    F, inputs, mean = hill((0.02,))
    n, a = len(F), 5e-5**2
    prior = np.diag(np.concatenate([np.repeat(ERRORS**2 / 5, 3), np.full(n - 6, BOUND**2 / 5)]))
    Q = linalg.block_diag(np.kron([[a / 3, a / 2], [a / 2, a]], np.eye(3)), 1e-6 * np.eye(n - 6))

    def most_likely(count):
        """The last of `count` states, by one least squares over all of them and all samples that have come."""
        at = [np.eye(n, n * count, k * n) for k in range(count)]
        equations = [(at[0], np.concatenate([START, np.zeros(n - 6)]), prior)]
        equations += [(at[k] - F @ at[k - 1], inputs @ forces[k - 1], Q) for k in range(1, count)]
        for sensor, row, value, arrived in zip(LATE, ROWS, values, came):
            noise = float(sensor.noise) * np.eye(len(row))
            for k in np.flatnonzero(arrived[:count]):
                if k >= sensor.latency:  # before the start there is no state that a sample could be of
                    equations.append((np.eye(n)[row] @ at[k - sensor.latency], value[k], noise))
        white = [np.linalg.inv(np.linalg.cholesky(covariance)) for _, _, covariance in equations]
        left = np.vstack([w @ block for w, (block, _, _) in zip(white, equations)])
        right = np.concatenate([w @ value for w, (_, value, _) in zip(white, equations)])
        return np.linalg.lstsq(left, right, rcond=None)[0][-n:]

    for k in range(compared):
        best = most_likely(k + 1)
        np.testing.assert_allclose(estimates.position[k], best[:3], rtol=0, atol=1e-9)
        np.testing.assert_allclose(estimates.velocity[k], best[3:6], rtol=0, atol=1e-9)
        np.testing.assert_allclose(estimates.disturbance[k], np.kron(mean, np.eye(3)) @ best[6:], rtol=0, atol=1e-9)
        assert float(estimates.time[k]) == k


@pytest.mark.long
def test_the_covariance_moves_as_the_motion_does():
    motion = RelativeMotion(Orbit(6_778_137.0, 0.1), Tumbling(np.deg2rad([0.3, -0.4, 0.2]), np.diag([3.0, 2.0, 1.5])))
    state = motion.initial_state(START[:3], START[3:], 100.0)

    @jax.jit
    @jax.jacfwd
    def exact(x):
        at = eqx.tree_at(lambda m: (m.position, m.velocity), state, (x[:3], x[3:6]))
        moved = motion.step(at, x[6:], NoDisturbance(), PERIOD, 1.0)
        return jnp.concatenate([moved.position, moved.velocity])

    told = jax.jit(lambda state: transition(motion, state, jnp.asarray(PERIOD)))(state)
    assert np.abs(exact(np.concatenate([START, np.zeros(3)])) - told).max() < 5e-6


# Consistency ----------------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_normalised_innovations_and_errors_squared_are_in_their_band(monkeypatch):
    """Worlds that are as the filter believes."""
    flights = 200
    monkeypatch.setattr(filter_worlds, "FLIGHTS", flights)
    both, errors = normalised(ball)
    for values in (both[:, ::2, 0], both[:, :, 1]):  # innovations of one sensor are independent over time and flights
        low, high = band(3 * values.size)
        assert low < values.mean() / 3 < high
        each_time = values.mean(axis=0) / 3
        low, high = band(3 * flights)
        assert np.mean((each_time > low) & (each_time < high)) >= 0.9
    low, high = band(21 * flights)
    each_time = errors.mean(axis=0) / 21
    assert np.mean((each_time > low) & (each_time < high)) >= 0.9
    # Errors remember: over the whole run they are averaged as if every flight gave one number.
    assert low < each_time.mean() < high


# Outliers, endurance, accuracy ----------------------------------------------------------------------------------------


@pytest.mark.long
def test_outliers_are_left_out_and_counted_once_however_late():
    filtering = build(LATE, frequencies=(0.02,))
    rng = np.random.default_rng(8)
    # Of a chaser that moves with START's velocity, each as late as its sensor.
    path = START[:3] + START[3:] * (np.arange(STEPS)[:, None] - LATE[0].latency)
    clean = [path + 0.1 * rng.normal(size=(STEPS, 3)), START[3:] + 0.03 * rng.normal(size=(STEPS, 3))]
    wild = [rng.random(STEPS) < 0.15, rng.random(STEPS) < 0.15]
    for w in wild:
        w[:10] = False
    wild[1][10] = True
    broken = [np.where(w[:, None], v + 50.0, v) for w, v in zip(wild, clean)]
    broken[1][10] = np.nan

    def estimated(values, came):
        samples = (*map(line, values, came), nothing(1))
        return jax.tree.map(np.asarray, flown(filtering, started(filtering), samples, held())[1][:2])

    kept, none_out = estimated(clean, [True, True])
    without, _ = estimated(clean, [~w for w in wild])
    gated, left_out = estimated(broken, [True, True])
    assert none_out.sum() == 0
    np.testing.assert_array_equal(left_out, wild[0].astype(int) + wild[1])
    for a, b in zip(jax.tree.leaves(gated), jax.tree.leaves(without)):
        np.testing.assert_array_equal(a, b)
    assert np.all(np.isfinite(kept.position))


STILL = np.concatenate([START[:3], np.zeros(3)])


@pytest.mark.long
def test_a_chaser_that_is_suddenly_elsewhere_is_found_again():
    filtering, jump, rng = build(), 30, np.random.default_rng(9)
    elsewhere = np.where(np.arange(STEPS)[:, None] < jump, 0.0, [3.0, 0.0, -2.0])
    there = line(START[:3] + elsewhere + 0.03 * rng.normal(size=(STEPS, 3)))
    samples = (there, line(1e-3 * rng.normal(size=(STEPS, 3))), nothing(1))
    _, (estimates, left_out, _) = flown(filtering, started(filtering, STILL), samples, held(np.zeros(3)))
    off = np.linalg.norm(np.asarray(estimates.position) - START[:3] - elsewhere, axis=1)
    left_out, found = np.asarray(left_out), jump + PATIENCE
    assert np.all(left_out[:jump] == 0)
    assert np.all(left_out[jump:found] == 1)
    assert np.all(off[jump:found] > 3.0)
    assert left_out.sum() <= PATIENCE + 3
    assert np.all(off[found + 5 :] < 0.15)


@pytest.mark.long
@pytest.mark.parametrize("lie", [1e3, np.inf])
def test_a_sensor_that_lies_for_ever_costs_the_smoothing_and_no_more(lie):
    filtering, rng = build(), np.random.default_rng(11)
    true = line(START[:3] + 0.03 * rng.normal(size=(STEPS, 3)))
    samples = (true, nothing(3), line(np.full((STEPS, 1), lie)))
    _, (estimates, left_out, beliefs) = flown(filtering, started(filtering, STILL), samples, held(np.zeros(3)))
    np.testing.assert_array_equal(left_out, 1)
    assert np.abs(np.asarray(estimates.position) - START[:3]).max() < 0.2
    assert np.all(np.isfinite(beliefs.covariance))


@pytest.mark.long
def test_samples_beyond_all_numbers_do_not_end_the_filter():
    """Of a laser whose range squared is no number, the covariance is none either."""
    filtering = build(near().sensors)
    truth = NEAR.initial_state(START[:3], np.zeros(3))
    true = [np.asarray(sensor.ideal(truth)) for sensor in filtering.sensors]
    wild = [line(np.where(np.arange(STEPS)[:, None] < 2 * PATIENCE, 1e200, value)) for value in true]
    _, (estimates, left_out, beliefs) = flown(filtering, started(filtering, STILL), tuple(wild), held(np.zeros(3)))
    assert np.all(np.isfinite(beliefs.covariance))
    assert np.all(np.asarray(left_out)[1 : 2 * PATIENCE] >= 2)
    assert np.abs(np.asarray(estimates.position)[-1] - START[:3]).max() < 0.2


# What it asks and what it refuses -------------------------------------------------------------------------------------


@pytest.mark.long
def test_range_and_bearings_that_are_correlated_find_the_chaser():
    sensor = Sight(1.0)
    filtering = build([sensor])
    truth = NEAR.initial_state(START[:3] + np.array([0.3, -0.2, 0.4]), START[3:])

    @jax.jit
    def path_of(state):
        def step(state, _):
            return NEAR.step(state, jnp.zeros(3), NoDisturbance(), PERIOD, MASS), (state, sensor.ideal(state))

        return jax.lax.scan(step, state, length=STEPS)[1]

    path, exact = path_of(truth)
    noise = np.random.default_rng(12).normal(size=(STEPS, 3))
    noise = noise @ np.linalg.cholesky(np.asarray(sensor.covariance(np.zeros(3)))).T
    samples, none = (line(exact + noise),), np.zeros((STEPS, 3))
    _, (estimates, left_out, beliefs) = flown(filtering, started(filtering), samples, none)
    error = np.concatenate([path.position - estimates.position, path.velocity - estimates.velocity], axis=1)
    P = np.asarray(beliefs.covariance)[:, :6, :6]
    squares = np.einsum("ki,kij,kj->k", error, np.linalg.inv(P), error)
    assert 2.0 < squares.mean() < 14.0  # 6 is expected; errors remember, so one flight is few of them
    assert np.linalg.norm(error[-50:, :3], axis=1).mean() < 0.06  # of ranges that are good to 0.1 m
    assert int(np.sum(left_out)) == 0


@pytest.mark.long
def test_an_attitude_is_pulled_by_its_share_and_missing_or_broken_ones_are_not_used():
    filtering = eqx.tree_at(lambda f: f.attitude_share, build([Place(1e-3), Turned(1.0)]), jnp.asarray(0.25))
    memory = started(filtering)
    old = np.asarray(memory.settled.motion.attitude)
    angle = 0.02
    turned = np.array([np.cos(angle / 2), np.sin(angle / 2), 0.0, 0.0])
    for value, came, expected, count in (
        (-3.0 * turned, True, 0.25 * angle, 0),
        (turned, False, 0.0, 0),
        (np.zeros(4), True, 0.0, 1),
        (np.full(4, np.nan), True, 0.0, 1),
    ):
        _, estimate, left_out = corrected(filtering, memory, (sample(np.zeros(3), came=False), sample(value, came)))
        pulled = 2.0 * np.arcsin(np.asarray(estimate.attitude)[1] * old[0])
        np.testing.assert_allclose(pulled, expected, atol=1e-6)
        assert int(left_out) == count


def test_numbers_out_of_range_and_sensors_that_say_nothing_of_the_chaser_are_refused():
    numbers = {"period": np.nan, "disturbance_bound": -1.0, "disturbance_walk": -2.0, "outlier_probability": 0.0}
    for name, wrong in (numbers | {"frequencies": (0.02, 0.02)}).items():
        with pytest.raises(ScenarioError, match=name):
            build([Place(1e-3)], **{name: wrong})
    for sensors in ([], [Turned(1.0)]):
        with pytest.raises(ScenarioError, match="none of the chaser's motion"):
            build(sensors)
