"""A body that gravity turns: against SciPy's DOP853 on Euler's equations, and libration in closed form."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from keepout.errors import ScenarioError
from keepout.mission import environment, turning_bounds
from keepout.mission.orbit_bounds import orbit_bounds
from keepout.mission.scenario import Scenario
from keepout.motion import NoDisturbance

MU = 3.986004418e14
INERTIA = np.array([[120.0, 8, -5], [8, 90, 4], [-5, 4, 60]])
RADIUS = 6.9e6


def scenario_of(rates, duration=3000.0, period=1.0, inertia=INERTIA):
    attitude = {
        "kind": "tumbling",
        "angular_velocity": tuple(rates),
        "inertia": tuple(tuple(row) for row in inertia.tolist()),
        "gravity_gradient": True,
    }
    orbit = {"semi_major_axis": RADIUS}
    return Scenario().replace(attitude=attitude, orbit=orbit, duration=duration, control={"period": period})


def truth(rates, duration, inertia=INERTIA, start=None):
    """ω and the body axes (rows) in inertial space, on a circular orbit in the x-z plane of VVLH at the start."""
    n = np.sqrt(MU / RADIUS**3)

    def derivative(t, y):
        w, axes = y[:3], y[3:].reshape(3, 3)
        # VVLH at the start: x forward, z to nadir, and the frame turns about −y.
        nadir = axes @ np.array([-np.sin(n * t), 0.0, np.cos(n * t)])
        torque = 3.0 * n**2 * np.cross(nadir, inertia @ nadir)
        spin = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        return np.concatenate([np.linalg.solve(inertia, torque - np.cross(w, inertia @ w)), (-spin @ axes).ravel()])

    begin = np.concatenate([rates, (np.eye(3) if start is None else start).ravel()])
    times = np.arange(0.0, duration + 0.25, 0.25)
    return times, solve_ivp(derivative, (0.0, duration), begin, "DOP853", times, rtol=1e-12, atol=1e-14).y[:3].T


@pytest.mark.parametrize("rates", [(0.0, 0.0, 0.0), (0.002, -0.001, 0.0005), (0.01, -0.02, 0.005)])
def test_no_rate_of_a_body_that_gravity_turns_is_beyond_the_bound(rates):
    scenario = scenario_of(rates)
    motion = environment.relative_motion(scenario)
    _, omega = truth(np.array(rates), scenario.duration)
    rate, acceleration = turning_bounds.pulled(
        motion, period=1.0, steps=scenario.steps, lowest_radius=orbit_bounds(scenario).lowest_radius
    )
    largest = np.linalg.norm(omega, axis=1).max()
    assert largest <= rate <= largest * 1.03 + 4e-6
    assert np.linalg.norm(np.diff(omega, axis=0) / 0.25, axis=1).max() <= acceleration
    state = motion.initial_state(np.zeros(3), np.zeros(3))
    step = lambda s, _: (motion.step(s, jnp.zeros(3), NoDisturbance(), 1.0, 1.0), s.angular_velocity)  # noqa: E731
    flown = np.asarray(jax.jit(lambda s: jax.lax.scan(step, s, length=scenario.steps + 1)[1])(state))
    np.testing.assert_allclose(flown, omega[::4], atol=1e-9)


def test_motions_of_the_same_numbers_that_are_stepped_otherwise_have_bounds_of_their_own():
    scenario = scenario_of((0.0, 0.0, 0.0), duration=200.0, period=10.0)  # gravity alone turns it, ever faster
    motion = environment.relative_motion(scenario)
    numbers = {"period": 10.0, "steps": scenario.steps, "lowest_radius": RADIUS}
    coarse, fine = (
        turning_bounds.pulled(dataclasses.replace(motion, substeps=substeps), **numbers) for substeps in (1, 20)
    )
    assert coarse != fine
    assert coarse == pytest.approx(fine, rel=1e-4)


def test_a_long_body_swings_about_the_vertical_at_the_rate_in_the_textbook():
    """Pitch libration: n √(3 (I_x − I_z)/I_y), Hughes section 9.2; 1e-3 rad about the vertical."""
    inertia, n = np.diag([100.0, 110.0, 20.0]), np.sqrt(MU / RADIUS**3)
    frequency = n * np.sqrt(3.0 * (100.0 - 20.0) / 110.0)
    quarter = 0.5 * np.pi / frequency
    scenario = scenario_of((0.0, -n + 1e-3 * frequency, 0.0), duration=quarter, inertia=inertia)
    motion = environment.relative_motion(scenario)
    state = motion.initial_state(np.zeros(3), np.zeros(3))
    steps = round(quarter)
    step = lambda s, _: (motion.step(s, jnp.zeros(3), NoDisturbance(), quarter / steps, 1.0), None)  # noqa: E731
    end = jax.jit(lambda s: jax.lax.scan(step, s, length=steps)[0])(state)
    assert float(end.angular_velocity[1]) == pytest.approx(-n, abs=1e-6 * frequency)  # at the turning point


def test_the_bounds_without_torque_are_those_of_energy_and_momentum():
    rates = np.array([0.01, -0.02, 0.005])
    rate, acceleration = turning_bounds.free(rates, INERTIA)
    least = np.linalg.eigvalsh(INERTIA)[0]
    assert rate == pytest.approx(np.sqrt(rates @ INERTIA @ rates / least))
    assert acceleration == pytest.approx(np.linalg.norm(INERTIA @ rates) * rate / least)


def test_a_body_that_turns_too_fast_for_its_steps_is_refused():
    with pytest.raises(ScenarioError, match=r"attitude\.angular_velocity"):
        environment.flight_bounds(scenario_of((1.0, 0.5, 0.0), duration=100.0, period=10.0))


def test_only_a_tumbling_body_is_turned():
    with pytest.raises(ScenarioError, match='gravity_gradient needs kind = "tumbling"'):
        Scenario().replace(attitude={"gravity_gradient": True})
