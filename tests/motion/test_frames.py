import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from truths import frames

from keepout.motion import Orbit, rotation
from keepout.motion.frames import orbital_rate, vvlh_axes

ORBIT = Orbit(9e6, 0.2, true_anomaly=0.7, inclination=0.9, right_ascension=2.0, argument_of_perigee=-1.1)
TARGET = ORBIT.inertial_state(jnp.float64(400.0))
seeds = st.integers(0, 2**32 - 1)


def vectors(seed, *scales):
    generator = np.random.default_rng(seed)
    return tuple(jnp.asarray(scale * generator.standard_normal(3)) for scale in scales)


def test_axes_of_an_equatorial_circular_orbit():
    position, velocity = jnp.array([7e6, 0.0, 0.0]), jnp.array([0.0, 7500.0, 0.0])
    vvlh = vvlh_axes(position, velocity)
    np.testing.assert_allclose(vvlh, [[0, 1, 0], [0, 0, -1], [-1, 0, 0]], atol=1e-15)
    np.testing.assert_allclose(frames.rtn_axes(position, velocity), np.eye(3), atol=1e-15)
    np.testing.assert_allclose(orbital_rate(position, velocity), [0, 0, 7500 / 7e6], rtol=1e-15)


@settings(max_examples=30, deadline=None)
@given(seeds)
def test_rtn_and_vvlh_agree_through_eci(seed):
    position, velocity = vectors(seed, 100.0, 0.5)
    there = frames.rtn_from_eci(*frames.eci_from_vvlh(position, velocity, *TARGET), *TARGET)
    direct = frames.rtn_from_vvlh(position, velocity)
    np.testing.assert_allclose(there[0], direct[0], atol=1e-7)
    np.testing.assert_allclose(there[1], direct[1], atol=1e-10)
    back = frames.vvlh_from_eci(*frames.eci_from_rtn(*direct, *TARGET), *TARGET)
    np.testing.assert_allclose(back[0], position, atol=1e-7)
    np.testing.assert_allclose(back[1], velocity, atol=1e-10)
    exact = frames.vvlh_from_rtn(*direct)
    np.testing.assert_array_equal(exact[0], position)
    np.testing.assert_array_equal(exact[1], velocity)


def test_velocity_in_vvlh_is_the_rate_of_the_position_in_vvlh():
    """The rotation rates are right if differentiating converted positions gives the converted velocity."""
    chaser = Orbit(9.01e6, 0.21, true_anomaly=0.7, inclination=0.9, right_ascension=2.0, argument_of_perigee=-1.1)

    def both(time):
        states = *chaser.inertial_state(time), *ORBIT.inertial_state(time)
        return frames.vvlh_from_eci(*states), frames.rtn_from_eci(*states)

    moment, one = jnp.float64(321.0), jnp.ones(())
    converted, rates = jax.jit(lambda t: jax.jvp(both, (t,), (one,)))(moment)
    for (_, velocity), (rate, _) in zip(converted, rates, strict=True):
        np.testing.assert_allclose(velocity, rate, rtol=1e-9, atol=1e-9)


def test_orbital_frame_and_frames_give_the_same_rate():
    rate = ORBIT.frame(jnp.float64(400.0)).angular_velocity
    np.testing.assert_allclose(vvlh_axes(*TARGET) @ orbital_rate(*TARGET), rate, atol=1e-17)


@settings(max_examples=30, deadline=None)
@given(seeds)
def test_body_and_vvlh_are_inverse_and_a_body_fixed_point_stands_still(seed):
    position, omega, frame_rate, quaternion = vectors(seed, 30.0, 0.01, 1e-3, 1.0)
    attitude = rotation.normalise(jnp.concatenate([jnp.array([0.3]), quaternion]))
    in_vvlh = frames.vvlh_from_body(position, jnp.zeros(3), attitude, omega, frame_rate)
    # A point at rest in the body moves in VVLH with the relative rotation.
    relative = rotation.matrix(attitude).T @ omega - frame_rate
    np.testing.assert_allclose(in_vvlh[1], np.cross(relative, in_vvlh[0]), atol=1e-13)
    back = frames.body_from_vvlh(*in_vvlh, attitude, omega, frame_rate)
    np.testing.assert_allclose(back[0], position, atol=1e-12)
    np.testing.assert_allclose(back[1], 0, atol=1e-12)


@settings(max_examples=50, deadline=None)
@given(seeds)
def test_quaternions_mean_what_scipy_means(seed):
    vector, a, b = vectors(seed, 1.0, 2.0, 2.0)
    left, right = Rotation.from_rotvec(np.array(a)), Rotation.from_rotvec(np.array(b))
    q, p = (jnp.asarray(r.as_quat(scalar_first=True)) for r in (left, right))
    np.testing.assert_allclose(rotation.matrix(q) @ vector, left.apply(np.array(vector)), atol=1e-14)
    np.testing.assert_allclose(rotation.matrix(rotation.multiply(q, p)), (left * right).as_matrix(), atol=1e-14)


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
