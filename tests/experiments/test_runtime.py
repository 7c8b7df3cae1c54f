"""Computation time: the usual way is the same law, and what is missing is said."""

import dataclasses
import warnings

import jax.numpy as jnp
import numpy as np
import pytest

from keepout.control.velocity import VelocityPoint
from keepout.control.velocity_program.cone import ConeStatus
from keepout.experiments import step_times
from keepout.mission.build import prepare
from keepout.mission.scenario import Scenario


@pytest.fixture(scope="module")
def printed():
    pytest.importorskip("torch", exc_type=ImportError)
    pytest.importorskip("cvxpy", exc_type=ImportError)
    control = {"profile": "paper", "paper": {"gradient_error": 0.2}}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return prepare(Scenario().replace(control=control, guard={"enabled": False}))


@pytest.mark.long
def test_the_usual_way_is_the_same_law(printed):
    usual, law = step_times.usual_way(printed), printed.setup.controller
    layer = dataclasses.replace(law.velocity, differentiate=False)
    draw = np.random.default_rng(0)
    compared = 0
    for position in draw.uniform([-6.0, -6.0, -6.0], [6.0, 6.0, 6.0], (12, 3)):
        velocity = draw.uniform(-0.1, 0.1, 3)
        point, _ = layer(jnp.asarray(position), jnp.asarray(velocity), jnp.zeros(3))
        if point.status != ConeStatus.SOLVED or float(point.barrier) < 0.05:
            continue
        barrier, normal, safe = usual.safe_velocity(position)
        assert barrier == pytest.approx(float(point.barrier), abs=2e-5)
        np.testing.assert_allclose(normal, point.normal, atol=2e-4)
        np.testing.assert_allclose(safe, point.velocity, atol=1e-4)
        drift = usual.drift(position, velocity)
        state = printed.setup.motion.initial_state(position, velocity)
        np.testing.assert_allclose(drift, printed.setup.motion.drift_acceleration(state), atol=1e-9)
        flat = VelocityPoint(
            point.barrier, point.normal, point.desired, point.velocity, jnp.zeros((3, 3)), point.status
        )
        ours = law.tracking(flat, jnp.asarray(position) - law.goal, jnp.asarray(velocity), jnp.asarray(drift), law.mass)
        theirs = usual._tracked(
            *(float(point.barrier), np.asarray(point.normal), np.asarray(point.velocity)),
            *(np.zeros(3), position, velocity, drift),
        )
        np.testing.assert_allclose(theirs, ours.control, rtol=1e-6, atol=1e-9)
        compared += 1
    assert compared >= 4
    assert usual.unsolved == 0
