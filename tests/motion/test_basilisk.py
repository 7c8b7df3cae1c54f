"""Relative motion against Basilisk, an independent flight-dynamics simulator (test extra `basilisk`)."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from truths import frames

from keepout.motion import NoDisturbance, Orbit, RelativeMotion

spacecraft = pytest.importorskip(
    "Basilisk.simulation.spacecraft", reason="Basilisk is not installed: pip install 'keepout[basilisk]'"
)


def fly_in_basilisk(states, mu, duration):
    """End positions (m) and velocities (m/s), inertial, of spacecraft that start from the given ones."""
    from Basilisk.utilities import SimulationBaseClass, macros, simIncludeGravBody

    simulation = SimulationBaseClass.SimBaseClass()
    simulation.CreateNewProcess("process").addTask(simulation.CreateNewTask("task", macros.sec2nano(1.0)))
    crafts, factories = [], []
    for index, (position, velocity) in enumerate(states):
        craft = spacecraft.Spacecraft()
        craft.ModelTag = f"craft{index}"
        factory = simIncludeGravBody.gravBodyFactory()
        earth = factory.createEarth()
        earth.isCentralBody = True
        earth.mu = mu
        factory.addBodiesTo(craft)
        craft.hub.r_CN_NInit = [[float(x)] for x in position]
        craft.hub.v_CN_NInit = [[float(x)] for x in velocity]
        simulation.AddModelToTask("task", craft)
        crafts.append(craft)
        factories.append(factory)  # Basilisk holds no reference of its own
    simulation.InitializeSimulation()
    simulation.ConfigureStopTime(macros.sec2nano(duration))
    simulation.ExecuteSimulation()
    return [(np.array(m.r_CN_N), np.array(m.v_CN_N)) for m in (craft.scStateOutMsg.read() for craft in crafts)]


@pytest.mark.parametrize(("semi_major_axis", "eccentricity"), [(7e6, 0.0), (7.5e6, 0.1)])
def test_free_flight_over_3000_seconds(semi_major_axis, eccentricity):
    orbit = Orbit(semi_major_axis, eccentricity, true_anomaly=0.3, inclination=0.8, right_ascension=1.0)
    motion = RelativeMotion(orbit)
    position, velocity = jnp.array([60.0, -50.0, 62.0]), jnp.array([0.02, -0.03, 0.01])
    target = orbit.inertial_state(jnp.float64(0.0))
    chaser = frames.eci_from_vvlh(position, velocity, *target)
    ends = fly_in_basilisk([target, chaser], float(orbit.gravitational_parameter), 3000.0)
    (target_position, target_velocity), (chaser_position, chaser_velocity) = [
        (jnp.asarray(r), jnp.asarray(v)) for r, v in ends
    ]
    expected = frames.vvlh_from_eci(chaser_position, chaser_velocity, target_position, target_velocity)

    @eqx.filter_jit
    def coast(state):
        def body(state, _):
            return motion.step(state, jnp.zeros(3), NoDisturbance(), 1.0, 20.0), None

        return jax.lax.scan(body, state, length=3000)[0]

    state = coast(motion.initial_state(position, velocity))
    np.testing.assert_allclose(state.position, expected[0], atol=1e-6)
    np.testing.assert_allclose(state.velocity, expected[1], atol=1e-9)
    print(f"Basilisk: largest difference {np.abs(state.position - expected[0]).max():.1e} m")
