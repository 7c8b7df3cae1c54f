"""What the guard's design comes to for the default scenario: a change of it, meant or not, shows here."""

import pytest

from keepout.core.geometry.target import Target
from keepout.core.guard.braking import design
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings

ROWS = [  # ε_r (m), ε_v (m/s), delay; ρ (m), σ (m/s), a_b and U (m/s²)
    (0.0, 0.0, 0, 8.52e-3, 1.82e-3, 4.15e-3, 0.851e-3),
    (0.05, 2e-3, 0, 0.131, 12.2e-3, 2.35e-3, 2.65e-3),
    (0.05, 2e-3, 2, 0.160, 14.8e-3, 2.15e-3, 2.85e-3),
    (0.2, 10e-3, 0, 0.784, 39.9e-3, 1.13e-3, 3.87e-3),
    (0.2, 10e-3, 2, 0.882, 43.2e-3, 1.09e-3, 3.91e-3),
]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row[0]} m, {row[1]} m/s, delay {row[2]}")
def test_the_design_has_these_numbers(row):
    position_error, velocity_error, delay, *expected = row
    errors = {"position_error": position_error, "velocity_error": velocity_error, "delay": delay}
    scenario = Scenario().replace(guard=errors)
    assumed = Surroundings(scenario, Target.load(scenario.target.source)).guard_assumptions
    made = design(assumed)
    assert f"{assumed.disturbance:.5f}" == "0.00073"
    assert assumed.force_limit == 0.1
    found = made.position_radius, made.velocity_radius, made.deceleration, made.reserve
    assert [f"{number:.2e}" for number in found] == [f"{number:.2e}" for number in expected]
