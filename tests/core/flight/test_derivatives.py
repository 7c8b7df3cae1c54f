"""The derivative of a flight's outcome by the numbers of its setup, against central differences of the same flight."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from truths import operations

from keepout.core.control import profiles
from keepout.core.control.geodesic import Geodesic
from keepout.core.control.guidance import Straight
from keepout.core.control.observer import NoObserver
from keepout.core.control.velocity import SwitchingCirculation
from keepout.core.errors import ControlError
from keepout.core.fields.own import SphereField
from keepout.core.flight import loop
from keepout.core.flight.setup import FlightSetup
from keepout.core.guard.braking import GuardAssumptions
from keepout.core.guard.guard import Guard
from keepout.core.motion.disturbance import paper_disturbance

STEPS = 30
GOAL = np.array([0.0, -4.0, -1.0])


def flown(*, guarded=False, guidance=None, **chosen):
    """Fly round a ball of 1 m, near enough that barrier, speed limit and filter act."""
    field = SphereField(jnp.zeros(3), jnp.ones(()))
    operation = operations.operation(error_bound=0.0)
    law = profiles.default(field, operation, GOAL, guidance=guidance or Straight(), **chosen)
    assumed = GuardAssumptions(20.0, 0.1, 1.0, 0.0142, 8e-5, 0.0, 1.1e-8, 100.0, 0.15)
    setup = FlightSetup(
        operation.motion,
        paper_disturbance(),
        operation.chaser.thrusters,
        law,
        goal=GOAL,
        mass=operation.chaser.mass,
        guard=Guard(field, threshold=0.5, lipschitz=1.0, assumptions=assumed) if guarded else None,
    )
    return setup, operation.motion.initial_state([0.3, 2.3, 0.6], [0.0, 0.0, 0.0])


def cost(flight):
    """Time-integrated error, and Δv; and by how much the safe velocity is not the desired one."""
    setup, initial = flight
    log = loop.trace(setup, initial, STEPS, jax.random.key(0))
    error = jnp.sum(jnp.linalg.norm(log.position - setup.goal, axis=-1)) * setup.period
    delta_v = jnp.sum(jnp.sqrt(jnp.sum(log.force**2, axis=-1))) * setup.period / setup.mass
    return error + 100.0 * delta_v, jnp.max(jnp.abs(log.safe_velocity - log.desired_velocity))


NUMBERS = {
    "tracking gain": (lambda f: f[0].controller.tracking.gain, None, 1e-5),
    "barrier rate": (lambda f: f[0].controller.velocity.class_k.rate, None, 1e-6),
    "braking": (lambda f: f[0].controller.velocity.class_k.braking, None, 1e-7),
    "offset": (lambda f: f[0].controller.velocity.offset, None, 1e-6),
    "slowing length": (lambda f: f[0].controller.velocity.guidance.slowing_length, None, 1e-5),
    "true mass": (lambda f: f[0].mass, None, 1e-4),
    "the law's mass": (lambda f: f[0].controller.mass, None, 1e-4),
    "start": (lambda f: f[1].position, (0,), 1e-6),
    "start's height": (lambda f: f[1].position, (2,), 1e-6),
    "velocity": (lambda f: f[1].velocity, (1,), 1e-7),
    "amplitude": (lambda f: f[0].disturbance.amplitude, (0, 1), 1e-6),
    "frequency": (lambda f: f[0].disturbance.frequency, (0, 0), 1e-6),
    "radius of the ball": (lambda f: f[0].controller.velocity.field.radius, None, 1e-6),
    "semi-major axis": (lambda f: f[0].motion.orbit.semi_major_axis, None, 1e3),
    "eccentricity": (lambda f: f[0].motion.orbit.eccentricity, None, 1e-5),
}
FEW = "tracking gain", "true mass", "start", "amplitude", "offset"


@pytest.mark.parametrize(
    ("chosen", "names"),
    [
        pytest.param({}, tuple(NUMBERS), marks=pytest.mark.slow),
        # tests/core/control/test_guidance.py has the derivative of the guidance alone
        pytest.param({"guidance": Geodesic(spacing=0.4)}, (*FEW, "start's height"), marks=pytest.mark.slow),
        pytest.param(
            {"guarded": True, "circulation": SwitchingCirculation(), "observer": NoObserver()},
            FEW,
            marks=pytest.mark.slow,
        ),
    ],
    ids=["default", "geodesic", "guard, circulation, interior point"],
)
def test_the_gradient_of_a_flight_is_that_of_central_differences(chosen, names):
    flight = flown(**chosen)
    # The differences are of the same program's values: one is compiled.
    sloped = eqx.filter_jit(eqx.filter_value_and_grad(cost, has_aux=True))
    (_, barrier), slopes = sloped(flight)
    assert chosen or barrier > 0.01, "the barrier takes part"
    for name in names:
        where, index, step = NUMBERS[name]
        number = where(flight)
        direction = np.zeros(np.shape(number))
        direction[() if index is None else index] = 1.0
        ends = (eqx.tree_at(where, flight, number + side * step * direction) for side in (1.0, -1.0))
        high, low = (float(sloped(end)[0][0]) for end in ends)
        found = float(np.sum(np.asarray(where(slopes)) * direction))
        assert found == pytest.approx((high - low) / (2.0 * step), rel=2e-5, abs=1e-6), name
    for place, leaf in jax.tree_util.tree_leaves_with_path(slopes):
        assert np.all(np.isfinite(leaf)), jax.tree_util.keystr(place)


@pytest.mark.long
def test_a_law_that_differentiates_itself_is_refused():
    setup, state = flown(feedforward=True)
    with pytest.raises(ControlError, match="default law"):
        eqx.filter_eval_shape(
            eqx.filter_grad(lambda law: law.step(law.initial_state(state), state)[1].lyapunov), setup.controller
        )
