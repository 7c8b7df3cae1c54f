"""On board, the same law and guard as in the loop, in numbers."""

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
from keepout.errors import ControlError
from keepout.fields.analytic import SphereField
from keepout.fields.grid import GridField
from keepout.fields.neural import NeuralField
from keepout.flight import FlightSetup, loop
from keepout.flight.on_board import OnBoard
from keepout.guard.guard import Guard
from keepout.mission.build import prepare
from keepout.mission.scenario import Scenario
from keepout.motion import Orbit, RelativeMotion, Thrusters, paper_disturbance

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
