"""A campaign of approaches in legs: each run as it flies alone, with what became of zones and holds in the table."""

import numpy as np
import pytest
from truths.approaches import TREE

from keepout.core.audit.tube import Contact
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.task_entries import RequireEntry
from keepout.flights.campaign.campaign import run_campaign
from keepout.flights.campaign.table import summary
from keepout.flights.requirements import required

# tests/core/mission/test_approach.py flies the same mission alone, and what a table counts is in test_results.py.
pytestmark = pytest.mark.slow


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
