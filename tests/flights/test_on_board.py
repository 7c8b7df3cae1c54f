"""On board, the same estimates, law, guard and pulses as in the loop, in numbers."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from truths.flights import Spring
from truths.guarded_worlds import ASSUMED
from truths.operations import operation

from keepout.core.control import profiles
from keepout.core.control.geodesic import GeodesicGuidance
from keepout.core.control.guidance import Straight
from keepout.core.control.law import ControlStatus, Law, PolicyLaw
from keepout.core.errors import ControlError
from keepout.core.fields.grid import GridField
from keepout.core.fields.neural import NeuralField
from keepout.core.fields.own import SphereField
from keepout.core.flight import loop
from keepout.core.flight.setup import FlightSetup
from keepout.core.geometry.target import Target
from keepout.core.guard.guard import Guard
from keepout.core.guard.safety_layer import GuardFlag
from keepout.core.mission.build import prepare
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.core.motion.chaser import Thrusters
from keepout.core.motion.disturbance import NoDisturbance, paper_disturbance
from keepout.core.motion.orbit import Orbit
from keepout.core.motion.relative import RelativeMotion
from keepout.flights.navigation.suites import navigation
from keepout.flights.on_board import Clock, OnBoard

pytestmark = pytest.mark.long

GOAL = jnp.array([0.0, -6.0, -3.0])
MOTION = RelativeMotion(Orbit(6_778_137.0))
PLACE, STILL = np.array([0.5, 7.0, 4.0]), np.zeros(3)
RESTING = MOTION.initial_state(PLACE, STILL)


@pytest.fixture(scope="module")
def setup():
    sphere = SphereField(jnp.zeros(3), jnp.asarray(2.0))
    law = profiles.default(sphere, operation(motion=MOTION, error_bound=0.0), GOAL, guidance=Straight())
    guard = Guard(field=sphere, threshold=0.5, lipschitz=1.0, assumptions=ASSUMED)
    return FlightSetup(MOTION, paper_disturbance(), Thrusters(0.1), law, GOAL, 20.0, guard=guard)


@pytest.fixture(scope="module")
def on_board(setup):
    return OnBoard(setup, RESTING)


def beside_the_loop(setup, initial, on_board, steps):
    """Fly the loop and tell its states on board: each row of the loop, and the force on board."""
    assert on_board.one_kernel
    state, step = eqx.filter_jit(loop.start)(setup, initial, jax.random.key(0)), eqx.filter_jit(loop.step)
    for _ in range(steps):
        told = state.motion
        state, row = step(setup, state)
        force = on_board.step(float(told.time), told.position, told.velocity, told.attitude, told.angular_velocity)
        yield row, force


def test_forces_are_those_of_the_loop(setup, on_board):
    on_board.restart(RESTING)
    for row, force in beside_the_loop(setup, RESTING, on_board, 40):
        order = on_board.order
        assert np.allclose(force, row.guarded_force, rtol=0.0, atol=1e-12)
        assert np.allclose(order.safe_velocity, row.safe_velocity, rtol=0.0, atol=1e-12)
        assert np.allclose(order.disturbance_estimate, row.disturbance_estimate, rtol=0.0, atol=1e-12)
        assert np.allclose([order.barrier, order.lyapunov], [row.barrier, row.lyapunov])
        assert (order.control_status, order.guard_status) == (row.control_status, row.guard_status)
    # The observer has learned something by now, and forgets it.
    assert np.linalg.norm(on_board.order.disturbance_estimate) > 0.005
    on_board.restart(RESTING)
    on_board.step(0.0, PLACE, STILL)
    assert np.linalg.norm(on_board.order.disturbance_estimate) == 0.0


def push(time, position, velocity):
    """Full thrust towards the sphere."""
    return jnp.array([-0.1, 0.0, 0.0])


NOTHING = [np.zeros(3)] * 2


@pytest.fixture(scope="module")
def pushed():
    """A law that pushes, behind a guard whose estimate has errors and whose commands act two steps late."""
    sphere = SphereField(jnp.zeros(3), jnp.asarray(2.0))
    assumed = dataclasses.replace(ASSUMED, position_error=0.05, velocity_error=0.002, delay=2)
    guard = Guard(field=sphere, threshold=0.5, lipschitz=1.0, assumptions=assumed)
    setup = FlightSetup(MOTION, NoDisturbance(), Thrusters(0.1), PolicyLaw(GOAL, push), GOAL, 20.0, guard=guard)
    return OnBoard(setup, MOTION.initial_state([9.5, 0.0, 0.0], [-0.14, 0.0, 0.0]), on_gap="begin anew")


def flown_on(on_board, state, steps, under_way=NOTHING):
    """Fly the true state in a straight line's motion; least distance from the sphere, and all flags."""
    (time, position, velocity), queue, least, flags = state, list(under_way), np.inf, 0
    for _ in range(steps):
        queue.append(np.asarray(on_board.step(time, position, velocity)) / 20.0)
        acceleration = queue.pop(0)
        position, velocity = position + velocity + 0.5 * acceleration, velocity + acceleration
        time, least = time + 1.0, min(least, float(np.linalg.norm(position)) - 2.0)
        flags |= on_board.order.guard_status & ~3
    return (time, position, velocity), queue, least, flags


def restarted(on_board, state, under_way=None):
    on_board.restart(MOTION.initial_state(state[1], state[2]), under_way)
    return state


AFAR = 0.0, np.array([9.5, 0.0, 0.0]), np.array([-0.14, 0.0, 0.0])


@pytest.mark.parametrize("lag", [0.0, 4.0, 15.0])
def test_a_first_step_long_after_it_was_built_begins_with_what_it_tells(pushed, lag):
    restarted(pushed, AFAR, NOTHING)
    start = lag, AFAR[1] + AFAR[2] * lag, AFAR[2]
    _, _, least, flags = flown_on(pushed, start, 150)
    assert flags == 0
    assert least > 0.5


def test_a_time_that_is_not_due_is_refused_or_begins_anew(on_board, pushed, setup):
    on_board.restart(RESTING)
    on_board.step(5.0, PLACE, STILL)
    force = on_board.step(6.0, PLACE, STILL)
    for time in (6.0, 6.5, 7.001, 22.0, -1.0, np.nan):
        with pytest.raises(ControlError, match="7 s is due"):
            on_board.step(time, PLACE, STILL)
    np.testing.assert_array_equal(on_board.order.force, force)
    on_board.step(7.0, PLACE, STILL)
    # Begun anew it flies as after a restart, wherever it was before.
    (time, position, velocity), _, _, flags = flown_on(pushed, restarted(pushed, AFAR, NOTHING), 5)
    later = time + 10.0, position + 10.0 * velocity, velocity
    flags |= flown_on(pushed, later, 3)[3]
    anew = pushed.order.force
    flown_on(pushed, restarted(pushed, later, NOTHING), 3)
    assert flags == 0
    np.testing.assert_array_equal(anew, pushed.order.force)
    with pytest.raises(ControlError, match="begin anew"):
        OnBoard(setup, MOTION.initial_state(position, velocity), on_gap="never mind")


@pytest.mark.parametrize("delay", [1, 2, 3])
def test_between_control_steps_it_is_known_what_acts_once_nothing_does(delay):
    clock = Clock(0.5)
    clock.stepped(7.0, np.ones(3))
    acts_until = 7.0 + 0.5 * delay + 0.5
    for time in (7.5 + 0.5 * np.arange(0.1, 5.0, 0.2)).tolist():
        assert clock.tells(time, delay) == (time >= acts_until)


def test_a_restart_keeps_what_is_under_way(pushed):
    start = 0.0, np.array([9.0, 0.0, 0.0]), np.zeros(3)
    state, queue, _, flags = flown_on(pushed, restarted(pushed, start, NOTHING), 12)
    for time in (state[0] - 1.0, state[0] + 0.5):  # what is under way then is not known
        with pytest.raises(ControlError, match=r"the commands under way$"):
            pushed.step(time, state[1], state[2])
    for given in (None, "queue"):
        restarted(pushed, state, given and 20.0 * np.array(queue))
        state, queue, _, more = flown_on(pushed, state, 12, queue)
        flags |= more
    assert flags == 0
    # Told of what is not under way, the guard sees that it was not.
    restarted(pushed, state, [[0.1, 0.1, 0.1], [0.1, 0.1, 0.1]])
    assert flown_on(pushed, state, 12, queue)[3] & GuardFlag.STATE_JUMP
    with pytest.raises(ControlError, match=r"under_way has the shape \(1, 2\)"):
        restarted(pushed, state, [[1.0, 2.0]])


@pytest.mark.slow
def test_a_mission_as_it_is_prepared_is_one_kernel():
    """Learned field, geodesic guidance, and the guard with its grid field."""
    mission = prepare(Scenario())
    law, guard = mission.setup.controller.velocity, mission.setup.guard
    assert (type(law.field), type(law.guidance), type(guard.field)) == (NeuralField, GeodesicGuidance, GridField)
    on_board, largest = OnBoard(mission.setup, mission.initial), 0.0
    for row, force in beside_the_loop(mission.setup, mission.initial, on_board, 30):
        # The network's float32 products are summed in another order, and each observer believes its own force.
        assert np.allclose(force, row.guarded_force, rtol=0.0, atol=2e-5)
        assert on_board.order.guard_status == row.guard_status
        largest = max(largest, float(np.linalg.norm(force)))
    assert largest > 0.01


def test_a_number_that_is_none_is_answered_and_forgotten(on_board):
    on_board.restart(RESTING)
    force = on_board.step(0.0, [np.nan, 7.0, 4.0], np.zeros(3))
    assert np.isfinite(force).all()
    assert on_board.order.control_status == ControlStatus.NOT_FINITE
    force = on_board.step(1.0, [0.5, 7.0, 4.0], np.zeros(3))
    assert np.isfinite(force).all()
    assert on_board.order.control_status in (ControlStatus.NOMINAL, ControlStatus.SATURATED)
    on_board.restart(RESTING)
    with pytest.raises(ControlError, match="step at 3 s tells no finite state to begin with"):
        on_board.step(3.0, [np.nan, 7.0, 4.0], np.zeros(3))


def test_wrong_numbers_are_named(on_board):
    with pytest.raises(ControlError, match="position has 1 numbers; it must have 3"):
        on_board.step(0.0, np.ones(1), np.zeros(3))
    with pytest.raises(ControlError, match="target_orbit is given"):
        on_board.step(0.0, np.ones(3), np.zeros(3), target_orbit=np.zeros(6))


class Keyed(Law):
    """A law whose memory is a random key."""

    @property
    def goal(self):
        return GOAL

    def initial_state(self, state):
        return jax.random.key(0)

    def step(self, state, estimate):
        return state, None


def test_a_memory_that_is_not_numbers_is_refused():
    setup = FlightSetup(MOTION, paper_disturbance(), Thrusters(0.1), Keyed(), GOAL, 20.0)
    with pytest.raises(ControlError, match="memory of law and guard must be arrays of numbers"):
        OnBoard(setup, RESTING)


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
def navigated():
    """A setup with sensors and thrusters that are on or off, a law that is cheap to compile, and a start."""
    scenario, field = Scenario.parse(ENTRIES), SphereField(jnp.zeros(3), jnp.asarray(2.0))
    law = Spring(Surroundings(scenario).motion, jnp.asarray(scenario.goal.position))
    assumed = Surroundings(scenario, Target.load("box")).guard_assumptions
    setup = Surroundings(scenario).setup(law, field=field, guard=Guard(field, 0.5, 1.0, assumed))
    setup = dataclasses.replace(setup, navigation=navigation(scenario, setup.motion, assumed))
    return setup, setup.motion.initial_state(np.asarray(scenario.start.position), np.zeros(3))


@pytest.fixture(scope="module")
def flown(navigated):
    """The flight: what each sensor said, each row, and the on-times."""
    setup, initial = navigated

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
def navigator(navigated, flown):
    return OnBoard(navigated[0], flown[0], by_samples=True)


def told(samples, time):
    return [(time, one.value) if one.came else None for one in samples]


@pytest.mark.slow  # sensors and pulses are flown in core/mission/test_navigation
def test_forces_and_on_times_are_those_of_the_loop(navigator, flown):
    estimate, steps = flown
    assert navigator.one_kernel
    assert not all(one.came for samples, _, _ in steps for one in samples)
    for again in range(2):  # the second time after a restart, which forgets everything
        navigator.restart(estimate)
        for samples, row, on_time in steps:
            time = float(row.time)
            force, known = navigator.step(time, samples=told(samples, time)), navigator.known
            close = {"rtol": 0.0, "atol": 1e-9}
            np.testing.assert_allclose(force, row.guarded_force, **close)
            np.testing.assert_allclose(known.position, row.estimated_position, **close)
            np.testing.assert_allclose(known.velocity, row.estimated_velocity, **close)
            np.testing.assert_allclose(known.known_position, row.known_position, **close)
            np.testing.assert_allclose(known.known_velocity, row.known_velocity, **close)
            np.testing.assert_allclose(known.errors, [row.known_position_error, row.known_velocity_error], **close)
            np.testing.assert_allclose(known.on_time, on_time, **close)
            assert (navigator.order.control_status, navigator.order.guard_status) == (
                row.control_status,
                row.guard_status,
            )
            assert (known.outliers, known.contradicted, known.not_due) == (row.outliers, row.contradicted, 0), again
    assert np.max([on_time for *_, on_time in steps]) > 0.1
    assert navigator.known.on_time.shape == (6,)


@pytest.mark.slow  # by the flight of the test before
def test_a_sample_that_is_no_number_is_left_out(navigator, flown):
    estimate, steps = flown
    navigator.restart(estimate)
    for time, (samples, _, _) in enumerate(steps[:5]):
        navigator.step(float(time), samples=told(samples, float(time)))
    force = navigator.step(5.0, samples=[(5.0, np.full(3, np.nan)), (5.0, np.full(3, np.nan))])
    assert np.isfinite(force).all()
    assert navigator.known.outliers == 2
    assert np.isfinite(navigator.known.errors).all()
    assert np.isfinite(navigator.step(6.0, samples=[None, None])).all()


@pytest.mark.slow  # by the flight of the test before
def test_another_time_is_refused_and_a_sample_of_another_time_left_out(navigator, flown):
    estimate, steps = flown
    navigator.restart(estimate)
    with pytest.raises(ControlError, match="told the time 15 s; 0 s is due, when the estimate"):
        navigator.step(15.0, samples=[None, None])
    navigator.step(0.0, samples=told(steps[0][0], 0.0))
    for time in (0.0, 1.5, 20.0, np.nan):
        with pytest.raises(ControlError, match="1 s is due, a period after"):
            navigator.step(time, samples=[None, None])
    value = np.asarray(steps[0][0][0].value)
    navigator.step(1.0, samples=[(0.0, value), None])  # the sample of the step before, once more
    twice = navigator.known
    assert twice.not_due == 1
    navigator.restart(estimate)
    navigator.step(0.0, samples=told(steps[0][0], 0.0))
    navigator.step(1.0, samples=[None, None])
    np.testing.assert_array_equal(twice.known_position, navigator.known.known_position)
    assert navigator.known.not_due == 0


@pytest.mark.slow  # by the flight of the test before
def test_wrong_samples_are_named(navigator, navigated, flown):
    navigator.restart(flown[0])
    with pytest.raises(ControlError, match="1 samples; the suite has 2 sensors"):
        navigator.step(0.0, samples=[None])
    with pytest.raises(ControlError, match="sample 1 has 2 numbers; it must have 3"):
        navigator.step(0.0, samples=[None, (0.0, np.zeros(2))])
    setup, initial = navigated
    without = eqx.tree_at(lambda s: s.navigation, setup, None, is_leaf=lambda x: x is None)
    with pytest.raises(ControlError, match="no navigation; build it without by_samples"):
        OnBoard(without, initial, by_samples=True)
