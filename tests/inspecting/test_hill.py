"""Hill's equations against the matrix exponential of their definition, and against the exact relative motion."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from keepout.inspecting.hill import closing_velocity, coast_matrix, push_matrix
from keepout.motion.disturbance import NoDisturbance
from keepout.motion.orbit import Orbit
from keepout.motion.perturbation import EARTH_GRAVITATIONAL_PARAMETER
from keepout.motion.relative import RelativeMotion

N = 0.001027


def system():
    """VVLH: x along the velocity, y against the orbit normal, z to nadir; states, then the held acceleration."""
    a = np.zeros((9, 9))
    a[:3, 3:6] = np.eye(3)
    a[3, 5] = 2 * N
    a[4, 1] = -(N**2)
    a[5, 2], a[5, 3] = 3 * N**2, -2 * N
    a[3:6, 6:] = np.eye(3)
    return a


@pytest.mark.parametrize("seconds", [0.0, 10.0, 1000.0, 6118.0, 12236.0])
def test_both_matrices_are_the_exponential_of_the_equations(seconds):
    whole = expm(system() * seconds)
    assert np.allclose(coast_matrix(N, seconds), whole[:6, :6], rtol=1e-9, atol=1e-7)
    assert np.allclose(push_matrix(N, seconds), whole[:6, 6:], rtol=1e-8, atol=1e-5)


def test_times_of_any_shape_give_a_matrix_each():
    times = np.array([[1.0, 20.0], [300.0, 4000.0]])
    assert coast_matrix(N, times).shape == (2, 2, 6, 6)
    assert np.array_equal(push_matrix(N, times)[1, 0], push_matrix(N, 300.0))


def test_the_exact_motion_follows_them_near_the_target():
    motion = RelativeMotion(Orbit((EARTH_GRAVITATIONAL_PARAMETER / N**2) ** (1 / 3)))
    state = np.array([30.0, -20.0, 10.0, 0.01, 0.02, -0.015])
    at = motion.initial_state(state[:3], state[3:])
    for _ in range(60):
        at = motion.step(at, jnp.array([0.001, -0.002, 0.003]), NoDisturbance(), 10.0, 1.0)
    told = coast_matrix(N, 600.0) @ state + push_matrix(N, 600.0) @ [0.001, -0.002, 0.003]
    assert np.linalg.norm(np.asarray(at.position) - told[:3]) < 2e-2
    assert np.linalg.norm(told[:3] - state[:3]) > 100.0


def test_the_closing_velocity_gives_an_ellipse_about_the_target():
    place = np.array([40.0, 7.0, -15.0])
    state = np.concatenate([place, closing_velocity(N, place)])
    times = np.linspace(0.0, 2 * np.pi / N, 721)
    path = (coast_matrix(N, times) @ state)[:, :3]
    assert np.allclose(path[-1], path[0], atol=1e-6)
    assert np.allclose(path[:, 0] ** 2 / 4 + path[:, 2] ** 2, 40.0**2 / 4 + 15.0**2)
