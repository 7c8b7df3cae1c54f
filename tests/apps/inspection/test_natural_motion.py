"""Natural motion: Hill's equations, ellipses, transfers and a flight, against closed forms and the exact motion."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from act3_task import push_matrix
from scipy.linalg import expm
from truths.box_problems import problem_of

from keepout.apps.inspection import circumnavigation
from keepout.apps.inspection.circumnavigation import circumnavigations, hill_states, transfer
from keepout.apps.inspection.inspect import circle
from keepout.apps.inspection.passive import coast_matrix
from keepout.apps.inspection.seeing.seeable import Verdict
from keepout.core.errors import InspectionError
from keepout.core.flight.loop import fly
from keepout.core.geometry.target import Target
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings

pytestmark = pytest.mark.as_used

LOW = {"orbit": {"semi_major_axis": 7.0e6}, "duration": 5900.0, "inspect": {"stand_off": 3.0}}
N = np.sqrt(3.986004418e14 / 7.0e6**3)
RADIUS = 4.0


def ball(points):
    """Distance to a ball of 4 m about the origin."""
    return np.abs(np.linalg.norm(points, axis=-1) - RADIUS)


@pytest.fixture
def few(monkeypatch):
    """Try two tilts in four heights instead of nine in sixteen."""
    monkeypatch.setattr(circumnavigation, "TILTS", circumnavigation.TILTS[:6:5])
    monkeypatch.setattr(circumnavigation, "_SIZES", 4)


def test_states_on_an_ellipse_follow_one_another_by_hills_equations():
    phases = np.linspace(0.0, 6.0, 13)
    position, velocity = hill_states(N, 12.0, 9.0, 0.7, phases)
    states = np.concatenate([position, velocity], axis=1)
    whole = coast_matrix(N, 0.5 / N)
    assert np.allclose(states[:-1] @ whole.T, states[1:], atol=1e-9)


@pytest.mark.slow
def test_round_a_ball_the_smallest_ellipse_is_as_high_as_ball_and_stand_off():
    found = circumnavigations(Scenario.model_validate(LOW), ball)
    assert len(found) == 9
    for one in found:
        assert 3.5 <= one.clearance <= ball(one.position).min() + 1e-6
    flat = next(one for one in found if one.across == 0.0)
    assert 7.5 <= flat.height < 7.6
    assert np.ptp(flat.position[:, 0]) == pytest.approx(4.0 * flat.height, rel=0.01)
    circle = [one for one in found if one.across > 1.7 * one.height and one.tilt in (0.0, np.pi)]
    assert len(circle) == 2
    assert all(np.ptp(np.linalg.norm(one.position, axis=1)) < 0.02 for one in circle)
    assert 7.5 <= 2.0 * circle[0].height < 7.6
    means = [ball(one.position).mean() for one in found]
    assert means == pytest.approx(sorted(means), abs=0.1)


@pytest.mark.slow  # what one period of coasting changes is held by the exponential below
@pytest.mark.parametrize(
    "entries",
    [
        {"orbit": {"semi_major_axis": 8.0e6, "eccentricity": 0.12, "true_anomaly": 1.0}, "duration": 7122.0},
        {
            "attitude": {"kind": "tumbling", "angular_velocity": [0.001, 0.002, 0.0015]},
            "target": {"centre_of_mass": [0.5, -0.3, 0.2]},
        },
    ],
)
@pytest.mark.usefixtures("few")
def test_the_exact_motion_comes_back_after_an_orbit_whatever_orbit_and_body_do(entries):
    case = Scenario.model_validate(LOW | entries)
    one = circumnavigations(case, ball)[0]
    assert ball(one.position).min() >= one.clearance - 1e-6
    assert one.clearance >= 3.5
    mass = np.asarray(case.target.centre_of_mass)
    away = np.linalg.norm(one.position - mass, axis=1)
    period = 2 * np.pi / float(Surroundings(case).motion.orbit.mean_motion)
    after = min(round(period / case.control.period), len(away) - 1)
    assert away[after] == pytest.approx(away[0], abs=0.05)


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.usefixtures("few")
def test_the_law_coasts_and_steers_back_only_beyond_its_band():
    calm = Scenario.model_validate(LOW | {"duration": 3000.0, "disturbance": {"kind": "constant", "force": [0, 0, 0]}})
    one = circumnavigations(calm, ball)[0]
    initial = Surroundings(calm).motion.initial_state(one.position[0], one.velocity[0])

    def flown(case):
        return fly(Surroundings(case).setup(one.law(case)), initial, case.steps, jax.random.key(0))

    log = flown(calm)
    assert np.array_equal(log.force, np.zeros_like(log.force))
    assert np.abs(np.asarray(log.position) - one.position).max() < 1e-6
    log = flown(calm.replace(disturbance={"force": (0.0, 2e-3, 0.0)}))
    off = np.linalg.norm(np.asarray(log.position) - one.position, axis=1)
    assert 0.5 < off.max() < 0.7
    spent = np.linalg.norm(np.asarray(log.force), axis=1).sum() / 20.0
    assert spent < 1.2 * 1e-4 * 3000.0
    assert not np.any(np.asarray(log.force)[:90])


# ---- Hill's equations, the transfer onto an ellipse, and an inspection by it

BOX = {
    "target": {"source": "box"},
    "orbit": {"semi_major_axis": 7.0e6},
    "duration": 3000.0,
    "disturbance": {"kind": "none"},
    "inspect": {"stand_off": 2.0},
}
CIRCLED = BOX | {
    "start": {"position": [0.0, -6.0, 0.0]},
    "disturbance": {"kind": "constant", "force": [1e-4, 0.0, 0.0]},
    "inspect": {"passive_safety": 300.0, "stand_off": 2.0, "patch_size": 0.5},
    "camera": {"period": 30.0},
}


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


@pytest.fixture(scope="module")
def box():
    return Target.load("box").distance.distance


def onto(box, position, velocity=(0.0, 0.0, 0.0), **changes):
    """Give the transfer from a start onto the nearest ellipse, and that ellipse."""
    case = Scenario.parse({**BOX, **changes, "start": {"position": list(position), "velocity": list(velocity)}})
    ellipse = circumnavigations(case, box)[0]
    return transfer(case, box, ellipse), ellipse


@pytest.mark.slow
@pytest.mark.usefixtures("few")
def test_half_an_orbit_round_a_box_sees_part_of_it_without_contact():
    problem = problem_of(Scenario.model_validate(CIRCLED))
    found = circle(problem)
    told = found.summary()
    assert (told["contact"], told["transfer_keeps_stand_off"], told["limits_kept"]) == (False, True, True)
    assert told["passive_safe_share"] == 1.0
    assert told["minimum_clearance_m"] > 2.0 - problem.scenario.chaser.radius - 0.2
    assert 0.2 < told["coverage"] < 1.0
    flown = float(found.flown.delta_v)
    assert flown < 2.0 * 1e-4 / problem.scenario.chaser.mass * 3000.0
    assert told["burn_mps"] > 0.005
    assert told["delta_v_mps"] == pytest.approx(flown + told["burn_mps"])
    assert 0.0 < told["transfer_s"] <= 300.0
    assert not np.any(found.seen & (problem.seeable.verdict == Verdict.HIDDEN))


@pytest.mark.slow
@pytest.mark.long
def test_hold_points_fast_ellipses_and_stand_offs_that_nothing_keeps_are_refused(monkeypatch):
    monkeypatch.setattr(circumnavigation, "TILTS", circumnavigation.TILTS[:1])
    monkeypatch.setattr(circumnavigation, "_SIZES", 2)
    case, problem = Scenario.model_validate(LOW), problem_of(Scenario.model_validate(CIRCLED))
    held = case.replace(inspect={"hold_points": [{"position": [0.0, -6.0, 0.0]}]})
    slow = problem.scenario.replace(chaser={"speed_limit": 1e-3})
    for refused, said in (
        (lambda: circle(replace(problem, scenario=held)), "hold_points"),
        (lambda: circle(replace(problem, scenario=slow)), "speed_limit"),
        (lambda: circumnavigations(case, lambda points: np.zeros(len(points))), "no ellipse"),
    ):
        with pytest.raises(InspectionError, match=said):
            refused()
