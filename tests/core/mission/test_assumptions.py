"""What a scenario's numbers promise: bounds that hold where they are said to, and broken assumptions by name."""

import dataclasses
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from keepout.core.audit.tube import Tube
from keepout.core.errors import ControlError, ScenarioError
from keepout.core.guard.braking import design
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings, broken_assumptions
from keepout.core.motion.disturbance import NoDisturbance

LOW = {"semi_major_axis": 6.8e6, "eccentricity": 0.01}
TUMBLING = {
    "kind": "tumbling",
    "angular_velocity": (0.004, -0.002, 0.003),
    "inertia": ((3.0, 0.0, 0.0), (0.0, 4.0, 0.0), (0.0, 0.0, 5.0)),
}


@pytest.mark.parametrize(
    ("entries", "said"),
    [
        ({"disturbance": {"bound": 0.01}}, ("disturbance: flown up to 0.0141421 N", "disturbance.bound 0.01 N")),
        ({"faults": {"delay": 2}, "guard": {"delay": 1}}, ("faults.delay 2 != guard.delay 1",)),
        ({"guard": {"delay": 1}}, ("faults.delay 0 != guard.delay 1",)),
        ({"faults": {"stuck": "+x", "stuck_force": 0.1}}, ("faults.stuck +x at 0.1 N from 0 s",)),
        ({"faults": {"gain_error": 0.05}, "guard": {"gain_error": 0.02}}, ("0.05 > guard.gain_error 0.02",)),
        (
            {"faults": {"position_bias": 0.01, "position_noise": 0.01}, "guard": {"position_error": 0.015}},
            ("faults.position_bias + faults.position_noise 0.02 m > guard.position_error 0.015 m",),
        ),
        ({"faults": {"velocity_noise": 1e-3}}, ("faults.velocity_noise 0.001 m/s > guard.velocity_error 0 m/s",)),
        ({"faults": {"dropped": 0.1, "delay": 1}}, ("faults.delay 1", "faults.dropped 0.1")),
        # What is declared breaks nothing.
        ({"faults": {"law": "into the body"}}, ()),
        ({"faults": {"delay": 3, "gain_error": 0.02}, "guard": {"delay": 3, "gain_error": 0.02}}, ()),
        ({"faults": {"position_bias": 0.01, "position_noise": 0.01}, "guard": {"position_error": 0.02}}, ()),
        ({"faults": {"stuck": "+x", "stuck_from": 1e5}}, ()),
    ],
)
def test_what_is_flown_beyond_what_is_declared_is_named(entries, said):
    broken = broken_assumptions(Scenario().replace(**entries))
    assert len(broken) == (1 if "disturbance" in entries else len(said))
    for part in said:
        assert any(part in line for line in broken)


@pytest.mark.parametrize("kind", ["paper", "bang-bang", "resonant", "random"])
def test_a_phase_moves_the_force_and_no_bound(kind, box):
    still = Scenario().replace(disturbance={"kind": kind} | ({} if kind == "paper" else {"amplitude": 0.03}))
    moved = still.replace(disturbance={"phase": 2.5})
    pushes = [Surroundings(one).disturbance for one in (moved, still)]
    force = jax.jit(jax.vmap(lambda t: jnp.stack([push.force(t) for push in pushes])))(np.linspace(0.3, 400.3, 401))
    assert np.abs(force[:, 0] - force[:, 1]).max() > 0.01
    # Equal to the last bit, for laws, guards and audits of flights that differ in the phase to be equal.
    assert Surroundings(moved).largest_disturbance == Surroundings(still).largest_disturbance
    assert Surroundings(moved).disturbance_bound == Surroundings(still).disturbance_bound
    assert Surroundings(moved).flight_bounds == Surroundings(still).flight_bounds
    assert Surroundings(moved, box).guard_assumptions == Surroundings(still, box).guard_assumptions
    assert np.linalg.norm(force[:, 0], axis=1).max() <= Surroundings(moved).largest_disturbance
    assert Surroundings(moved).disturbance.bound == pytest.approx(Surroundings(still).largest_disturbance, rel=1e-13)
    assert not broken_assumptions(moved)


def states(scenario, radius, speed, count, seed=0):
    """States at random moments, with positions and velocities of given norms."""
    motion, rng = Surroundings(scenario).motion, np.random.default_rng(seed)
    directions = rng.normal(size=(2, count, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    first = motion.initial_state(np.zeros(3), np.zeros(3))
    rows = [first]
    step = jax.jit(lambda state: motion.step(state, jnp.zeros(3), NoDisturbance(), 40.0, 20.0))
    for _ in range(30):
        rows.append(step(rows[-1]))
    moments = rng.integers(len(rows), size=count)
    at = jax.tree.map(lambda *leaves: jnp.stack(leaves)[moments], *rows)
    return motion, eqx.tree_at(lambda s: (s.position, s.velocity), at, (radius * directions[0], speed * directions[1]))


@pytest.mark.long
def test_the_guards_drift_holds_with_an_offset_and_not_without(box):
    scenario = Scenario().replace(
        orbit=LOW, attitude=TUMBLING, target={"source": "box", "centre_of_mass": (0.0, 120.0, 0.0)}
    )
    assumed = Surroundings(scenario, box).guard_assumptions
    assert assumed.origin_offset == 120.0
    motion, at = states(scenario, assumed.range_limit, assumed.speed_limit, 4000)
    drift = np.linalg.norm(np.asarray(jax.jit(jax.vmap(motion.drift_acceleration))(at)), axis=-1)
    assert drift.max() <= assumed.drift
    without = scenario.replace(target={"centre_of_mass": (0.0, 0.0, 0.0)})
    assert drift.max() > Surroundings(without, box).guard_assumptions.drift


def flown(scenario, position, velocity, forces):
    """Time, position, velocity and force at each step, (steps, ...), and the states after them."""
    motion, period = Surroundings(scenario).motion, scenario.control.period
    step = jax.jit(lambda state, force: motion.step(state, force, NoDisturbance(), period, scenario.chaser.mass))
    states = [motion.initial_state(np.asarray(position), np.asarray(velocity))]
    for force in forces:
        states.append(step(states[-1], jnp.asarray(force)))
    columns = ([getattr(state, name) for state in states] for name in ("time", "position", "velocity"))
    time, position, velocity = (np.array(column) for column in columns)
    return (time[:-1], position[:-1], velocity[:-1], np.asarray(forces)), (position[1:], velocity[1:])


def excess(rows, bounds, **changes):
    """By how much the audit finds the steps of a flight more than its bounds allow."""
    time, *columns = rows
    bounds = dataclasses.replace(bounds, **changes)
    return Tube.of(time, *(column[None] for column in columns), bounds).inconsistency().max()


@pytest.mark.long
def test_the_audit_joins_the_steps_of_a_flight_about_a_centre_of_mass_off_the_origin():
    scenario = Scenario().replace(
        orbit=LOW, attitude=TUMBLING, target={"centre_of_mass": (0.0, 20.0, 0.0)}, disturbance={"kind": "none"}
    )
    rows, _ = flown(scenario, (0.0, -3.0, 0.0), np.zeros(3), np.zeros((60, 3)))
    bounds = Surroundings(scenario.replace(disturbance={"bound": 0.01})).flight_bounds
    assert excess(rows, bounds) < 1e-9
    assert excess(rows, bounds, origin_offset=0.0) > 1e-6


def about_z(angle):
    return np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])


def test_a_force_held_in_inertial_axes_is_flown_so_and_bounded_by_guard_and_audit():
    """About a principal axis, far from the Earth: the path under each force is a parabola in inertial axes."""
    rate, T, mass = 0.02, 2.0, 20.0
    slender = ((5.0, 0.0, 0.0), (0.0, 4.0, 0.0), (0.0, 0.0, 3.0))
    scenario = Scenario().replace(
        thrusters={"held_in": "inertial"},
        attitude={"kind": "tumbling", "angular_velocity": (0.0, 0.0, rate), "inertia": slender},
        orbit={"semi_major_axis": 9e8},
        disturbance={"kind": "none", "bound": 1e-9},
        control={"period": T},
    )
    omega, forces = np.array([0.0, 0.0, rate]), np.random.default_rng(0).uniform(-0.1, 0.1, (20, 3))
    rows, (after, faster) = flown(scenario, (3.0, -4.0, 2.0), (0.02, 0.01, -0.03), forces)
    _, place, speed, force = rows
    drifting, turned = speed + np.cross(omega, place), about_z(-rate * T).T
    ahead = (place + drifting * T + 0.5 * force / mass * T**2) @ turned
    np.testing.assert_allclose(after, ahead, atol=1e-8)  # one Runge-Kutta step
    np.testing.assert_allclose(faster, (drifting + force / mass * T) @ turned - np.cross(omega, ahead), atol=1e-8)

    assumed = Surroundings(scenario, extent=5.0).guard_assumptions
    corner = np.array([0.1, 0.1, 0.0]) / mass
    most = max(np.linalg.norm(about_z(-rate * t) @ corner - corner) for t in np.linspace(0.0, T, 11))
    share = assumed.turning_error * np.linalg.norm(corner)
    assert 0.999 * share < most <= share * (1.0 + 1e-9)
    held = Surroundings(scenario.replace(thrusters={"held_in": "target"}), extent=5.0).guard_assumptions
    assert held.turning_error == 0.0
    assert assumed.disturbance - held.disturbance == pytest.approx(assumed.turning_error * np.sqrt(3.0) * 0.1 / mass)

    bounds = Surroundings(scenario).flight_bounds
    assert excess(rows, bounds) < 1e-8
    # With the target's own part of the bounds small: what is left is the force's.
    near = {"angular_rate": 0.0, "angular_acceleration": 0.0, "gravity_gradient": 0.0}
    assert excess(rows, bounds, **near, force_turning=0.0) > excess(rows, bounds, **near) + 1e-5


@pytest.mark.long
def test_gravity_is_bounded_over_the_whole_region(box):
    near = Scenario().replace(orbit=LOW, attitude={"kind": "inertial"}, target={"source": "box"})
    far = near.replace(start={"position": (0.0, 0.0, 20_000.0)})
    assumed = Surroundings(far, box).guard_assumptions
    assert assumed.range_limit == 40_020.0
    motion, at = states(far, assumed.range_limit, 0.0, 4000)
    pull = np.linalg.norm(np.asarray(jax.jit(jax.vmap(motion.drift_acceleration))(at)), axis=-1)
    assert pull.max() <= assumed.gravity_gradient * assumed.range_limit
    # A bound made for 1000 m does not hold there.
    assert pull.max() > Surroundings(near, box).guard_assumptions.gravity_gradient * assumed.range_limit
    bounds = Surroundings(far).flight_bounds
    assert (bounds.range_limit, bounds.gravity_gradient) == (assumed.range_limit, assumed.gravity_gradient)
    assert Surroundings(near).flight_bounds.range_limit == 1000.0


@pytest.mark.parametrize("said", ["start.position: 200000 m", "target.centre_of_mass: 200000 m"])
def test_what_lies_where_gravity_is_not_bounded_is_refused(box, said):
    table, entry = said.split(":")[0].split(".")
    far = Scenario().replace(**{table: {entry: (0.0, 2e5, 0.0)}})
    for refused in (lambda s: Surroundings(s).flight_bounds, lambda s: Surroundings(s, box).guard_assumptions):
        with pytest.raises(ScenarioError, match=re.escape(said)):
            refused(far)


@pytest.mark.long
def test_a_delay_that_the_thrusters_cannot_hold_is_refused_by_its_number(box):
    weak = Scenario().replace(chaser={"force_limit": 0.02})
    assert design(Surroundings(weak, box).guard_assumptions).deceleration > 0.0
    with pytest.raises(ControlError, match=r"force_limit is 0\.02 N; .* the delay \(8 steps\)"):
        design(Surroundings(weak.replace(guard={"delay": 8}), box).guard_assumptions)
