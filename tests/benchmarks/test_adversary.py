"""`benchmarks/adversary.py`: its truth against closed forms, and that it catches a guard that does not guard."""

from types import SimpleNamespace

import adversary
import numpy as np
import pytest
from adversary_truth import GRAVITY, SUBSTEPS, Surface, Truth
from scipy.linalg import expm

from keepout.core.mission.scenario import Scenario

PERIODS = 120
ROWS = 2 * SUBSTEPS * PERIODS
CUBE = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1).T
SIDES = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]])
SIDES = np.vstack([SIDES, [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]])


def flown(truth, place, push):
    for row in range(0, ROWS, 2):
        place = truth.flown(place, row, push)
    return place


def test_chasers_near_a_circular_orbit_follow_clohessy_and_wiltshire():
    scenario = Scenario().replace(orbit={"semi_major_axis": 6_778_000.0})
    truth, rate = Truth(scenario, PERIODS), np.sqrt(GRAVITY / 6_778_000.0**3)
    start = np.array([[1.0, -2.0, 1.5, 0.02, 0.01, -0.03], [-2.0, 1.0, 0.0, 0.0, 0.0, 0.0]])
    push = np.array([2e-4, -1e-4, 3e-4])
    # x along the velocity, y against the orbit's normal, z to the Earth; the last state is the constant 1.
    slope = np.zeros((7, 7))
    slope[:3, 3:6] = np.eye(3)
    slope[3, 5], slope[4, 1], slope[5, 3], slope[5, 2] = 2.0 * rate, -(rate**2), -2.0 * rate, 3.0 * rate**2
    slope[3:6, 6] = push
    expected = (np.hstack([start, np.ones((2, 1))]) @ expm(slope * PERIODS).T)[:, :6]
    place = flown(truth, truth.placed(start[:, :3], start[:, 3:], 0), push)
    # What the linear equations leave out is 1.5 rate² r²/a over a second: 1e-5 m here.
    assert np.hstack(truth.seen(place, ROWS)) == pytest.approx(expected, abs=2e-5)
    back = place
    for row in range(ROWS, 0, -2):
        back = truth.flown(back, row, push, back=True)
    assert np.hstack(truth.seen(back, 0)) == pytest.approx(start, abs=1e-6)


class PassesOn:
    """A guard that says that all is well and passes every command on."""

    order = SimpleNamespace(guard_status=0)

    def restart(self, estimate):
        pass

    def step(self, time, position, velocity, angular_velocity):
        return angular_velocity


class CubeCase(adversary.Case):
    """A mission around a cube, without anything compiled."""

    def __init__(self, periods):
        self.scenario, self.radius, self.period = Scenario(), 0.5, 1.0
        assumed = SimpleNamespace(mass=20.0, force_limit=0.1, disturbance_force=0.01, position_error=0.05)
        vars(assumed).update(velocity_error=0.002, mass_error=0.0, delay=1)
        braking = SimpleNamespace(position_radius=0.1, deceleration=0.004)
        self.guard = SimpleNamespace(assumptions=assumed, braking=braking, threshold=0.5)
        self.surface, self.truth = Surface(CUBE, SIDES), Truth(self.scenario, periods + adversary.LONGEST_WAIT)

    def starts(self, generator, flights):
        return np.tile([3.0, 0.0, 0.0], (flights, 1)), np.zeros((flights, 3))

    def board(self, on_gap):
        return PassesOn()

    def state(self, position, velocity, time):
        return None

    def above_threshold(self, points):
        return self.surface.nearest(points)[0] - self.guard.threshold


def test_a_guard_that_passes_everything_on_is_caught():
    flights = adversary.Flights(CubeCase(60), "lookahead", 6, 60, np.random.default_rng(0))
    flights.adversary.law[:] = 0
    row = flights.fly()
    assert row["contacts"] == row["below_threshold"] == 6
    assert row["least_clearance_m"] < 0.0
    assert row["broken"] == row["false_flags"] == 0
    assert row["promised_steps"] == row["steps"] == 360
