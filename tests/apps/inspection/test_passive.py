"""Passive safety against Hill's orbits that surely hit or miss a ball, and against flights with a push at its bound."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from truths.invented_flight import Invented

from keepout.apps.inspection.passive import (
    Spread,
    coast_matrix,
    drift,
    passive_safety,
    states_at_times,
    states_of_record,
)
from keepout.core.errors import InspectionError
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.core.mission.zones import zones_judged
from keepout.core.motion.disturbance import NoDisturbance

LOW = {"orbit": {"semi_major_axis": 7.0e6}, "attitude": {"kind": "vvlh"}}
CALM = LOW | {"disturbance": {"kind": "none"}}
N = np.sqrt(3.986004418e14 / 7.0e6**3)
RADIUS = 5.0


def scenario(**entries):
    return Scenario.model_validate(entries)


def ball(points):
    """Distance to a ball of 5 m about the origin."""
    return np.abs(np.linalg.norm(points, axis=-1) - RADIUS)


def states(entries, position, velocity):
    return states_at_times(scenario(**entries), np.zeros(len(position)), np.asarray(position), np.asarray(velocity))


def test_a_drift_aimed_at_the_ball_touches_it():
    """The velocity that Hill's equations give for being at the origin 600 s from now."""
    place = np.array([20.0, 5.0, -8.0])
    whole = coast_matrix(N, 600.0)
    velocity = -np.linalg.solve(whole[:3, 3:], whole[:3, :3] @ place)
    found = passive_safety(scenario(**CALM), ball, states(CALM, place[None], velocity[None]), 700.0)
    assert not found.safe[0]
    assert found.found[0] < 0.0
    short = passive_safety(scenario(**CALM), ball, states(CALM, place[None], velocity[None]), 100.0)
    assert short.safe[0]


@pytest.mark.slow
def test_the_bound_lies_below_what_a_fine_drift_finds_and_not_far():
    generator = np.random.default_rng(4)
    place = generator.normal(size=(60, 3))
    place *= generator.uniform(7.0, 40.0, (60, 1)) / np.linalg.norm(place, axis=1, keepdims=True)
    velocity = 0.05 * generator.normal(size=(60, 3))
    case = scenario(**CALM)
    begun = states(CALM, place, velocity)
    found = passive_safety(case, ball, begun, 1500.0)
    path, _ = drift(Surroundings(case).motion, begun, 0.5, 3000)
    truth = ball(path).min(axis=1) - case.chaser.radius
    assert np.all(found.clearance <= truth + 1e-9)
    assert np.all((truth - found.clearance)[truth > 0.0] < 0.08)
    assert np.all(found.found[truth < -0.05] < 0.0)
    cheap = passive_safety(case, ball, begun, 1500.0, enough=0.0)
    assert np.array_equal(cheap.safe, found.safe)


def test_zones_count_as_the_mesh_does_until_the_drift_is_over():
    """Against a fine drift: one that turns, one that stands later, one that ends meanwhile, and one that has ended."""
    cone = {"shape": "cone", "axes": "inertial", "centre": [0.0, 0.0, 0.0], "axis": [0.2, -0.3, 0.9]}
    cone |= {"half_angle": 0.3, "length": 45.0}
    late = {"shape": "sphere", "centre": [0.0, 15.0, 0.0], "radius": 4.0, "start": 400.0}
    ends = {"shape": "box", "lower": [-30.0, -5.0, -5.0], "upper": [-20.0, 5.0, 5.0], "until": 200.0}
    past = {"shape": "sphere", "centre": [0.0, 0.0, 0.0], "radius": 100.0, "until": 100.0}
    generator = np.random.default_rng(5)
    place, begun = 14.0 * generator.normal(size=(200, 3)), np.repeat([100.0, 250.0], 100)
    case = scenario(**CALM, duration=300.0, zone=[cone, late, ends, past], start={"position": [200.0, 0.0, 0.0]})
    at = states_at_times(case, begun, place, 0.02 * generator.normal(size=(200, 3)))
    path, _ = drift(Surroundings(case).motion, at, 1.0, 900)
    truth, time = ball(path), begun[:, None] + np.arange(901)
    regions = zones_judged(Surroundings(case.replace(duration=1200.0)))
    for region in regions:
        turn = region.rotations[np.minimum(time.astype(int), len(region.rotations) - 1)]
        away = region.distance(np.einsum("nkij,nkj->nki", turn, path).reshape(-1, 3)).reshape(truth.shape)
        stands = (begun[:, None] < region.until) & (time >= region.start)
        truth = np.where(stands, np.minimum(truth, away), truth)
    truth = truth.min(axis=1) - case.chaser.radius
    found = passive_safety(case, ball, at, 900.0)
    assert np.all(found.clearance <= truth + 1e-3)
    assert np.all((truth - found.clearance)[truth > 0.0] < 0.1)
    assert 0 < found.safe[:100].sum() < found.safe[100:].sum() < 100
    assert np.array_equal(passive_safety(case, ball, at, 900.0, enough=0.0).safe, found.safe)


@pytest.mark.long
@pytest.mark.parametrize(
    "entries",
    [LOW, LOW | {"attitude": {"kind": "inertial"}}, LOW | {"orbit": {"semi_major_axis": 7.5e6, "eccentricity": 0.1}}],
)
def test_a_push_at_its_bound_stays_within_the_tube(entries):
    case = scenario(**entries)
    spread, motion = Spread.of(case), Surroundings(case).motion
    bounds = Surroundings(case).flight_bounds
    place, velocity = np.array([[25.0, 3.0, -10.0]]), np.array([[0.0, 0.01, 0.02]])
    begun = states_at_times(case, np.zeros(1), place, velocity)
    count = 1160
    nominal, _ = drift(motion, begun, 5.0, count)
    radius = spread.radius(5.0 * np.arange(count + 1.0), position_error=0.05, velocity_error=0.002)
    directions = np.vstack([np.eye(3), -np.eye(3)[:1], [[0.6, 0.0, 0.8]]])
    wrong = states_at_times(case, np.zeros(5), place + 0.05 * directions, velocity + 0.002 * directions)
    path = np.asarray(pushed(motion, wrong, jnp.asarray(bounds.disturbance_force * directions), bounds.mass, count))
    off = np.linalg.norm(path - nominal[:, 1:], axis=-1)
    assert np.all(off <= radius[1:])
    assert np.max(off / radius[1:]) > 0.9
    assert np.max(off[:, 60] / radius[61]) > 0.9
    assert np.max(off[:, 300] / radius[301]) > 0.5


@eqx.filter_jit
def pushed(motion, states, forces, mass, count):
    """Positions under a held force, every 5 s."""

    def one(state, force):
        def advance(at, _):
            after = motion.step(at, force, NoDisturbance(), 5.0, mass)
            return after, after.position

        return jax.lax.scan(advance, state, length=count)[1]

    return eqx.filter_vmap(one)(states, forces)


def test_a_drift_out_of_the_range_of_the_bounds_is_not_called_safe():
    far = np.array([[100.0, 0.0, 0.0]])
    found = passive_safety(scenario(**CALM), ball, states(CALM, far, [[0.0, 0.0, 3.0]]), 5000.0)
    assert found.clearance[0] == -np.inf
    assert not found.safe[0]


def test_states_of_a_record_are_those_flown_and_those_of_a_plan_have_the_target_as_it_turns():
    """A record as the flight loop makes it: one whole state after the other, a second apart."""
    tumbling = CALM | {"attitude": {"kind": "tumbling", "angular_velocity": [0.002, 0.003, -0.001]}}
    motion = Surroundings(scenario(**tumbling)).motion
    at, rows = motion.initial_state(np.array([9.0, 0.0, 1.0]), np.array([0.0, 0.02, 0.0])), []
    for _ in range(41):
        rows.append(at)
        at = STEP(motion, at)
    flown = {name: np.array([getattr(row, name) for row in rows]) for name in MOVED}
    record = Invented(scenario(**tumbling), {}, **flown).record
    recorded = states_of_record(record, every=10)
    planned = states_at_times(scenario(**tumbling), record.time[::10], record.position[::10], record.velocity[::10])
    assert np.array_equal(recorded.position, record.position[::10])
    assert np.allclose(recorded.attitude, planned.attitude, atol=1e-12)
    assert np.allclose(recorded.angular_velocity, planned.angular_velocity, atol=1e-12)
    path, _ = drift(motion, recorded, 1.0, 10)
    assert np.allclose(path[:-1, -1], record.position[10::10], atol=1e-9)


MOVED = ("time", "position", "velocity", "attitude", "angular_velocity")
STEP = eqx.filter_jit(lambda motion, at: motion.step(at, jnp.zeros(3), NoDisturbance(), 1.0, 1.0))


def test_times_and_errors_that_bound_nothing_are_refused():
    begun = states(CALM, [[9.0, 0, 0]], [[0.0, 0, 0]])
    for seconds in (0.0, np.nan, np.inf, 1e8):
        with pytest.raises(InspectionError, match="passive safety"):
            passive_safety(scenario(**CALM), ball, begun, seconds)
    with pytest.raises(InspectionError, match="position_error"):
        Spread.of(scenario(**CALM)).radius(np.zeros(1), position_error=-1.0)
