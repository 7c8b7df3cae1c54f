import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from keepout.core.motion import rotation
from keepout.core.motion.orbit import Orbit
from keepout.core.motion.rotation import orbital_rate, vvlh_axes

ORBIT = Orbit(9e6, 0.2, true_anomaly=0.7, inclination=0.9, right_ascension=2.0, argument_of_perigee=-1.1)
TARGET = ORBIT.inertial_state(jnp.float64(400.0))


def test_axes_of_an_equatorial_circular_orbit():
    position, velocity = jnp.array([7e6, 0.0, 0.0]), jnp.array([0.0, 7500.0, 0.0])
    vvlh = vvlh_axes(position, velocity)
    np.testing.assert_allclose(vvlh, [[0, 1, 0], [0, 0, -1], [-1, 0, 0]], atol=1e-15)
    np.testing.assert_allclose(orbital_rate(position, velocity), [0, 0, 7500 / 7e6], rtol=1e-15)


def test_orbital_frame_and_frames_give_the_same_rate():
    rate = ORBIT.frame(jnp.float64(400.0)).angular_velocity
    np.testing.assert_allclose(vvlh_axes(*TARGET) @ orbital_rate(*TARGET), rate, atol=1e-17)


@jax.jit
def turned(q, p, vector):
    return rotation.matrix(q) @ vector, rotation.matrix(rotation.multiply(q, p))


@given(st.integers(0, 2**32 - 1))
def test_quaternions_mean_what_scipy_means(seed):
    vector, a, b = np.random.default_rng(seed).normal(size=(3, 3)) * np.array([[1.0], [2.0], [2.0]])
    left, right = Rotation.from_rotvec(a), Rotation.from_rotvec(b)
    there, both = turned(*(jnp.asarray(r.as_quat(scalar_first=True)) for r in (left, right)), jnp.asarray(vector))
    np.testing.assert_allclose(there, left.apply(vector), atol=1e-14)
    np.testing.assert_allclose(both, (left * right).as_matrix(), atol=1e-14)


def test_quaternion_rate_follows_a_turning_frame():
    """A frame that turns at ω against another: integrate the rate and compare with the closed form."""
    omega = jnp.array([0.3, -0.2, 0.5])
    start = rotation.normalise(jnp.array([0.5, 0.1, -0.7, 0.2]))

    def exact(t):
        turn = Rotation.from_rotvec(-np.asarray(omega) * t)  # components turn against the frame
        return turn.as_matrix() @ np.asarray(rotation.matrix(start))

    step = 1e-6
    numeric = (exact(step) - exact(-step)) / (2 * step)
    _, slope = jax.jvp(rotation.matrix, (start,), (rotation.rate(start, omega),))
    np.testing.assert_allclose(slope, numeric, atol=1e-9)
