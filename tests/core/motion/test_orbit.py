import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from keepout.core.errors import ScenarioError
from keepout.core.motion.orbit import Orbit, eccentric_anomaly, perturbed_frame

solve = jax.jit(eccentric_anomaly)


@example(3.14159, 0.99)
@example(1e-9, 0.99)
@given(st.floats(-50, 50), st.floats(0, 0.99))
def test_kepler_equation_holds_to_rounding(mean, eccentricity):
    E = float(solve(jnp.float64(mean), jnp.float64(eccentricity)))
    wrapped = mean - 2 * np.pi * np.round(mean / (2 * np.pi))
    assert abs(E - eccentricity * np.sin(E) - wrapped) <= 1e-15
    assert abs(E) <= np.pi + 1e-15


@jax.jit
def along(orbit, time):
    """The frame, the inertial state and the perturbed frame without perturbations, and what changes in a second."""

    def all_(time):
        position, velocity = orbit.inertial_state(time)
        plain = perturbed_frame(position, velocity, orbit.gravitational_parameter, ())
        return orbit.true_anomaly_at(time), orbit.frame(time), position, velocity, plain

    return jax.jvp(all_, (time,), (jnp.ones(()),))


@pytest.mark.long
@pytest.mark.parametrize("eccentricity", [0.0, 0.1, 0.7])
def test_rates_are_derivatives_and_the_motion_obeys_newton(eccentricity):
    orbit = Orbit(1.2e7, eccentricity, 0.4, inclination=1.0, right_ascension=2.0, argument_of_perigee=3.0)
    (_, frame, position, velocity, plain), (rate, turning, moved, acceleration, _) = along(orbit, jnp.float64(777.0))
    np.testing.assert_allclose(frame.angular_velocity, [0, -rate, 0], rtol=1e-12)
    np.testing.assert_allclose(frame.angular_acceleration, turning.angular_velocity, rtol=1e-10, atol=1e-22)
    np.testing.assert_allclose(np.linalg.norm(position), frame.radius, rtol=1e-15)
    np.testing.assert_allclose(velocity, moved, rtol=1e-11)
    mu = orbit.gravitational_parameter
    energy = velocity @ velocity / 2 - mu / np.linalg.norm(position)
    np.testing.assert_allclose(energy, -mu / (2 * orbit.semi_major_axis), rtol=1e-14)
    np.testing.assert_allclose(acceleration, -mu * position / np.linalg.norm(position) ** 3, rtol=1e-11)
    np.testing.assert_allclose(plain.radius, frame.radius, rtol=1e-14)
    np.testing.assert_allclose(plain.angular_velocity, frame.angular_velocity, atol=1e-17)
    np.testing.assert_allclose(plain.angular_acceleration, frame.angular_acceleration, atol=1e-19)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ((-7e6,), "semi_major_axis"),
        ((float("nan"),), "semi_major_axis"),
        ((7e6, 1.0), "eccentricity"),
        ((7e6, -0.1), "eccen"),
    ],
)
def test_impossible_orbits_are_refused(arguments, named):
    with pytest.raises(ScenarioError, match=named):
        Orbit(*arguments)
