"""`benchmarks/adversary.py`: it catches a guard that does not guard."""

from types import SimpleNamespace

import adversary
import numpy as np
from adversary_truth import Surface, Truth

from keepout.core.mission.scenario import Scenario

CUBE = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1).T
SIDES = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]])
SIDES = np.vstack([SIDES, [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]])


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
