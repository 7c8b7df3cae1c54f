"""Case 2: its scenarios, and its figures of a flight known in closed form."""

import numpy as np
import pytest
from truths.invented_flight import Invented

from keepout.apps.reproduction import case2


def flight(scenario, error):
    """At rest `error` m from the goal for the last fifth of the flight, far from it before, pushed by 3 and 4 N."""
    time = np.arange(101.0)
    away = np.where(time < 80.0, 5.0, error)
    position = np.asarray(scenario.goal.position) + away[:, None] * [0.0, 1.0, 0.0]
    summary = {"reached": True, "minimum_clearance_m": 1.0, "contact_verdict": "no", "saturated_fraction": 0.5}
    force = np.tile([3.0, 0.0, 4.0], (101, 1))
    force[-1] = 1e3  # was not flown
    return Invented(scenario, summary, time=time, position=position, force=force, barrier=away - 2.0, lyapunov=away**2)


def test_the_figures_are_those_of_the_settled_flight():
    scenarios = case2.case2_scenarios(0, quick=False)
    key = (case2.SLOW, case2.PRINTED)
    row = case2.row(*key, flight(scenarios[key], 0.003))
    assert row["settled_error_rms_mm"] == pytest.approx(3.0)
    assert row["settled_error_largest_mm"] == pytest.approx(3.0)
    assert row["minimum_h_m"] == pytest.approx(0.003 - 2.0)
    assert row["settled_v1_median_m2"] == pytest.approx(9e-6)
    assert row["largest_force_n"] == row["settled_force_rms_n"] == pytest.approx(5.0)


def test_a_comparison_differs_by_its_observer_only():
    for quick in (True, False):
        scenarios = case2.case2_scenarios(0, quick=quick)
        assert len({scenario.name for scenario in scenarios.values()}) == len(scenarios)
        for comparison in (case2.FAST, *(() if quick else (case2.SLOW,)), case2.PUSH, case2.DEFAULT):
            same = [
                scenario.replace(name="same", control={"observer": None}).model_dump()
                for key, scenario in scenarios.items()
                if key[0] == comparison
            ]
            assert len(same) >= 2
            assert all(other == same[0] for other in same)
    fast = scenarios[case2.FAST, case2.PRINTED]
    assert (fast.control.period, fast.chaser.force_limit, fast.guard.enabled) == (0.05, 10.0, False)
