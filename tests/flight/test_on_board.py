"""On board, the same law and guard as in the loop, in numbers."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from truths.guarded_worlds import ASSUMED
from truths.operations import operation

from keepout.control import profiles
from keepout.control.guidance.guidance import GeodesicGuidance
from keepout.control.guidance.plan import Straight
from keepout.control.law import ControlStatus, Law
from keepout.control.policy import PolicyLaw
from keepout.errors import ControlError
from keepout.fields.analytic import SphereField
from keepout.fields.grid import GridField
from keepout.fields.neural import NeuralField
from keepout.flight import FlightSetup, loop
from keepout.flight.on_board import Clock, OnBoard
from keepout.guard.guard import Guard
from keepout.guard.status import GuardFlag
from keepout.mission.build import prepare
from keepout.mission.scenario import Scenario
from keepout.motion import Orbit, RelativeMotion, Thrusters, paper_disturbance
from keepout.motion.disturbance import NoDisturbance

pytestmark = pytest.mark.long

GOAL = jnp.array([0.0, -6.0, -3.0])
MOTION = RelativeMotion(Orbit(6_778_137.0))


@pytest.fixture(scope="module")
def setup():
    sphere = SphereField(jnp.zeros(3), jnp.asarray(2.0))
    law = profiles.default(sphere, operation(motion=MOTION, error_bound=0.0), GOAL, guidance=Straight())
    guard = Guard(field=sphere, threshold=0.5, lipschitz=1.0, assumptions=ASSUMED)
    return FlightSetup(MOTION, paper_disturbance(), Thrusters(0.1), law, GOAL, 20.0, guard=guard)


@pytest.fixture(scope="module")
def on_board(setup):
    return OnBoard(setup, MOTION.initial_state([0.5, 7.0, 4.0], np.zeros(3)))


def test_forces_are_those_of_the_loop(setup, on_board):
    state = loop.start(setup, MOTION.initial_state([0.5, 7.0, 4.0], np.zeros(3)), jax.random.key(0))
    step = eqx.filter_jit(loop.step)
    on_board.restart(state.motion)
    assert on_board.one_kernel
    for _ in range(40):
        told = state.motion
        state, row = step(setup, state)
        force = on_board.step(float(told.time), told.position, told.velocity, told.attitude, told.angular_velocity)
        order = on_board.order
        assert np.allclose(force, row.guarded_force, rtol=0.0, atol=1e-12)
        assert np.allclose(order.safe_velocity, row.safe_velocity, rtol=0.0, atol=1e-12)
        assert np.allclose(order.disturbance_estimate, row.disturbance_estimate, rtol=0.0, atol=1e-12)
        assert np.allclose([order.barrier, order.lyapunov], [row.barrier, row.lyapunov])
        assert (order.control_status, order.guard_status) == (row.control_status, row.guard_status)
    # The observer has learned something by now, and forgets it.
    assert np.linalg.norm(on_board.order.disturbance_estimate) > 0.005
    on_board.restart(told)
    on_board.step(float(told.time), told.position, told.velocity)
    assert np.linalg.norm(on_board.order.disturbance_estimate) == 0.0


def push(time, position, velocity):
    """Full thrust towards the sphere."""
    return jnp.array([-0.1, 0.0, 0.0])


def pushing(**changes):
    """A law that pushes, behind a guard whose estimate has errors."""
    sphere = SphereField(jnp.zeros(3), jnp.asarray(2.0))
    assumed = dataclasses.replace(ASSUMED, position_error=0.05, velocity_error=0.002, **changes)
    guard = Guard(field=sphere, threshold=0.5, lipschitz=1.0, assumptions=assumed)
    return FlightSetup(MOTION, NoDisturbance(), Thrusters(0.1), PolicyLaw(GOAL, push), GOAL, 20.0, guard=guard)


def flown_on(on_board, state, steps, under_way=()):
    """Fly the true state in a straight line's motion; least distance from the sphere, and all flags."""
    (time, position, velocity), queue, least, flags = state, list(under_way), np.inf, 0
    for _ in range(steps):
        queue.append(np.asarray(on_board.step(time, position, velocity)) / 20.0)
        acceleration = queue.pop(0)
        position, velocity = position + velocity + 0.5 * acceleration, velocity + acceleration
        time, least = time + 1.0, min(least, float(np.linalg.norm(position)) - 2.0)
        flags |= on_board.order.guard_status & ~3
    return (time, position, velocity), queue, least, flags


@pytest.fixture(scope="module")
def pushed():
    return OnBoard(pushing(), MOTION.initial_state([9.5, 0.0, 0.0], [-0.14, 0.0, 0.0]), on_gap="begin anew")


@pytest.mark.parametrize("lag", [0.0, 4.0, 15.0, 30.0])
def test_a_first_step_long_after_it_was_built_begins_with_what_it_tells(pushed, lag):
    pushed.restart(MOTION.initial_state([9.5, 0.0, 0.0], [-0.14, 0.0, 0.0]))
    start = lag, np.array([9.5 - 0.14 * lag, 0.0, 0.0]), np.array([-0.14, 0.0, 0.0])
    _, _, least, flags = flown_on(pushed, start, 150)
    assert flags == 0 or lag == 30.0
    assert least > (0.5 if lag < 30.0 else 0.0)


def test_a_time_that_is_not_due_is_refused_or_begins_anew(on_board, pushed):
    on_board.restart(MOTION.initial_state([0.5, 7.0, 4.0], np.zeros(3)))
    position, still = np.array([0.5, 7.0, 4.0]), np.zeros(3)
    on_board.step(5.0, position, still)
    force = on_board.step(6.0, position, still)
    for time in (6.0, 6.5, 7.001, 22.0, -1.0, np.nan):
        with pytest.raises(ControlError, match="7 s is due"):
            on_board.step(time, position, still)
    np.testing.assert_array_equal(on_board.order.force, force)
    on_board.step(7.0, position, still)
    # Begun anew it flies as after a restart, wherever it was before.
    start = 0.0, np.array([9.5, 0.0, 0.0]), np.array([-0.14, 0.0, 0.0])
    pushed.restart(MOTION.initial_state(start[1], start[2]))
    (time, position, velocity), _, _, flags = flown_on(pushed, start, 5)
    later = time + 10.0, position + 10.0 * velocity, velocity
    flags |= flown_on(pushed, later, 3)[3]
    anew = pushed.order.force
    pushed.restart(MOTION.initial_state(position, velocity))
    flown_on(pushed, later, 3)
    assert flags == 0
    np.testing.assert_array_equal(anew, pushed.order.force)
    with pytest.raises(ControlError, match="begin anew"):
        OnBoard(pushing(), MOTION.initial_state(position, velocity), on_gap="never mind")


@pytest.mark.parametrize("delay", [1, 2, 3])
def test_between_control_steps_it_is_known_what_acts_once_nothing_does(delay):
    clock = Clock(0.5)
    clock.stepped(7.0, np.ones(3))
    acts_until = 7.0 + 0.5 * delay + 0.5
    for time in (7.5 + 0.5 * np.arange(0.1, 5.0, 0.2)).tolist():
        assert clock.tells(time, delay) == (time >= acts_until)


def test_a_restart_keeps_what_is_under_way():
    start = 0.0, np.array([9.0, 0.0, 0.0]), np.zeros(3)
    on_board = OnBoard(pushing(delay=2), MOTION.initial_state(start[1], start[2]), on_gap="begin anew")
    state, queue, _, flags = flown_on(on_board, start, 12, [np.zeros(3)] * 2)
    for time in (state[0] - 1.0, state[0] + 0.5):  # what is under way then is not known
        with pytest.raises(ControlError, match=r"the commands under way$"):
            on_board.step(time, state[1], state[2])
    for given in (None, "queue"):
        on_board.restart(MOTION.initial_state(state[1], state[2]), given and 20.0 * np.array(queue))
        state, queue, _, more = flown_on(on_board, state, 12, queue)
        flags |= more
    assert flags == 0
    # Told of what is not under way, the guard sees that it was not.
    on_board.restart(MOTION.initial_state(state[1], state[2]), [[0.1, 0.1, 0.1], [0.1, 0.1, 0.1]])
    assert flown_on(on_board, state, 12, queue)[3] & GuardFlag.STATE_JUMP
    with pytest.raises(ControlError, match=r"under_way has the shape \(1, 2\)"):
        on_board.restart(MOTION.initial_state(state[1], state[2]), [[1.0, 2.0]])


def test_a_mission_as_it_is_prepared_is_one_kernel():
    """Learned field, geodesic guidance, and the guard with its grid field."""
    mission = prepare(Scenario())
    assert isinstance(mission.setup.controller.velocity.field, NeuralField)
    assert isinstance(mission.setup.controller.velocity.guidance, GeodesicGuidance)
    assert mission.setup.guard is not None
    assert isinstance(mission.setup.guard.field, GridField)
    on_board = OnBoard(mission.setup, mission.initial)
    assert on_board.one_kernel
    state, step = loop.start(mission.setup, mission.initial, jax.random.key(0)), eqx.filter_jit(loop.step)
    largest = 0.0
    for _ in range(30):
        told = state.motion
        state, row = step(mission.setup, state)
        force = on_board.step(float(told.time), told.position, told.velocity, told.attitude, told.angular_velocity)
        # The network's float32 products are summed in another order, and each observer believes its own force.
        assert np.allclose(force, row.guarded_force, rtol=0.0, atol=2e-5)
        assert on_board.order.guard_status == row.guard_status
        largest = max(largest, float(np.linalg.norm(force)))
    assert largest > 0.01


def test_a_number_that_is_none_is_answered_and_forgotten(on_board):
    on_board.restart(MOTION.initial_state([0.5, 7.0, 4.0], np.zeros(3)))
    force = on_board.step(0.0, [np.nan, 7.0, 4.0], np.zeros(3))
    assert np.isfinite(force).all()
    assert on_board.order.control_status == ControlStatus.NOT_FINITE
    force = on_board.step(1.0, [0.5, 7.0, 4.0], np.zeros(3))
    assert np.isfinite(force).all()
    assert on_board.order.control_status in (ControlStatus.NOMINAL, ControlStatus.SATURATED)
    on_board.restart(MOTION.initial_state([0.5, 7.0, 4.0], np.zeros(3)))
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
        OnBoard(setup, MOTION.initial_state([0.5, 7.0, 4.0], np.zeros(3)))
