"""On board with sensors: the same estimates, law, guard and pulses as in the loop, in numbers."""

import equinox as eqx
import jax
import numpy as np
import pytest

from keepout.errors import ControlError
from keepout.flight import loop
from keepout.flight.on_board_navigation import OnBoardNavigation
from keepout.mission.build import prepare
from keepout.mission.scenario import Scenario

pytestmark = pytest.mark.long

ENTRIES = {
    "start": {"position": [0.0, 8.0, 4.0]},
    "goal": {"position": [3.0, 8.0, 5.0]},
    "control": {"guidance": "straight"},
    "navigation": {"suite": "close", "dropout": 0.2, "most_missed": 2},
    "thrusters": {"layout": "six", "modulation": "delta-sigma"},
}
STEPS = 60
KEY = jax.random.key(4)


@pytest.fixture(scope="module")
def setup_and_start():
    mission = prepare(Scenario.parse(ENTRIES))
    return mission.setup, mission.initial


@pytest.fixture(scope="module")
def flown(setup_and_start):
    """The flight: what each sensor said, each row, and the on-times."""
    setup, initial = setup_and_start

    @eqx.filter_jit
    def step(state):
        samples = setup.navigation.suite.sample(state.sensors, state.motion)[1]
        after, row = loop.step(setup, state)
        return after, samples, row, setup.thrusters.fire(state.thrusters, row.guarded_force)[1].on_time

    state, steps = eqx.filter_jit(loop.start)(setup, initial, KEY), []
    first = state.navigation.bounded
    for _ in range(STEPS):
        state, *rest = step(state)
        steps.append(jax.device_get(rest))
    # The first estimate, that this flight drew: the centre of the set with which it begins.
    estimate = eqx.tree_at(lambda s: (s.position, s.velocity), initial, (first.position.centre, first.velocity.centre))
    return estimate, steps


@pytest.fixture(scope="module")
def on_board(setup_and_start, flown):
    return OnBoardNavigation(setup_and_start[0], flown[0])


def told(samples, time):
    return [(time, one.value) if one.came else None for one in samples]


def test_forces_and_on_times_are_those_of_the_loop(on_board, flown):
    estimate, steps = flown
    assert on_board.one_kernel
    assert not all(one.came for samples, _, _ in steps for one in samples)
    for again in range(2):  # the second time after a restart, which forgets everything
        on_board.restart(estimate)
        for samples, row, on_time in steps:
            time = float(row.time)
            force, known = on_board.step(time, told(samples, time)), on_board.known
            close = {"rtol": 0.0, "atol": 1e-9}
            np.testing.assert_allclose(force, row.guarded_force, **close)
            np.testing.assert_allclose(known.position, row.estimated_position, **close)
            np.testing.assert_allclose(known.velocity, row.estimated_velocity, **close)
            np.testing.assert_allclose(known.known_position, row.known_position, **close)
            np.testing.assert_allclose(known.known_velocity, row.known_velocity, **close)
            np.testing.assert_allclose(known.errors, [row.known_position_error, row.known_velocity_error], **close)
            np.testing.assert_allclose(known.on_time, on_time, **close)
            assert (known.control_status, known.guard_status) == (row.control_status, row.guard_status)
            assert (known.outliers, known.contradicted, known.not_due) == (row.outliers, row.contradicted, 0), again
    assert np.max([on_time for *_, on_time in steps]) > 0.1
    assert on_board.known.on_time.shape == (6,)


def test_a_sample_that_is_no_number_is_left_out(on_board, flown):
    estimate, steps = flown
    on_board.restart(estimate)
    for time, (samples, _, _) in enumerate(steps[:5]):
        on_board.step(float(time), told(samples, float(time)))
    force = on_board.step(5.0, [(5.0, np.full(3, np.nan)), (5.0, np.full(3, np.nan))])
    assert np.isfinite(force).all()
    assert on_board.known.outliers == 2
    assert np.isfinite(on_board.known.errors).all()
    assert np.isfinite(on_board.step(6.0, [None, None])).all()


def test_another_time_is_refused_and_a_sample_of_another_time_left_out(on_board, flown):
    estimate, steps = flown
    on_board.restart(estimate)
    with pytest.raises(ControlError, match="told the time 15 s; 0 s is due, when the estimate"):
        on_board.step(15.0, [None, None])
    on_board.step(0.0, told(steps[0][0], 0.0))
    for time in (0.0, 1.5, 20.0, np.nan):
        with pytest.raises(ControlError, match="1 s is due, a period after"):
            on_board.step(time, [None, None])
    value = np.asarray(steps[0][0][0].value)
    on_board.step(1.0, [(0.0, value), None])  # the sample of the step before, once more
    twice = on_board.known
    assert twice.not_due == 1
    on_board.restart(estimate)
    on_board.step(0.0, told(steps[0][0], 0.0))
    on_board.step(1.0, [None, None])
    np.testing.assert_array_equal(twice.known_position, on_board.known.known_position)
    assert on_board.known.not_due == 0


def test_wrong_samples_are_named(on_board, setup_and_start, flown):
    on_board.restart(flown[0])
    with pytest.raises(ControlError, match="1 samples; the suite has 2 sensors"):
        on_board.step(0.0, [None])
    with pytest.raises(ControlError, match="sample 1 has 2 numbers; it must have 3"):
        on_board.step(0.0, [None, (0.0, np.zeros(2))])
    setup, initial = setup_and_start
    without = eqx.tree_at(lambda s: s.navigation, setup, None, is_leaf=lambda x: x is None)
    with pytest.raises(ControlError, match="no navigation; fly it with OnBoard"):
        OnBoardNavigation(without, initial)
