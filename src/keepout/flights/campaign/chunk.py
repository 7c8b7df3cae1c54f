"""One chunk of a campaign: drawn, flown, audited and counted. A function of the plan and the chunk's number alone.

A process, a thread or a worker on another machine may fly it, in any order and any number of times: on machines of one
kind the answer is the same to the bit. Nothing here touches a file.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from keepout.core.audit.audit import Audit, Contact
from keepout.core.audit.tube import FlightBounds
from keepout.core.compiled.kept_programs import processor
from keepout.core.digest import digest
from keepout.core.guard.guard import Guard
from keepout.core.guard.start import starts_certified
from keepout.core.mission.audited import AUDITED, judge
from keepout.core.mission.entries import ChaserEntry
from keepout.flights.campaign import bands, table
from keepout.flights.campaign.drawing import Run
from keepout.flights.campaign.flying import Landed, bounds_of, by_mission, fly_runs, initial_states
from keepout.flights.campaign.plan import Plan

COLUMNS = tuple(dict.fromkeys((*AUDITED, *bands.COLUMNS)))
"""What a campaign takes out of its compiled programs: to take out more is another program, of other last bits."""

Told = Callable[[int, int, int], None]
"""Called as flights of a chunk land, with how many did, how many of them reached the goal, and contacts among them."""


@dataclass(frozen=True)
class ChunkResult:
    """What became of a chunk's runs; plain bytes, to be sent and written.

    Attributes:
        number: of the chunk.
        table: a Parquet file with one row a run (`table.py`). Its metadata names the plan (`plan`), the chunk
            (`chunk`), the digest of the bands (`bands`) and the kind of processor (`processor`).
        bands: an `.npz` file with the chunk's `Bands`.

    """

    number: int
    table: bytes
    bands: bytes


def fly_chunk(plan: Plan, number: int, *, workers: int | None = None, told: Told | None = None) -> ChunkResult:
    """Fly one chunk.

    Args:
        plan: of the campaign.
        number: of the chunk, from 0 on.
        workers: batches in flight at once; by default one for each core. The result does not depend on it.
        told: called as flights land.

    """
    first, last = plan.chunk_runs(number)
    counted = plan.bands()
    rows = fly_rows(plan, plan.draw(first, last), workers=workers, told=told, counted=counted)
    sketch = counted.to_bytes()
    marks = {
        "plan": plan.sha256,
        "chunk": str(number),
        "bands": digest(np.frombuffer(sketch, np.uint8)),
        "scenario": plan.scenario.model_dump_json(),
        "processor": processor(),
    }
    return ChunkResult(number, table.to_bytes(rows, marks), sketch)


def fly_rows(
    plan: Plan,
    runs: Sequence[Run],
    *,
    workers: int | None = None,
    told: Told | None = None,
    counted: bands.Bands | None = None,
    landed: Landed | None = None,
) -> pa.Table:
    """Fly drawn runs and give their rows, the same whichever runs are flown together.

    Args:
        plan: of the campaign.
        runs: as it draws them.
        workers: batches in flight at once; by default one for each core.
        told: called as flights land.
        counted: bands to count them into.
        landed: called with their log columns too.

    """
    verdicts: dict[int, Audit] = {}

    def land(members: Sequence[Run], log: dict[str, np.ndarray]) -> None:
        found = audits(members, log)
        verdicts.update(zip((run.number for run in members), found))
        if counted is not None:
            goals = np.array([run.scenario.goal.position for run in members])
            counted.count(log, goals, members[0].scenario.control.period)
        if landed is not None:
            landed(members, log)
        if told is not None:
            near = np.linalg.norm(log["position"][:, -1] - [run.scenario.goal.position for run in members], axis=-1)
            reached = near < [run.scenario.goal.tolerance for run in members]
            told(len(members), int(np.sum(reached)), sum(verdict.contact is not Contact.NO for verdict in found))

    outcomes = fly_runs(
        runs,
        plan.programs,
        seed=plan.scenario.seed,
        batch=plan.batch,
        columns=COLUMNS,
        landed=land,
        workers=workers,
    )
    sure = certified(runs)
    flown = {run.number: (outcomes[run.number], verdicts[run.number], sure[run.number]) for run in runs if run.mission}
    return table.table_of(plan.design, runs, flown)


def audits(runs: Sequence[Run], log: dict[str, np.ndarray]) -> list[Audit]:
    """Judge flights on the exact mesh, together where they share what they are judged by."""
    groups: dict[tuple[int, FlightBounds, ChaserEntry], list[int]] = {}
    for places in by_mission(runs):
        mission = runs[places[0]].mission
        assert mission is not None
        for bounds, some in bounds_of([runs[place] for place in places]):
            group = groups.setdefault((id(mission.target), bounds, mission.scenario.chaser), [])
            group += [places[k] for k in some]
    found: dict[int, Audit] = {}
    for (_, bounds, _), places in groups.items():
        mission = runs[places[0]].mission
        assert mission is not None
        own = {name: log[name][places] for name in AUDITED}
        found.update(zip(places, judge(mission.scenario, mission.target, own, bounds=bounds)))
    return [found[place] for place in range(len(runs))]


def certified(runs: Sequence[Run]) -> dict[int, bool | None]:
    """Whether the guard's theorem holds from where each flown run starts, by number; None without a guard."""
    found: dict[int, bool | None] = {}
    for places in by_mission(runs):
        members = [runs[place] for place in places]
        mission = members[0].mission
        assert mission is not None
        guard, sure = mission.setup.guard, [None] * len(members)
        if isinstance(guard, Guard):
            sure = (starts_certified(guard, initial_states(members)) & (not mission.assumptions_broken)).tolist()
        found |= zip((run.number for run in members), sure)
    return found
