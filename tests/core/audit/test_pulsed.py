"""The audit of flights whose thrusters give pulses: sound between the samples, and no weaker where there are none."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from keepout.core.audit.tube import FlightBounds, Tube
from keepout.core.motion.disturbance import NoDisturbance
from keepout.core.motion.orbit import Orbit
from keepout.core.motion.relative import RelativeMotion
from keepout.flights.thrusters.layout import preset
from keepout.flights.thrusters.on_off import OnOffThrusters, thruster_errors

pytestmark = pytest.mark.long

MASS = 20.0


def bounds(**chosen):
    return FlightBounds(
        mass=MASS, disturbance_force=0.0, angular_rate=1.2e-3, angular_acceleration=0.0, gravity_gradient=3e-6, **chosen
    )


@eqx.filter_jit
def fly(model, motion, asked):
    def advance(carried, command):
        state, memory = carried
        memory, firing = model.fire(memory, command)
        parts = jnp.linspace(0.0, 1.0, 21)
        departure = jax.vmap(lambda t: firing.pulses.moment(2, t))(parts) / MASS
        after = motion.step(state, firing.force, NoDisturbance(), 1.0, MASS, firing.pulses)
        held = jax.vmap(lambda t: motion.step(state, firing.force, NoDisturbance(), t, MASS).position)(parts)
        return (after, memory), (state.position, state.velocity, firing.force, held + departure)

    first = motion.initial_state([0.0, 10.0, 6.0], [0.0, 0.0, 0.0]), model.initial_state(jax.random.key(0))
    return jax.lax.scan(advance, first, asked)[1]


def pulsed_flight(rise_delay):
    """Samples of a flight under random pulses, and where it was between them, from switch to switch."""
    layout = preset("six", force=0.1, arm=0.5, rise_delay=rise_delay)
    model = OnOffThrusters.of(layout, force_limit=0.1, period=1.0)
    asked = jnp.asarray(np.random.default_rng(1).uniform(-0.1, 0.1, (40, 3)))
    rows = fly(model, RelativeMotion(Orbit(6_778_000.0)), asked)
    errors = thruster_errors(layout, force_limit=0.1, mass=MASS, period=1.0, delta_sigma=False)
    return [np.asarray(row) for row in rows], errors


def test_the_tube_holds_the_pulsed_path_and_the_held_one_does_not():
    for rise_delay in (0.0, 0.01):
        (position, velocity, force, between), errors = pulsed_flight(rise_delay)
        time = np.arange(len(position), dtype=float)
        told = bounds(excursion=errors.excursion, velocity_excursion=errors.velocity_excursion)
        outside = []
        for assumed in (told, bounds()):
            tube = Tube.of(time, position[None], velocity[None], force[None], assumed)
            steps = np.arange(len(position) - 1)
            beyond = -np.inf
            for start in np.arange(0.0, 1.0, 0.05):
                ends = np.full(len(steps), start), np.full(len(steps), start + 0.05)
                point, _, radius = tube.piece(np.zeros(len(steps), int), steps, *ends)
                for k in (round(start * 20), round(start * 20) + 1):
                    away = np.linalg.norm(between[:-1, k] - point, axis=1)
                    beyond = max(beyond, float((away - radius).max()))
            outside.append(beyond)
            assert assumed is not told or tube.inconsistency().max() <= 0.0
        assert outside[0] <= 0.0
    assert outside[1] > 0.0  # with late pulses a record of mean forces alone is not a bound
