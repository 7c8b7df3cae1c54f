"""An inspection by natural motion: flown, audited, and seen by the same rules as any other."""

import dataclasses

import numpy as np
import pytest

from keepout.errors import InspectionError
from keepout.geometry.target import Target
from keepout.inspecting.circling import circle
from keepout.inspecting.problem import Problem
from keepout.mission.scenario import Scenario
from keepout.seeing.seeable import Verdict

ENTRIES = {
    "target": {"source": "box"},
    "orbit": {"semi_major_axis": 7.0e6},
    "duration": 3000.0,
    "start": {"position": [0.0, -6.0, 0.0]},
    "disturbance": {"kind": "constant", "force": [1e-4, 0.0, 0.0]},
    "inspect": {"passive_safety": 300.0, "stand_off": 2.0, "patch_size": 0.5},
    "camera": {"period": 30.0},
}


@pytest.fixture(scope="module")
def problem():
    scenario = Scenario.model_validate(ENTRIES)
    return Problem.of(scenario, Target.load("box"))


@pytest.mark.long
def test_half_an_orbit_round_a_box_sees_part_of_it_without_contact(problem):
    found = circle(problem)
    told = found.summary()
    assert told["contact"] is False
    assert told["minimum_clearance_m"] > 2.0 - problem.scenario.chaser.radius - 0.2
    assert 0.2 < told["coverage"] < 1.0
    flown = float(found.flown.delta_v)
    assert flown < 2.0 * 1e-4 / problem.scenario.chaser.mass * 3000.0
    assert told["burn_mps"] > 0.005
    assert told["delta_v_mps"] == pytest.approx(flown + told["burn_mps"])
    assert 0.0 < told["transfer_s"] <= 300.0
    assert told["transfer_keeps_stand_off"] is True
    assert told["duration_s"] == 3000.0
    assert told["limits_kept"] is True
    assert told["passive_safe_share"] == 1.0
    assert "turns on an ellipse" in told["why"]
    assert len(found.frames) == 101
    assert not np.any(found.seen & (problem.seeable.verdict == Verdict.HIDDEN))


def test_hold_points_and_natural_motion_contradict_each_other(problem):
    held = problem.scenario.replace(inspect={"hold_points": [{"position": [0.0, -6.0, 0.0]}]})
    with pytest.raises(InspectionError, match="hold_points"):
        circle(dataclasses.replace(problem, scenario=held))


def test_an_ellipse_faster_than_the_chaser_may_be_is_refused(problem):
    slow = problem.scenario.replace(chaser={"speed_limit": 1e-3})
    with pytest.raises(InspectionError, match="speed_limit"):
        circle(dataclasses.replace(problem, scenario=slow))
