import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from truths import frames

from keepout.core.errors import ScenarioError
from keepout.core.motion import rotation
from keepout.core.motion.attitude import InertiallyFixed, Tumbling, VVLHFixed
from keepout.core.motion.disturbance import paper_disturbance, steady
from keepout.core.motion.orbit import J2, Drag, Orbit, SolarPressure
from keepout.core.motion.relative import RelativeMotion, gravity_difference

INERTIA = np.array([[120.0, 8.0, -5.0], [8.0, 90.0, 4.0], [-5.0, 4.0, 60.0]])
CASES = [(7e6, 0.0), (7.5e6, 0.1), (2.3e7, 0.7)]


@eqx.filter_jit
def compiled_coast(motion, state, steps, disturbance, force, period, mass):

    def body(_, state):
        return motion.step(state, force, disturbance, period, mass)

    return jax.lax.fori_loop(0, steps, body, state)


def coast(motion, state, steps, disturbance=None, force=(0.0, 0.0, 0.0), period=1.0, mass=20.0):
    """Fly; as few different programs as there are kinds of motion, since compiling dominates."""
    disturbance = steady([0.0, 0.0, 0.0]) if disturbance is None else disturbance
    numbers = (np.asarray(value, float) for value in (force, period, mass))
    return compiled_coast(motion, state, np.asarray(steps), disturbance, *map(jnp.asarray, numbers))


def longdouble_kepler(position, velocity, mu, time):
    """Position and velocity `time` later on a Kepler orbit, by universal variables in extended precision."""
    L = np.longdouble
    r0, v0, mu, time = np.asarray(position, L), np.asarray(velocity, L), L(mu), L(time)
    radius, radial = np.sqrt(r0 @ r0), r0 @ v0
    alpha = 2 / radius - v0 @ v0 / mu
    root = np.sqrt(mu)
    x = root * alpha * time
    for _ in range(200):
        z = alpha * x * x
        s = np.sqrt(z)
        C, S = (1 - np.cos(s)) / z, (s - np.sin(s)) / (s * z)
        F = radial / root * x * x * C + (1 - alpha * radius) * x**3 * S + radius * x - root * time
        slope = radial / root * x * (1 - z * S) + (1 - alpha * radius) * x * x * C + radius
        step = F / slope
        x -= step
        if abs(step) < abs(x) * L(1e-18):
            break
    z = alpha * x * x
    s = np.sqrt(z)
    C, S = (1 - np.cos(s)) / z, (s - np.sin(s)) / (s * z)
    r = (1 - x * x / radius * C) * r0 + (time - x**3 / root * S) * v0
    distance = np.sqrt(r @ r)
    v = root / (distance * radius) * (z * x * S - x) * r0 + (1 - x * x / distance * C) * v0
    return r, v


def differenced_truth(orbit, position, velocity, time):
    """VVLH position and velocity from two inertial Kepler orbits, differenced in extended precision."""
    L = np.longdouble
    target = tuple(np.asarray(x, L) for x in inertial_state(orbit, 0.0))
    mu = float(orbit.gravitational_parameter)

    def axes(r, v):
        z = -r / np.sqrt(r @ r)
        h = np.cross(r, v)
        y = -h / np.sqrt(h @ h)
        return np.stack([np.cross(y, z), y, z]), h / (r @ r)

    C, rate = axes(*target)
    offset = C.T @ np.asarray(position, L)
    chaser = target[0] + offset, target[1] + C.T @ np.asarray(velocity, L) + np.cross(rate, offset)
    target_end = longdouble_kepler(*target, mu, time)
    chaser_end = longdouble_kepler(*chaser, mu, time)
    C, rate = axes(*target_end)
    difference = chaser_end[0] - target_end[0]
    speed = chaser_end[1] - target_end[1] - np.cross(rate, difference)
    return (C @ difference).astype(float), (C @ speed).astype(float)


inertial_state = jax.jit(lambda orbit, time: orbit.inertial_state(time))
orbital_rate = jax.jit(lambda motion, state: motion.orbital_frame(state).angular_velocity)
drift = eqx.filter_jit(lambda motion, state: motion.drift_acceleration(state))
eci_from_vvlh, body_from_vvlh = jax.jit(frames.eci_from_vvlh), jax.jit(frames.body_from_vvlh)
vvlh_from_body = jax.jit(frames.vvlh_from_body)


def bounded_velocity(orbit, position):
    """A velocity that gives the chaser the target's orbital period, so that it stays near for a whole orbit."""
    target = inertial_state(orbit, 0.0)
    (r, still), (_, moving) = (eci_from_vvlh(position, jnp.array([x, 0.0, 0.0]), *target) for x in (0.0, 1.0))
    along = np.asarray(moving - still)
    energy = orbit.gravitational_parameter * (2 / np.linalg.norm(r) - 1 / orbit.semi_major_axis)
    b = float(along @ still)
    return jnp.array([-b + np.sign(b) * np.sqrt(b * b - float(still @ still - energy)), 0.0, 0.0])


@pytest.mark.long
@pytest.mark.parametrize(("semi_major_axis", "eccentricity"), CASES)
def test_two_kepler_orbits_differenced_after_one_orbit(semi_major_axis, eccentricity):
    orbit = Orbit(semi_major_axis, eccentricity, true_anomaly=0.3, inclination=0.8)
    position = jnp.array([60.0, -50.0, 62.0])
    velocity = bounded_velocity(orbit, position)
    motion = RelativeMotion(orbit)
    steps = int(orbit.period)
    state = coast(motion, motion.initial_state(position, velocity), steps)
    expected_position, expected_velocity = differenced_truth(orbit, position, velocity, float(steps))
    assert np.linalg.norm(expected_position) < 2e3
    np.testing.assert_allclose(state.position, expected_position, atol=1e-8)
    np.testing.assert_allclose(state.velocity, expected_velocity, atol=1e-10)


def test_against_an_integrator_with_force_and_disturbance():
    """The whole equation of motion, written down again from the paper, at tight tolerance over 300 s."""
    mu, a, e = float(Orbit(7.4e6).gravitational_parameter), 7.4e6, 0.1
    force, mass = np.array([0.03, -0.02, 0.05]), 20.0

    def rate(t, y):
        theta, r, v = y[0], y[1:4], y[4:7]
        turn = np.sqrt(mu / (a * (1 - e**2)) ** 3) * (1 + e * np.cos(theta)) ** 2
        turn_dot = -2 * mu * e * np.sin(theta) * (1 + e * np.cos(theta)) ** 3 / (a * (1 - e**2)) ** 3
        w, w_dot = np.array([0.0, -1, 0]) * turn, np.array([0.0, -1, 0]) * turn_dot
        target = np.array([0.0, 0, -1]) * a * (1 - e**2) / (1 + e * np.cos(theta))
        chaser = target + r
        g = mu * (chaser / np.linalg.norm(chaser) ** 3 - target / np.linalg.norm(target) ** 3)
        push = force + 0.01 * np.array([np.sin(0.02 * t), np.cos(0.02 * t), np.sin(0.01 * t)])
        acceleration = -2 * np.cross(w, v) - np.cross(w_dot, r) - np.cross(w, np.cross(w, r)) - g + push / mass
        return np.concatenate([[turn], v, acceleration])

    position, velocity = [0.0, 10.0, 6.0], [0.01, -0.02, 0.03]
    end = solve_ivp(rate, (0, 300), [1.0, *position, *velocity], method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    motion = RelativeMotion(Orbit(a, e, true_anomaly=1.0))
    state = coast(motion, motion.initial_state(position, velocity), 300, paper_disturbance(), force, mass=mass)
    np.testing.assert_allclose(state.position, end[1:4], atol=2e-8)
    np.testing.assert_allclose(state.velocity, end[4:7], atol=2e-10)


@pytest.mark.long
@pytest.mark.parametrize("kind", ["turned", "inertial", "tumbling"])
def test_every_body_frame_sees_the_same_flight(kind):
    """Free flight in any turning body frame, converted to VVLH, is the free flight in VVLH."""
    orbit = Orbit(7.4e6, 0.1, true_anomaly=1.0)
    attitude = rotation.normalise(jnp.array([0.5, 0.1, -0.7, 0.2]))
    law = {
        "turned": VVLHFixed(attitude),
        "inertial": InertiallyFixed(attitude),
        "tumbling": Tumbling(np.deg2rad([0.3, -0.2, 0.35]), INERTIA, attitude),
    }[kind]
    reference, turning = RelativeMotion(orbit), RelativeMotion(orbit, law)
    start, drifting = jnp.array([4.0, 10.0, 6.0]), jnp.array([0.01, -0.02, 0.03])
    straight = reference.initial_state(start, drifting)
    frame = orbit.frame(jnp.float64(0.0))
    omega = law.initial_angular_velocity(frame)
    turned = turning.initial_state(*body_from_vvlh(start, drifting, attitude, omega, frame.angular_velocity))
    straight, turned = coast(reference, straight, 1000), coast(turning, turned, 1000)
    rate = orbital_rate(turning, turned)
    got = vvlh_from_body(turned.position, turned.velocity, turned.attitude, turned.angular_velocity, rate)
    np.testing.assert_allclose(got[0], straight.position, atol=1e-8)
    np.testing.assert_allclose(got[1], straight.velocity, atol=1e-10)


@pytest.mark.long
def test_tumbling_conserves_energy_and_angular_momentum():
    law = Tumbling(np.deg2rad([0.4, -0.2, 0.3]), INERTIA)
    orbit = Orbit(7.4e6, 0.05, inclination=1.2)
    motion = RelativeMotion(orbit, law)
    first = motion.initial_state(jnp.ones(3), jnp.zeros(3))
    last = coast(motion, first, 3000)

    def energy(state):
        return state.angular_velocity @ INERTIA @ state.angular_velocity / 2

    def momentum(state):  # in ECI, where it is constant
        eci_from_body = (rotation.matrix(state.attitude) @ frames.vvlh_axes(*inertial_state(orbit, state.time))).T
        return eci_from_body @ INERTIA @ state.angular_velocity

    assert np.linalg.norm(last.angular_velocity - first.angular_velocity) > 1e-3  # it did tumble
    np.testing.assert_allclose(energy(last), energy(first), rtol=1e-11)
    np.testing.assert_allclose(momentum(last), momentum(first), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(last.attitude), 1, atol=1e-15)


@pytest.mark.long
@pytest.mark.parametrize(
    "law",
    [
        pytest.param(VVLHFixed(), marks=pytest.mark.slow),
        pytest.param(InertiallyFixed(), marks=pytest.mark.slow),
        Tumbling([0.002, 0.001, -0.003], INERTIA),
    ],
    ids=["VVLH", "inertial", "tumbling"],
)
def test_perturbed_motion_against_an_independent_inertial_integration(law):
    """J2, drag and sunlight: both spacecraft integrated in ECI with SciPy, from formulas written down again."""
    orbit = Orbit(6.9e6, 0.01, 0.5, inclination=0.9, right_ascension=1.0, argument_of_perigee=2.0)
    mu, j2, earth, spin = 3.986004418e14, 1.08262668e-3, 6378137.0, 7.292115e-5
    drag = Drag(target_area_to_mass=0.02, chaser_area_to_mass=0.05, density=1e-12, altitude=4.5e5, scale_height=6e4)
    # Along the orbit's normal the sun is never behind the Earth.
    sun = np.cross(*map(np.asarray, inertial_state(orbit, 0.0)))
    sun /= np.linalg.norm(sun)
    motion = RelativeMotion(orbit, law, (J2(), drag, SolarPressure(0.02, 0.5, tuple(sun))))
    state = motion.initial_state(jnp.array([30.0, -20.0, 15.0]), jnp.array([0.02, 0.01, -0.03]))

    def acceleration(r, v, area, lit_area):
        R = np.linalg.norm(r)
        # gradient of the J2 potential, component by component
        k = -1.5 * j2 * mu * earth**2 / R**5
        u = (r[2] / R) ** 2
        oblate = k * np.array([r[0] * (1 - 5 * u), r[1] * (1 - 5 * u), r[2] * (3 - 5 * u)])
        air = v - np.cross([0, 0, spin], r)
        density = 1e-12 * np.exp(-(R - earth - 4.5e5) / 6e4)
        return -mu * r / R**3 + oblate - 0.5 * density * area * np.linalg.norm(air) * air - 4.56e-6 * lit_area * sun

    def derivative(t, y):
        forces = acceleration(y[:3], y[3:6], 0.02, 0.02), acceleration(y[6:9], y[9:12], 0.05, 0.5)
        return np.concatenate([y[3:6], forces[0], y[9:12], forces[1]])

    def to_eci(state):
        rate = orbital_rate(motion, state)
        r, v = vvlh_from_body(state.position, state.velocity, state.attitude, state.angular_velocity, rate)
        axes = frames.vvlh_axes(state.target_orbit[:3], state.target_orbit[3:])
        return np.concatenate([axes.T @ r, axes.T @ (v + jnp.cross(rate, r))])

    start = np.concatenate([state.target_orbit, state.target_orbit + to_eci(state)])
    truth = solve_ivp(derivative, (0, 1500), start, method="DOP853", rtol=1e-13, atol=1e-9, max_step=20).y[:, -1]
    found = to_eci(coast(motion, state, 1500))
    # doubles hold 7000 km to 1e-9 m and the truth is a difference of such numbers, so 1e-6 m is what it can show
    np.testing.assert_allclose(found[:3], truth[6:9] - truth[:3], atol=2e-6)
    np.testing.assert_allclose(found[3:], truth[9:] - truth[3:6], atol=2e-9)


def test_gravity_difference_keeps_its_digits():
    """Against exact rational arithmetic of the square and a 60-digit root."""
    from decimal import Decimal, localcontext

    target, relative = np.array([1.0e6, -2.0e6, 6.5e6]), np.array([1e-3, 2e-3, -5e-4])
    with localcontext() as context:
        context.prec = 60
        T, r = [Decimal(float(x)) for x in target], [Decimal(float(x)) for x in relative]
        S = [a + b for a, b in zip(T, r)]
        cube = lambda u: (sum(x * x for x in u).sqrt()) ** 3  # noqa: E731
        expected = [float(s / cube(S) - t / cube(T)) for s, t in zip(S, T)]
    np.testing.assert_allclose(gravity_difference(jnp.asarray(relative), jnp.asarray(target)), expected, rtol=1e-14)


@pytest.mark.long
def test_drift_acceleration_is_what_a_short_step_shows():
    motion = RelativeMotion(Orbit(7e6, 0.2, 1.0), Tumbling([0.002, 0.001, -0.003], INERTIA))
    state = motion.initial_state(jnp.array([20.0, -10.0, 5.0]), jnp.array([0.05, 0.1, -0.02]))
    after = coast(motion, state, 1, period=0.01)
    gained = np.asarray(after.velocity - state.velocity) / 0.01
    np.testing.assert_allclose(gained, drift(motion, state), rtol=1e-3, atol=1e-10)


@pytest.mark.parametrize(
    ("inertia", "named"),
    [
        (np.diag([1.0, 1.0, 3.0]), "largest at most the sum"),
        (np.diag([1.0, -1.0, 1.0]), "positive"),
        (np.array([[1.0, 0.5, 0], [0, 1, 0], [0, 0, 1]]), "symmetric"),
        (np.full((3, 3), np.nan), "finite"),
    ],
)
def test_tensors_of_no_rigid_body_are_refused(inertia, named):
    with pytest.raises(ScenarioError, match=named):
        Tumbling(jnp.zeros(3), inertia)


def test_substeps_must_be_at_least_one():
    with pytest.raises(ScenarioError, match="substeps"):
        RelativeMotion(Orbit(7e6), substeps=0)
