"""Bounds on bent orbits and turning bodies against paths by SciPy from formulas of the tests' own."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from truths.orbits import EARTH_SPIN, MU, true_path

from keepout.core.errors import ScenarioError
from keepout.core.mission.bounds import differential_bounds, orbit_bounds, turned_by_gravity, turning_freely
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.core.motion.disturbance import NoDisturbance
from keepout.core.motion.relative import MotionState

pytestmark = pytest.mark.long

KEPLERS = "nothing but the Earth"
CASES = {
    "low and round": ({"semi_major_axis": 6.9e6, "inclination": 0.9, "j2": True}, {}, 6000.0),
    "polar with drag": (
        {"semi_major_axis": 6.8e6, "eccentricity": 0.01, "inclination": 1.57, "true_anomaly": -1.0, "j2": True},
        {"density": 3e-11, "chaser_area_to_mass": 0.2, "target_area_to_mass": 0.01},
        6000.0,
    ),
    "long ellipse": (
        {"semi_major_axis": 2e7, "eccentricity": 0.6, "inclination": 0.5, "argument_of_perigee": 1.0, "j2": True},
        {},
        30000.0,
    ),
    KEPLERS: ({"semi_major_axis": 1.2e7, "eccentricity": 0.4, "inclination": 1.0}, {}, 13000.0),
    "drag alone": ({"semi_major_axis": 6.75e6}, {"density": 1e-11, "chaser_area_to_mass": 0.05}, 3000.0),
    "sunlight and shadow": ({"semi_major_axis": 6.78e6, "inclination": 0.9}, {}, 6000.0),
}
SUN = {"direction": (0.8, 0.5, 0.2), "target_area_to_mass": 30.0, "chaser_area_to_mass": 80.0}
"""A thousand times what a spacecraft feels, so that the bounds are told from gravity's."""


def scenario_of(case):
    orbit, drag, duration = CASES[case]
    sun = SUN if case == "sunlight and shadow" else {}
    return Scenario().replace(orbit=orbit, drag=drag, sun=sun, duration=duration)


@functools.cache
def path_of(case):
    return true_path(scenario_of(case))


def turning(path):
    """Norms of the angular velocity and acceleration of VVLH, from axes a second apart by central differences."""
    r, v = path[:, :3], path[:, 3:]
    z = -r / np.linalg.norm(r, axis=1, keepdims=True)
    y = -np.cross(r, v)
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    axes = np.stack([np.cross(y, z), y, z], axis=1)
    rate = 0.5 * (axes[2:] - axes[:-2])
    skew = np.einsum("tij,tkj->tik", rate, axes[1:-1])  # dC/dt Cᵀ = −[ω×] in the frame's own axes
    omega = np.stack([skew[:, 1, 2], skew[:, 2, 0], skew[:, 0, 1]], axis=1)
    change = 0.5 * (omega[2:] - omega[:-2])
    return np.linalg.norm(omega, axis=1), np.linalg.norm(change, axis=1)


PARTS = ("low and round", "drag alone")
"""Each bends "polar with drag", too: they are tried alone by `make test-all`."""


def tried(case, *more):
    return pytest.param(case, *more, marks=[pytest.mark.slow] if case in PARTS else [])


@pytest.mark.parametrize("case", [tried(case) for case in CASES if case != KEPLERS])
def test_the_frame_never_turns_faster_and_the_target_never_flies_lower(case):
    scenario = scenario_of(case)
    path, bounds = path_of(case), orbit_bounds(scenario)
    rate, change = turning(path)
    # A central difference over two seconds is low by (ω · 1 s)²/6, about 2e-7.
    assert bounds.rate * (1 - 1e-6) >= rate.max() >= bounds.rate * (1 - 2e-3)
    assert bounds.acceleration >= change.max()
    distance = np.linalg.norm(path[:, :3], axis=1).min()
    assert distance >= bounds.lowest_radius >= distance - 6000.0
    air = path[:, 3:] - np.cross(EARTH_SPIN, path[:, :3])
    assert bounds.air_speed >= np.linalg.norm(air, axis=1).max()


@pytest.mark.parametrize(
    ("case", "attitude"),
    [*(tried(case, "tumbling") for case in CASES), ("polar with drag", "inertial"), ("long ellipse", "vvlh")],
)
def test_no_sampled_drift_exceeds_the_bound(case, attitude):
    scenario = scenario_of(case)
    turned = {"angular_velocity": (0.01, -0.02, 0.005), "inertia": ((120.0, 8, -5), (8, 90, 4), (-5, 4, 60))}
    scenario = scenario.replace(attitude={"kind": attitude} | (turned if attitude == "tumbling" else {}))
    bounds, motion = Surroundings(scenario).flight_bounds, Surroundings(scenario).motion
    path = path_of(case)
    random = np.random.default_rng(0)
    count = 10_000
    at = path[random.integers(len(path), size=count)]
    way = random.normal(size=(2, count, 3))
    way /= np.linalg.norm(way, axis=2, keepdims=True)
    r = way[0] * 10.0 ** random.uniform(-3, 3, (count, 1))
    v = way[1] * 10.0 ** random.uniform(-4, 1, (count, 1))
    initial = motion.initial_state(np.zeros(3), np.zeros(3))

    @eqx.filter_jit
    @jax.vmap
    def drift(r, v, orbit):
        state = MotionState(initial.time, r, v, initial.attitude, initial.angular_velocity, orbit)
        return jnp.linalg.norm(motion.drift_acceleration(state))

    found = np.asarray(drift(r, v, at))
    away, speed = np.linalg.norm(r, axis=1), np.linalg.norm(v, axis=1)
    kappa = bounds.angular_acceleration + bounds.angular_rate**2 + bounds.gravity_gradient
    unknown = bounds.disturbance_force - Surroundings(scenario).disturbance.bound
    allowed = 2.0 * bounds.angular_rate * speed + kappa * away + unknown / scenario.chaser.mass
    # Rounding: 1e-16 of gravity, 10 m/s².
    assert np.all(found <= allowed + 1e-14)


def test_each_part_of_the_differential_bound_is_needed():
    """At rest beside the target only the difference of the drag remains; J2's gradient is met above a pole."""
    scenario = scenario_of("polar with drag")
    orbit, motion = orbit_bounds(scenario), Surroundings(scenario).motion
    bent = differential_bounds(scenario, orbit, nearest=orbit.lowest_radius, angular_rate=orbit.rate, fastest=100.0)
    path = path_of("polar with drag")
    lowest = path[np.argmin(np.linalg.norm(path[:, :3], axis=1))]
    beside = dataclasses.replace(motion.initial_state(np.zeros(3), np.zeros(3)), target_orbit=jnp.asarray(lowest))
    drift = eqx.filter_jit(motion.drift_acceleration)(beside)
    assert bent.constant >= float(jnp.linalg.norm(drift)) > 0.5 * bent.constant
    assert Surroundings(scenario).flight_bounds.disturbance_force > Surroundings(scenario).disturbance.bound
    radius = 7e6
    (oblate,) = Surroundings(scenario_of("low and round")).motion.perturbations
    pole = jnp.array([0.0, 0.0, radius])
    steepest = jnp.linalg.norm(jax.jit(jax.jacfwd(oblate.of_target))(pole, jnp.zeros(3)), ord=2)
    scenario = scenario_of("low and round")
    plain = differential_bounds(scenario, orbit, nearest=radius, angular_rate=orbit.rate, fastest=100.0)
    assert float(steepest) == pytest.approx(plain.gradient, rel=1e-12)


def test_without_perturbations_the_bounds_are_keplers():
    scenario = Scenario().replace(orbit={"semi_major_axis": 7e6, "eccentricity": 0.05, "inclination": 1.0})
    bounds = orbit_bounds(scenario)
    perigee = 7e6 * 0.95
    assert bounds.rate == pytest.approx(np.sqrt(MU * 1.05 / perigee**3), rel=1e-12)
    assert bounds.lowest_radius == pytest.approx(perigee)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"orbit": {"semi_major_axis": 6.41e6, "j2": True}, "duration": 6000.0}, "orbit: .* stay above 6.39e"),
        ({"orbit": {"semi_major_axis": 6.6e6}, "drag": {"density": 3e-7}, "duration": 2.0}, "drag: .* thinner air"),
    ],
)
def test_orbits_without_a_bound_are_refused(changes, reason):
    with pytest.raises(ScenarioError, match=reason):
        _ = Surroundings(Scenario().replace(**changes)).flight_bounds


def test_drag_is_bounded_up_to_the_speed_that_the_guard_allows():
    """Drag alone, chaser and target alike, against the Earth's turning: what grows with speed is all that is left."""
    drag = {"density": 1e-10, "scale_height": 1e6, "chaser_area_to_mass": 50.0, "target_area_to_mass": 50.0}
    scenario = Scenario().replace(
        orbit={"semi_major_axis": 6.75e6, "inclination": np.pi},
        drag=drag,
        attitude={"kind": "inertial"},
        duration=2.0,
        chaser={"speed_limit": 600.0, "force_limit": 1e6},
    )
    assumed, motion = Surroundings(scenario, extent=5.0).guard_assumptions, Surroundings(scenario).motion
    assert assumed.speed_limit == 900.0
    start = motion.initial_state(np.zeros(3), np.zeros(3))
    forward = jnp.array([900.0, 0.0, 0.0])  # against the air, as the body begins parallel to VVLH
    fast = eqx.tree_at(lambda state: state.velocity, start, forward)
    pushed = float(np.linalg.norm(motion.drift_acceleration(fast)))
    constant = assumed.disturbance_force / assumed.mass - 0.01 * np.sqrt(2.0) / assumed.mass
    rest = assumed.drift - 2.0 * assumed.angular_rate * assumed.speed_limit
    assert pushed <= 2.0 * assumed.angular_rate * assumed.speed_limit + constant + 1e-9
    assert rest < 0.05 * pushed  # so that the speed's part is what is tested
    # The audit holds no step for bounded that is faster than this.
    assert Surroundings(scenario).flight_bounds.speed_limit == 900.0


@pytest.mark.parametrize(
    ("entries", "until"),
    [
        ({}, np.inf),
        ({"orbit": {"eccentricity": 0.01}, "attitude": {"kind": "tumbling"}}, np.inf),
        ({"orbit": {"semi_major_axis": 6.9e6, "j2": True}}, 15.5),
        ({"sun": {"chaser_area_to_mass": 0.01}}, 15.5),
        ({"orbit": {"semi_major_axis": 6.9e6}, "drag": {"density": 1e-12}, "control": {"period": 10.0}}, 20.5),
        ({"attitude": {"kind": "tumbling", "gravity_gradient": True}, "control": {"period": 0.1}}, 15.05),
    ],
)
def test_the_guard_is_told_until_when_its_numbers_hold(entries, until):
    """They hold a little beyond the last row, whose time has been added up period by period."""
    scenario = Scenario().replace(**({"duration": 15.0} | entries))
    told = Surroundings(scenario, extent=5.0).guard_assumptions.valid_until
    assert told == pytest.approx(until, abs=1e-6) if np.isfinite(until) else told == until
    last = 0.0
    for _ in range(scenario.steps):
        last += scenario.control.period
    assert last <= told
    assert Surroundings(scenario).flight_bounds.valid_until == told


def test_bounds_hold_to_the_end_of_the_last_control_period():
    """15.1 s in periods of 10 s are flown for 20 s; towards a perigee the frame turns faster until then."""
    orbit = {"semi_major_axis": 2.4e7, "eccentricity": 0.72, "true_anomaly": 5.6, "inclination": 1.0, "j2": True}
    scenario = Scenario().replace(orbit=orbit, duration=15.1, control={"period": 10.0})
    flown = scenario.steps * scenario.control.period
    assert flown == 20.0
    states = true_path(scenario.replace(duration=flown))
    r, v = states[:, :3], states[:, 3:]
    # The orbit's rate alone: the frame's, with J2, is at least that.
    rates = np.linalg.norm(np.cross(r, v), axis=1) / np.sum(r * r, axis=1)
    found = orbit_bounds(scenario)
    assert rates.max() <= found.rate
    assert np.linalg.norm(r, axis=1).min() >= found.lowest_radius
    # With the duration's own end the bound would be exceeded, so that this test can fail.
    assert rates.max() > orbit_bounds(scenario.replace(duration=15.0, control={"period": 1.0})).rate


INERTIA = np.array([[120.0, 8, -5], [8, 90, 4], [-5, 4, 60]])
RADIUS = 6.9e6


def tumbling(rates, duration=3000.0, period=1.0):
    attitude = {
        "kind": "tumbling",
        "angular_velocity": tuple(rates),
        "inertia": tuple(map(tuple, INERTIA.tolist())),
        "gravity_gradient": True,
    }
    orbit = {"semi_major_axis": RADIUS}
    return Scenario().replace(attitude=attitude, orbit=orbit, duration=duration, control={"period": period})


def truth(rates, duration):
    """ω and the body axes (rows) in inertial space, on a circular orbit in the x-z plane of VVLH at the start."""
    n = np.sqrt(MU / RADIUS**3)

    def derivative(t, y):
        w, axes = y[:3], y[3:].reshape(3, 3)
        # VVLH at the start: x forward, z to nadir, and the frame turns about −y.
        nadir = axes @ np.array([-np.sin(n * t), 0.0, np.cos(n * t)])
        torque = 3.0 * n**2 * np.cross(nadir, INERTIA @ nadir)
        spin = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        return np.concatenate([np.linalg.solve(INERTIA, torque - np.cross(w, INERTIA @ w)), (-spin @ axes).ravel()])

    begin = np.concatenate([rates, np.eye(3).ravel()])
    times = np.arange(0.0, duration + 0.25, 0.25)
    return solve_ivp(derivative, (0.0, duration), begin, "DOP853", times, rtol=1e-12, atol=1e-14).y[:3].T


@pytest.mark.parametrize("rates", [(0.0, 0.0, 0.0), (0.002, -0.001, 0.0005), (0.01, -0.02, 0.005)])
def test_no_rate_of_a_body_that_gravity_turns_is_beyond_the_bound(rates):
    scenario = tumbling(rates)
    motion = Surroundings(scenario).motion
    omega = truth(np.array(rates), scenario.duration)
    rate, acceleration = turned_by_gravity(
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
    scenario = tumbling((0.0, 0.0, 0.0), duration=200.0, period=10.0)  # gravity alone turns it, ever faster
    motion = Surroundings(scenario).motion
    numbers = {"period": 10.0, "steps": scenario.steps, "lowest_radius": RADIUS}
    coarse, fine = (
        turned_by_gravity(dataclasses.replace(motion, substeps=substeps), **numbers) for substeps in (1, 20)
    )
    assert coarse != fine
    assert coarse == pytest.approx(fine, rel=1e-4)


def test_the_bounds_without_torque_are_those_of_energy_and_momentum():
    rates = np.array([0.01, -0.02, 0.005])
    rate, acceleration = turning_freely(rates, INERTIA)
    least = np.linalg.eigvalsh(INERTIA)[0]
    assert rate == pytest.approx(np.sqrt(rates @ INERTIA @ rates / least))
    assert acceleration == pytest.approx(np.linalg.norm(INERTIA @ rates) * rate / least)


def test_a_body_that_turns_too_fast_for_its_steps_is_refused():
    with pytest.raises(ScenarioError, match=r"attitude\.angular_velocity"):
        _ = Surroundings(tumbling((1.0, 0.5, 0.0), duration=100.0, period=10.0)).flight_bounds
