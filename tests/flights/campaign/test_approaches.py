"""A campaign of approaches in legs: each run as it flies alone, with what became of zones and holds in the table."""

import numpy as np
import pytest
import trimesh
from truths.approaches import TREE

from keepout.apps.reproduction.in_memory import run_campaign
from keepout.core.audit.tube import Contact
from keepout.core.errors import KeepoutError
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.task_entries import RequireEntry
from keepout.flights.campaign.plan import Plan
from keepout.flights.campaign.table import summary
from keepout.flights.requirements import required


# tests/core/mission/test_approach.py flies the same mission alone, and what a table counts is in test_results.py.
@pytest.mark.slow
def test_runs_of_a_campaign_hold_and_enter_nothing():
    start = {"choice": [TREE["start"]["position"], [19.0, 1.0, -1.0]]}
    dispersions = {"start.position": start, "chaser.mass": {"choice": [20.0, 20.4]}}
    flown = run_campaign(Scenario.parse(TREE | {"campaign": {"runs": 6, "dispersions": dispersions}}), series=())
    assert len(flown.flights) == 6
    assert all(audit.zones_entered is Contact.NO for audit in flown.audits)
    assert all(one.held for one in flown.flown.values())
    # What differs between masses in the guidance is its speed alone: the directions are one array for all runs.
    guidances = {id(run.mission): run.flown.setup.controller.law.velocity.guidance for run in flown.flights}
    assert len(guidances) == 2
    assert len({id(guidance.common.directions) for guidance in guidances.values()}) == 1
    table = flown.table.to_pydict()
    assert table["zones_entered"] == ["no"] * 6
    assert table["holds_kept"] == [True] * 6
    assert min(table["zone_clearance"]) > 0.2
    told = summary(flown.table, flown.scenario)
    assert (told["zones_entered"], told["zones_undecided"], told["holds_kept"]) == (0, 0, 6)
    assert told["zone_clearance_m"] == pytest.approx(min(table["zone_clearance"]))
    # Those that start where the flight alone does take as long, whatever they weigh.
    assert np.ptp(np.array(table["time_to_reach"])) < 30.0
    words = required(RequireEntry(zones="proved", holds=True))
    assert list(words) == ["zones", "holds"]


@pytest.mark.slow
@pytest.mark.long
def test_a_campaign_round_a_mesh_without_legs_is_another_once_the_mesh_has_changed(tmp_path):
    mesh, place = tmp_path / "arm.stl", {"target": {"source": "box"}, "field": {"source": "grid"}, "duration": 50.0}
    trimesh.creation.box(bounds=[[7.0, -0.5, -1.0], [9.0, 0.5, 1.0]]).export(mesh)
    ends = {"start": {"position": [8.0, 3.0, 0.0]}, "goal": {"position": [8.0, -3.0, 0.0]}}
    varied = {"runs": 2, "dispersions": {"chaser.mass": {"uniform": [18.0, 22.0]}}}
    scenario = Scenario.of({**place, **ends, "zone": [{"shape": "mesh", "file": str(mesh)}], "campaign": varied})
    plan = Plan.of(scenario)
    assert [run.refusal for run in plan.draw(0, 2)] == ["", ""]
    trimesh.creation.box(bounds=[[7.0, -0.6, -1.0], [9.0, 0.5, 1.0]]).export(mesh)
    with pytest.raises(KeepoutError, match=r"zone 0: file .*arm\.stl: not the mesh that was flown"):
        plan.draw(0, 2)
    assert Plan.of(scenario).sha256 != plan.sha256
