"""The law and its delay wrapper with an estimate that brings its own disturbance."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from truths.operations import operation

from keepout.control import profiles
from keepout.control.delay import AheadOfDelay
from keepout.control.guidance.guidance import StraightGuidance
from keepout.control.observer import NoObserver
from keepout.fields.analytic import BoxUnionField
from keepout.motion.disturbance import ConstantDisturbance, NoDisturbance
from keepout.motion.orbit import Orbit
from keepout.motion.relative import RelativeMotion

MOTION = RelativeMotion(Orbit(6_778_137.0))
CASE = operation(motion=MOTION)
BOX = BoxUnionField(jnp.asarray([[-1.5, -1.5, -1.5]]), jnp.asarray([[1.5, 1.5, 1.5]]), jnp.asarray(0.02))
GOAL = np.array([4.0, -4.0, 0.0])
GUIDANCE = StraightGuidance(jnp.asarray(GOAL), jnp.asarray(0.1), jnp.asarray(1.5))
LAW = profiles.default(BOX, CASE, GOAL, guidance=GUIDANCE)
PUSH = jnp.array([0.004, -0.007, 0.002])
STATE = MOTION.initial_state([6.0, -4.5, 1.0], [-0.02, 0.01, 0.0])


def flown(law, estimate, memory):
    return jax.jit(lambda m, e: law.step(m, e))(memory, estimate)


@pytest.mark.long
def test_the_law_cancels_the_estimates_disturbance_and_its_observer_rests():
    told = dataclasses.replace(STATE, disturbance=PUSH)
    memory = LAW.initial_state(STATE)
    learnt = jnp.linspace(0.01, 0.02, memory.observer.shape[0])
    memory = dataclasses.replace(memory, observer=learnt, started=jnp.asarray(True))
    after, order = flown(LAW, told, memory)
    np.testing.assert_array_equal(after.observer, memory.observer)
    np.testing.assert_array_equal(order.disturbance_estimate, PUSH)
    plain = dataclasses.replace(LAW, observer=NoObserver())
    _, without = flown(plain, STATE, plain.initial_state(STATE))
    np.testing.assert_allclose(order.force, without.force - PUSH, rtol=0, atol=1e-15)
    # An estimate without one leaves it to the observer.
    after, order = flown(LAW, STATE, memory)
    assert float(jnp.max(jnp.abs(after.observer - memory.observer))) > 1e-3
    assert float(jnp.max(jnp.abs(order.disturbance_estimate - PUSH))) > 1e-3


@pytest.mark.long
def test_the_state_ahead_of_a_delay_feels_the_estimates_disturbance():
    law = AheadOfDelay(LAW, MOTION, CASE.chaser.mass, CASE.period, 2)
    pending = jnp.array([[0.02, 0.0, -0.01], [0.0, 0.03, 0.01]])
    ahead = law.ahead(dataclasses.replace(STATE, disturbance=PUSH), pending)
    truth = STATE
    for force in pending:
        truth = MOTION.step(truth, force, ConstantDisturbance(PUSH), CASE.period, CASE.chaser.mass)
    np.testing.assert_allclose(ahead.position, truth.position, rtol=0, atol=1e-12)
    np.testing.assert_allclose(ahead.velocity, truth.velocity, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(ahead.disturbance, PUSH)
    without = law.ahead(STATE, pending)
    truth = STATE
    for force in pending:
        truth = MOTION.step(truth, force, NoDisturbance(), CASE.period, CASE.chaser.mass)
    assert without.disturbance is None
    np.testing.assert_array_equal(without.position, truth.position)
