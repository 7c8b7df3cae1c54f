"""A campaign of few short flights of the bare law around a built-in target: as cheap to compile as flights are."""

from functools import cache

from keepout.core.mission.scenario import Scenario
from keepout.flights.campaign.flying import ChunkResult, fly_chunk
from keepout.flights.campaign.plan import Plan


@cache
def small_plan() -> Plan:
    """Make the plan: 6 chunks of 4 flights."""
    around = {"target": {"source": "box"}, "field": {"source": "grid"}, "guard": {"enabled": False}}
    bare = Scenario().replace(duration=20.0, control={"guidance": "straight"}, **around)
    plan = Plan.of(bare.replace(campaign={"runs": 24}), batch=2)
    assert (plan.chunks, plan.chunk) == (6, 4)
    return plan


@cache
def flown_here(number: int) -> ChunkResult:
    """Fly a chunk of it in this process."""
    return fly_chunk(small_plan(), number)
