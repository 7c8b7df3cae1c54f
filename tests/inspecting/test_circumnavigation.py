"""Circumnavigation against Hill's ellipse, against the exact motion on an eccentric orbit, and flown with a push."""

import jax
import numpy as np
import pytest

from keepout.errors import InspectionError
from keepout.flight.loop import fly
from keepout.inspecting.circumnavigation import circumnavigations, hill_states, in_body
from keepout.inspecting.hill import coast_matrix
from keepout.inspecting.passive import drift
from keepout.mission.build import flight_setup
from keepout.mission.environment import relative_motion
from keepout.mission.scenario import Scenario

LOW = {"orbit": {"semi_major_axis": 7.0e6}, "duration": 5900.0, "inspect": {"stand_off": 3.0}}
N = np.sqrt(3.986004418e14 / 7.0e6**3)
RADIUS = 4.0


def ball(points):
    """Distance to a ball of 4 m about the origin."""
    return np.abs(np.linalg.norm(points, axis=-1) - RADIUS)


def test_states_on_an_ellipse_follow_one_another_by_hills_equations():
    phases = np.linspace(0.0, 6.0, 13)
    position, velocity = hill_states(N, 12.0, 9.0, 0.7, phases)
    states = np.concatenate([position, velocity], axis=1)
    whole = coast_matrix(N, 0.5 / N)
    assert np.allclose(states[:-1] @ whole.T, states[1:], atol=1e-9)


@pytest.mark.long
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


@pytest.mark.long
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
def test_the_exact_motion_comes_back_after_an_orbit_whatever_orbit_and_body_do(entries):
    case = Scenario.model_validate(LOW | entries)
    one = circumnavigations(case, ball)[0]
    assert ball(one.position).min() >= one.clearance - 1e-6
    assert one.clearance >= 3.5
    mass = np.asarray(case.target.centre_of_mass)
    away = np.linalg.norm(one.position - mass, axis=1)
    period = 2 * np.pi / float(relative_motion(case).orbit.mean_motion)
    after = min(round(period / case.control.period), len(away) - 1)
    assert away[after] == pytest.approx(away[0], abs=0.05)


def test_states_in_the_body_frame_drift_as_those_of_vvlh_do():
    turning = Scenario.model_validate(LOW | {"attitude": {"kind": "tumbling", "angular_velocity": [0.003, 0.0, 0.002]}})
    position, velocity = np.array([[20.0, 5.0, -9.0]]), np.array([[0.01, -0.02, 0.005]])
    fixed = Scenario.model_validate(LOW)
    paths = [
        np.linalg.norm(drift(relative_motion(case), in_body(case, 0.0, position, velocity), 2.0, 500)[0][0], axis=1)
        for case in (turning, fixed)
    ]
    assert np.allclose(*paths, atol=1e-6)


def test_the_law_coasts_and_steers_back_only_beyond_its_band():
    calm = Scenario.model_validate(LOW | {"duration": 1500.0, "disturbance": {"kind": "none"}})
    one = circumnavigations(calm, ball)[0]
    motion = relative_motion(calm)
    initial = motion.initial_state(one.position[0], one.velocity[0])
    log = fly(flight_setup(calm, one.law(calm)), initial, calm.steps, jax.random.key(0))
    assert np.array_equal(log.force, np.zeros_like(log.force))
    assert np.abs(np.asarray(log.position) - one.position).max() < 1e-6
    pushed = calm.model_copy(
        update={
            "disturbance": Scenario.model_validate(
                {"disturbance": {"kind": "constant", "force": [0, 2e-3, 0]}}
            ).disturbance
        }
    )
    log = fly(flight_setup(pushed, one.law(pushed)), initial, pushed.steps, jax.random.key(0))
    off = np.linalg.norm(np.asarray(log.position) - one.position, axis=1)
    assert 0.5 < off.max() < 0.7
    spent = np.linalg.norm(np.asarray(log.force), axis=1).sum() / 20.0
    assert spent < 1.2 * 1e-4 * 1500.0
    assert not np.any(np.asarray(log.force)[:90])


def test_a_mission_that_is_over_and_a_stand_off_that_nothing_keeps_are_refused():
    case = Scenario.model_validate(LOW)
    with pytest.raises(InspectionError, match="duration 5900 s must be longer"):
        circumnavigations(case, ball, time=5900.0)
    with pytest.raises(InspectionError, match="no ellipse"):
        circumnavigations(case, lambda points: np.zeros(len(points)))
