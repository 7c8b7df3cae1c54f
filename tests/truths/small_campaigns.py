"""Campaigns of few short flights of the bare law around a built-in target: as cheap to compile as flights are."""

from functools import cache
from typing import Any

from keepout.core.mission.scenario import Scenario
from keepout.flights.campaign.flying import ChunkResult, fly_chunk
from keepout.flights.campaign.plan import Plan

MISSION: dict[str, Any] = {
    "duration": 30.0,
    "target": {"source": "box"},
    "field": {"source": "grid"},
    "guard": {"enabled": False},
    "control": {"guidance": "straight"},
    "campaign": {
        "runs": 22,
        "dispersions": {
            "chaser.mass": {"uniform": [18.0, 22.0]},
            # 1 mN cannot hold against the disturbance: such a run is refused.
            "chaser.force_limit": {"choice": [0.1, 0.001], "weights": [4, 1]},
            "start.position": {"sphere": [1.0, 12.0]},
            "disturbance.phase": {"uniform": [0.0, 6.283]},
        },
    },
}
BATCH = 4


@cache
def small_plan() -> Plan:
    """Make a plan of 6 chunks of 4 flights, none of them refused, by the program that flies the mission."""
    every = {**MISSION["campaign"]["dispersions"], "chaser.force_limit": {"choice": [0.1]}}
    plan = Plan.of(Scenario.parse({**MISSION, "campaign": {"runs": 24, "dispersions": every}}), batch=BATCH)
    assert (plan.chunks, plan.chunk) == (6, 4)
    return plan


@cache
def flown_here(number: int) -> ChunkResult:
    """Fly a chunk of it in this process."""
    return fly_chunk(small_plan(), number)
