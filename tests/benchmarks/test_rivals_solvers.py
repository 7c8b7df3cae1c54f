"""Rivals that call a solver: plans are what they claim by another integrator, and the laws reach a goal."""

import dataclasses
import itertools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.interpolate
from rivals_laws.checked_planning import Planning, shifted
from rivals_laws.convexified import PlannedOnce, Replanned
from rivals_laws.convexified_plan import Plan, guess_along, integrated
from rivals_laws.field_spline import FieldSpline
from rivals_laws.nonlinear_mpc import NonlinearMPC

from keepout.control import profiles
from keepout.control.guidance.plan import Straight
from keepout.control.operation import Operation
from keepout.errors import ControlError, KeepOutZoneError
from keepout.fields.analytic import SphereField
from keepout.flight.loop import fly
from keepout.flight.setup import FlightSetup
from keepout.motion import Chaser, paper_disturbance
from keepout.motion.orbit import Orbit
from keepout.motion.relative import RelativeMotion

CHASER = Chaser(mass=20.0, radius=0.5, force_limit=0.1, speed_limit=0.1)
MOTION = RelativeMotion(Orbit(6_778_137.0))  # low, so that the linearised drift is seen
START, GOAL = np.array([-4.0, 0.3, 0.2]), np.array([4.0, 0.0, 0.0])
NEAR = np.array([4.5, 2.0, -1.0])
"""A start from which nothing lies between."""
NO_OPENSCVX = "openscvx is not installed (pip install 'keepout[rivals]')"
NO_CASADI = "casadi is not installed (pip install 'keepout[rivals]')"


class Round:
    """Just enough of a case: a ball of 1 m."""

    def __init__(self):
        self.model = SimpleNamespace(field=SphereField(jnp.zeros(3), jnp.asarray(1.0)))
        self.operation = Operation(CHASER, MOTION, error_bound=0.05, disturbance_bound=paper_disturbance().bound)
        self.lower, self.upper, self.seconds, self.seconds_spared = np.full(3, -6.0), np.full(3, 6.0), 600.0, 0.0
        far = [0.0, 0.0, 20.0]
        self.default_law = profiles.default(self.model.field, self.operation, far, guidance=Straight())
        self._made = {}

    def once(self, name, make):
        key = str(name)
        if key not in self._made:
            self._made[key] = make()
        return self._made[key]


@pytest.fixture(scope="module")
def case():
    return Round()


def flown(law, goal, start, steps):
    setup = FlightSetup(MOTION, paper_disturbance(), CHASER.thrusters, law, goal, CHASER.mass)
    return fly(setup, MOTION.initial_state(start, np.zeros(3)), steps, jax.random.key(0))


def test_the_spline_is_the_cubic_that_it_interpolates_on_axes_of_unlike_lengths():
    def cubic(p):
        return 0.1 * p[:, 0] ** 3 - p[:, 1] * p[:, 2] ** 2 + p[:, 0] * p[:, 1] - 2.0

    lower, upper = np.array([-1.0, -2.0, -3.0]), np.array([4.0, 2.5, 3.0])
    spline = FieldSpline.interpolating(cubic, lower, upper, 0.7)
    assert len(set(spline.coefficients.shape)) == 3
    points = np.random.default_rng(0).uniform(lower, upper, (200, 3))
    found = scipy.interpolate.NdBSpline(spline.knots, spline.coefficients, 3)(points)
    np.testing.assert_allclose(found, cubic(points), atol=1e-10)


def task_of(nodes):
    drift = (
        np.array([[0.0, 0.0, 0.0], [0.0, -1e-4, 0.0], [0.0, 0.0, 3e-4]]),
        1e-2 * np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]),
    )
    return SimpleNamespace(by_position=drift[0], by_velocity=drift[1], nodes=nodes, speed=0.1)


def by_another_integrator(task, nodes):
    """Positions and velocities at the nodes, from the first one on, by SciPy."""
    state, states = nodes[0, 1:7], [nodes[0, 1:7]]
    for before, after in itertools.pairwise(nodes):

        def slope(_, x, held=before[7:]):
            return np.concatenate([x[3:], task.by_position @ x[:3] + task.by_velocity @ x[3:] + held])

        span = (before[0], after[0])
        state = scipy.integrate.solve_ivp(slope, span, state, rtol=1e-10, atol=1e-12).y[:, -1]
        states.append(state)
    return np.array(states)


def test_a_plan_is_integrated_as_another_integrator_does():
    task, rng = task_of(6), np.random.default_rng(1)
    nodes = guess_along(task, np.stack([START, GOAL]), np.array([0.01, 0.0, -0.02]))
    nodes[:, 7:] = rng.normal(size=(6, 3)) * 4e-3
    _, position, velocity = integrated(task, nodes)
    truth = by_another_integrator(task, nodes)
    np.testing.assert_allclose(position[[0, -1]], truth[[0, -1], :3], atol=1e-7)
    np.testing.assert_allclose(velocity[[0, -1]], truth[[0, -1], 3:], atol=1e-9)


def test_the_rest_of_a_plan_begins_where_the_plan_is():
    task = task_of(6)
    nodes = guess_along(task, np.stack([START, GOAL]), np.zeros(3))
    nodes[:, 7:] = 1e-4
    rest = shifted(task, nodes, 0.5 * nodes[-1, 0])
    assert rest.shape == nodes.shape
    assert rest[0, 0] == 0.0
    assert rest[-1, 0] == pytest.approx(0.5 * nodes[-1, 0])
    times, position, _ = integrated(task, nodes)
    middle = [np.interp(0.5 * nodes[-1, 0], times, column) for column in position.T]
    np.testing.assert_allclose(rest[0, 1:4], middle, atol=1e-9)


@pytest.mark.long
def test_a_convexified_plan_meets_dynamics_and_bounds_and_is_flown(case):
    pytest.importorskip("openscvx", reason=NO_OPENSCVX)
    rival = PlannedOnce()
    task = rival.planning(case).task
    nodes = rival.nodes(case, START, GOAL)
    np.testing.assert_allclose(by_another_integrator(task, nodes), nodes[:, 1:7], atol=5e-3)
    np.testing.assert_allclose(nodes[0, 1:7], [*START, 0.0, 0.0, 0.0], atol=1e-5)
    np.testing.assert_allclose(nodes[-1, 1:7], [*GOAL, 0.0, 0.0, 0.0], atol=1e-4)
    assert np.abs(nodes[:, 7:]).max() <= task.acceleration * (1 + 1e-4)
    _, position, velocity = integrated(task, nodes)
    assert np.linalg.norm(velocity, axis=1).max() < 0.1 * 1.02
    # The straight way leads through the ball; the plan keeps out between its nodes too.
    assert np.linalg.norm(position, axis=1).min() - 1.0 > case.operation.keep_out - 0.05
    log = flown(rival.law(case, START, GOAL), GOAL, START, 250)
    assert np.linalg.norm(log.position[-1] - GOAL) < 0.02
    assert np.linalg.norm(log.position, axis=1).min() - 1.0 > case.operation.keep_out - 0.07


@pytest.mark.long
def test_a_replanned_flight_reaches_its_goal_and_says_how_often_it_planned(case):
    pytest.importorskip("openscvx", reason=NO_OPENSCVX)
    rival = Replanned()
    log = flown(rival.law(case, START, GOAL), GOAL, START, 250)
    assert np.linalg.norm(log.position[-1] - GOAL) < 0.02
    assert " replans: " in rival.note(case)
    assert " replans: " not in rival.note(case)


def test_a_plan_that_enters_the_zone_or_misses_is_refused_and_counted():
    planning = object.__new__(Planning)
    planning.task = SimpleNamespace(**vars(task_of(6)), keep_out=0.6)
    planning.miss, planning.dip = 0.05, 0.05
    still = np.hstack([1e-6 * np.arange(6.0)[:, None], np.tile(NEAR, (6, 1)), np.zeros((6, 6))])
    book = PlannedOnce().book(Round())
    for goal, lowest, reason in ((GOAL, 2.0, "misses the goal"), (NEAR, 0.5, "enters"), (NEAR, np.nan, "enters")):
        planning.planner = SimpleNamespace(plan=lambda *_, lowest=lowest: Plan(still, True, lowest))
        with pytest.raises(ControlError, match=reason):
            planning.plan(book, NEAR, np.zeros(3), goal, still)
    planning.planner = SimpleNamespace(plan=lambda *_: Plan(still, False, 0.56))
    assert planning.plan(book, NEAR, np.zeros(3), NEAR, still) is still
    said = "4 plans: 3 converged, 3 not flown (2 plan enters the zone) (1 plan misses the goal)"
    assert said in book.tell("plans")


@pytest.mark.long
def test_nonlinear_mpc_reaches_a_goal_in_free_space(case):
    pytest.importorskip("casadi", reason=NO_CASADI)
    rival = NonlinearMPC()
    log = flown(rival.law(case, NEAR, GOAL), GOAL, NEAR, 150)
    assert np.linalg.norm(log.position[-1] - GOAL) < 0.1
    assert np.linalg.norm(log.velocity, axis=1).max() < 0.105
    solver = rival.solver(case)
    assert "151 solves (151 Solve_Succeeded)" in solver.tell()
    assert solver.tell() == ""


@pytest.mark.long
def test_a_solve_that_fails_is_counted_and_the_last_plan_is_flown_to_rest(case):
    pytest.importorskip("casadi", reason=NO_CASADI)
    rival = NonlinearMPC(iterations=0)
    log = flown(rival.law(case, NEAR, GOAL), GOAL, NEAR, 20)
    assert "21 Maximum_Iterations_Exceeded: last plan flown on" in rival.solver(case).tell()
    # There was no plan yet, so nothing is asked for but what drift and disturbance take.
    assert np.linalg.norm(log.velocity, axis=1).max() < 2e-3


@pytest.mark.long
def test_a_start_in_the_zone_is_refused(case):
    pytest.importorskip("casadi", reason=NO_CASADI)
    with pytest.raises(KeepOutZoneError, match="start"):
        NonlinearMPC().law(case, np.array([1.2, 0.0, 0.0]), GOAL)


def test_settings_tell_variants_apart():
    assert PlannedOnce().settings != dataclasses.replace(PlannedOnce(), guess="geodesic").settings
