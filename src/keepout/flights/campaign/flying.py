"""Drawn runs flown in batches and judged: a chunk of a campaign, and single runs again in full.

A chunk is a function of the plan and the chunk's number alone: a process, a thread or a worker on another machine may
fly it, in any order and any number of times. On machines of one kind the answer is the same to the bit. Runs are
grouped by the program that flies them, each group filled up to whole batches; no file is touched.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pyarrow as pa

from keepout.core.audit.audit import AUDITED, Audit, Contact
from keepout.core.audit.tube import FlightBounds
from keepout.core.compiled.kept_programs import processor
from keepout.core.errors import ScenarioError
from keepout.core.flight.batches import Batching, fly_batches
from keepout.core.flight.loop import FlightLog, FlightOutcome
from keepout.core.flight.record import FlightRecord
from keepout.core.flight.setup import flown_setup
from keepout.core.guard.guard import Guard
from keepout.core.guard.start import starts_certified
from keepout.core.kept import digest
from keepout.core.mission.build import Mission
from keepout.core.mission.flight import Flight, judge, judged, legs_flown, record_of
from keepout.core.mission.surroundings import Surroundings
from keepout.core.motion.relative import MotionState, RelativeMotion
from keepout.core.progress import Progress, silent
from keepout.flights.campaign import bands, table
from keepout.flights.campaign.dispersion import Run, alike, by_mission
from keepout.flights.campaign.plan import Plan, Programs

COLUMNS = tuple(dict.fromkeys((*AUDITED, *bands.COLUMNS)))
"""What a campaign takes out of its compiled programs: to take out more is another program, of other last bits."""
NEAR = 490.0
"""Starts within so many metres are within the range that gravity is bounded in anyway, 1000 m."""
_EVERYTHING = tuple(FlightLog.__annotations__)

Landed = Callable[[Sequence[Run], dict[str, np.ndarray]], None]
"""Called with runs that landed and their log columns, each (runs, steps + 1, ...)."""
Told = Callable[[int, int, int], None]
"""Called as flights of a chunk land, with how many did, how many of them reached the goal, and contacts among them."""


class Flown(NamedTuple):
    """What became of a run: its outcome, its verdict, whether the guard's theorem holds from its start, and its holds.

    The third is None without a guard; the fourth, whether all holds were kept, without legs.
    """

    outcome: FlightOutcome
    audit: Audit
    certified: bool | None
    held: bool | None = None


@eqx.filter_jit
def _state(motion: RelativeMotion, position: jax.Array, velocity: jax.Array) -> MotionState:
    return motion.initial_state(position, velocity)


def initial_states(runs: Sequence[Run]) -> MotionState:
    """Give the true states in which runs start, with a leading axis: of the target, those of each mission."""
    states: dict[int, MotionState] = {}
    for run in runs:
        if id(run.mission) not in states:
            at = jax.device_put(run.position), jax.device_put(run.velocity)
            states[id(run.mission)] = jax.device_get(_state(run.flown.setup.motion, *at))
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *(states[id(run.mission)] for run in runs))
    begun = tuple(np.stack([getattr(run, name) for run in runs]) for name in ("position", "velocity"))
    return eqx.tree_at(lambda state: (state.position, state.velocity), stacked, begun)


def fly_runs(
    runs: Sequence[Run],
    programs: Programs,
    *,
    columns: Sequence[str],
    landed: Landed,
    workers: int | None = None,
    progress: Progress = silent,
) -> dict[int, FlightOutcome]:
    """Fly all runs that are not refused; how each flies does not depend on the others.

    Args:
        runs: as drawn.
        programs: of the campaign.
        columns: names of `FlightLog` columns to hand to `landed`.
        landed: gets each batch.
        workers: batches in flight at once; by default one for each core.
        progress: told as flights land.

    Returns:
        The outcome of each flown run, by number.

    """
    setups, found = {}, {}  # of each mission: its setup, and the key and program that fly it
    for place, *_ in by_mission(runs):
        mission = runs[place].flown
        setups[id(mission)] = flown_setup(mission.setup)
        found[id(mission)] = programs.find(setups[id(mission)])
    groups = alike(runs, lambda run: (found[id(run.mission)][0], run.flown.steps, run.scenario.control.period))
    total, done = sum(map(len, groups)), 0
    outcomes: dict[int, FlightOutcome] = {}
    for places in groups:
        members = [runs[place] for place in places]
        program = found[id(members[0].mission)][1]

        def land(begin: int, log: dict[str, np.ndarray], members: list[Run] = members, before: int = done) -> None:
            until = begin + len(log["time"])
            landed(members[begin:until], log)
            progress((before + until) / total, f"{before + until} of {total} flights")

        numbers = np.array([run.number for run in members])
        outcome = fly_batches(
            program.stack([setups[id(run.mission)] for run in members]),
            initial_states(members),
            members[0].flown.steps,
            Batching(programs.seed, numbers, program.vary, program.alike, programs.batch or None, workers),
            columns=tuple(dict.fromkeys(("time", *columns))),
            landed=land,
        )
        for i, run in enumerate(members):
            outcomes[run.number] = jax.tree.map(lambda array, i=i: array[i], outcome)
        done += len(members)
    return outcomes


def fly_judged(
    runs: Sequence[Run],
    programs: Programs,
    *,
    columns: Sequence[str] = COLUMNS,
    landed: Callable[[Sequence[Run], dict[str, np.ndarray], list[Audit]], None] = lambda runs, log, audits: None,
    bounds: FlightBounds | None = None,
    workers: int | None = None,
    progress: Progress = silent,
) -> dict[int, Flown]:
    """Fly all runs that are not refused as `fly_runs` does, and audit them; by number.

    `landed` hears of each batch, with its verdicts. `columns` are at least those that the audit looks at; with "leg"
    among them, holds are judged. `bounds` are those that all runs are judged by; by default each has its own.
    """
    verdicts: dict[int, Audit] = {}
    held: dict[int, bool] = {}

    def land(members: Sequence[Run], log: dict[str, np.ndarray]) -> None:
        found = audits(members, log, bounds)
        for place, run in enumerate(members if log.get("leg") is not None else ()):
            own = (log[name][place] for name in ("time", "position", "leg"))
            held[run.number] = all(leg.kept for leg in legs_flown(run.scenario, *own))
        verdicts.update(zip((run.number for run in members), found))
        landed(members, log, found)

    outcomes = fly_runs(runs, programs, columns=columns, landed=land, workers=workers, progress=progress)
    sure = certified(runs)
    return {
        number: Flown(outcomes[number], verdicts[number], sure[number], held.get(number)) for number in sorted(outcomes)
    }


def columns_of(plan: Plan) -> tuple[str, ...]:
    """Give the columns that a campaign takes out of its programs."""
    if plan.in_full:
        return _EVERYTHING
    return (*COLUMNS, "leg") if plan.scenario.leg else COLUMNS


def audits(runs: Sequence[Run], log: dict[str, np.ndarray], bounds: FlightBounds | None = None) -> list[Audit]:
    """Judge flights on the exact mesh, together where they share what they are judged by."""
    known: dict[Any, FlightBounds] = {}

    def bounds_of(run: Run) -> FlightBounds:
        """Bound what its record does not hold. A start far away takes gravity's bounds with it."""
        at = tuple(run.position.tolist()) if np.linalg.norm(run.position) > NEAR else ()
        key = id(run.mission), at
        if key not in known:
            scenario = run.scenario.replace(campaign={"lower": at, "upper": at}) if at else run.scenario
            known[key] = Surroundings(scenario).flight_bounds
        return known[key]

    by = {run.number: bounds or bounds_of(run) for run in runs}
    found: dict[int, Audit] = {}
    for places in alike(runs, lambda run: (id(run.flown.target), by[run.number], run.scenario.chaser)):
        first = runs[places[0]]
        own = {name: log[name][places] for name in AUDITED}
        found.update(zip(places, judge(first.scenario, first.flown.target, own, bounds=by[first.number])))
    return [found[place] for place in range(len(runs))]


def certified(runs: Sequence[Run]) -> dict[int, bool | None]:
    """Whether the guard's theorem holds from where each flown run starts, by number; None without a guard."""
    found: dict[int, bool | None] = {}
    for places in by_mission(runs):
        members = [runs[place] for place in places]
        mission = members[0].flown
        guard, sure = mission.setup.guard, [None] * len(members)
        if isinstance(guard, Guard):
            sure = (starts_certified(guard, initial_states(members)) & (not mission.assumptions_broken)).tolist()
        found |= zip((run.number for run in members), sure)
    return found


@dataclass(frozen=True)
class ChunkResult:
    """What became of a chunk's runs; plain bytes, to be sent and written.

    Attributes:
        number: of the chunk.
        table: a Parquet file with one row a run (`table.py`). Its metadata names the plan (`plan`), the chunk
            (`chunk`), the digest of the bands (`bands`) and the kind of processor (`processor`).
        bands: an `.npz` file with the chunk's `Bands`.
        records: of the flights that the plan keeps, by run, where its programs give them out (`Plan.in_full`).

    """

    number: int
    table: bytes
    bands: bytes
    records: dict[int, FlightRecord] = field(default_factory=dict)


def fly_chunk(plan: Plan, number: int, *, workers: int | None = None, told: Told | None = None) -> ChunkResult:
    """Fly one chunk.

    Args:
        plan: of the campaign.
        number: of the chunk, from 0 on.
        workers: batches in flight at once; by default one for each core. The result does not depend on it.
        told: called as flights land.

    """
    counted = bands.Bands.empty(plan.scenario.duration, plan.scenario.control.period)
    logs: _Logs = {}

    def land(members: Sequence[Run], log: dict[str, np.ndarray], found: list[Audit]) -> None:
        goals = np.array([run.scenario.goal.position for run in members])
        counted.count(log, goals, members[0].scenario.control.period)
        if plan.in_full and plan.keep != 0:
            _kept(logs)(members, log)
        if told is not None:
            near = np.linalg.norm(log["position"][:, -1] - goals, axis=-1)
            reached = near < [run.scenario.goal.tolerance for run in members]
            told(len(members), int(np.sum(reached)), sum(verdict.contact is not Contact.NO for verdict in found))

    runs = plan.draw(*plan.chunk_runs(number))
    flown = fly_judged(runs, plan.programs, columns=columns_of(plan), landed=land, workers=workers)
    rows = table.table_of(plan.design, plan.scenario, runs, flown)
    wanted = set(least_clear(rows, plan.keep)) & logs.keys()
    kept = _records(_whole(plan, [run for run in runs if run.number in wanted], logs, _outcomes(flown)))
    sketch = counted.to_bytes()
    marks = {
        "plan": plan.sha256,
        "chunk": str(number),
        "bands": digest(np.frombuffer(sketch, np.uint8)),
        "scenario": plan.scenario.model_dump_json(),
        "processor": processor(),
    }
    return ChunkResult(number, table.to_bytes(rows, marks), sketch, dict(kept))


def least_clear(rows: pa.Table, keep: int | None) -> list[int]:
    """Give the runs of a campaign's table that are kept, those of least clearance first; all that flew for None."""
    flown = np.asarray(rows["status"].to_numpy(zero_copy_only=False) == table.FLOWN)
    clearance = np.asarray(rows["minimum_clearance"].cast(pa.float64()).to_numpy(zero_copy_only=False), float)
    runs, clearance = rows["run"].to_numpy()[flown], clearance[flown]
    return [int(run) for run in runs[np.lexsort((runs, clearance))][:keep]]


@dataclass(frozen=True)
class Replayed:
    """A run flown again.

    Attributes:
        run: as drawn.
        row: its row, from the very program that the campaign flies.
        flight: in full, from a program that also gives out what the campaign does not look at.
        apart: the largest difference between what the two programs say of time, position, velocity, force, h and V₁, in
            their units; 0 where they agree to the bit. The second is compiled apart, so that rounding may differ.

    """

    run: Run
    row: dict[str, Any]
    flight: Flight
    apart: float


def replay(plan: Plan, numbers: Sequence[int]) -> list[Replayed]:
    """Fly runs again, in batches of the campaign's size.

    Args:
        plan: of the campaign.
        numbers: of the runs; all in memory at once, so at most a batch or so.

    Raises:
        ScenarioError: there is no such run, or it was refused.

    """
    runs = _drawn(plan, numbers)
    exact: _Logs = {}
    flown = fly_judged(runs, plan.programs, columns=columns_of(plan), landed=_kept(exact))
    rows = table.table_of(plan.design, plan.scenario, runs, flown).to_pylist()
    whole = _whole(plan, runs, exact, _outcomes(flown)) if plan.in_full else _in_full(plan, runs)
    made = []
    for (run, log, result, header), row in zip(whole, rows, strict=True):
        flight = judged(mission_of(run), log, result=result, extra=header)
        apart = max(_apart(exact[run.number][name], np.asarray(getattr(log, name))) for name in COLUMNS)
        made.append(Replayed(run, row, flight, apart))
    return made


def records(plan: Plan, numbers: Sequence[int]) -> Iterator[tuple[int, FlightRecord]]:
    """Fly runs again, as `replay` does, for their records alone; each with its run's number."""
    yield from _records(_in_full(plan, _drawn(plan, numbers)))


_Logs = dict[int, dict[str, np.ndarray]]
_Whole = Iterator[tuple[Run, FlightLog, FlightOutcome, dict[str, Any]]]
"""Runs, each with its log, outcome, and entries of its header."""


def _drawn(plan: Plan, numbers: Sequence[int]) -> list[Run]:
    """Draw runs by their numbers; refused are those that there are not, and those that cannot be flown."""
    runs: list[Run] = []
    for number in numbers:
        if not 0 <= number < plan.runs:
            raise ScenarioError(f"run {number}: the campaign has the runs 0 to {plan.runs - 1}")
        [run] = plan.draw(number, number + 1)
        if run.mission is None:
            raise ScenarioError(f"run {number}: was refused and not flown: {run.refusal}")
        runs.append(run)
    return runs


def _kept(into: _Logs) -> Callable[..., None]:
    """Give what keeps each run's own log columns, by its number, as its flight lands."""

    def keep(members: Sequence[Run], log: dict[str, np.ndarray], *_: Any) -> None:
        for place, run in enumerate(members):
            into[run.number] = {name: array[place] for name, array in log.items() if array is not None}

    return keep


def _in_full(plan: Plan, runs: Sequence[Run]) -> _Whole:
    """Fly runs by the program that gives out everything."""
    full: _Logs = {}
    outcomes = fly_runs(runs, plan.programs, columns=_EVERYTHING, landed=_kept(full))
    yield from _whole(plan, runs, full, outcomes)


def _whole(plan: Plan, runs: Sequence[Run], logs: _Logs, outcomes: Mapping[int, FlightOutcome]) -> _Whole:
    for run in runs:
        log = FlightLog(**{name: jnp.asarray(array) for name, array in logs[run.number].items()})  # pyright: ignore[reportArgumentType]
        yield run, log, jax.device_get(outcomes[run.number]), {"campaign": plan.sha256, "run": run.number}


def _outcomes(flown: Mapping[int, Flown]) -> dict[int, FlightOutcome]:
    return {number: known.outcome for number, known in flown.items()}


def _records(flights: _Whole) -> Iterator[tuple[int, FlightRecord]]:
    for run, log, result, header in flights:
        mission = mission_of(run)
        yield run.number, record_of(mission.scenario, mission.target, log, result, header)


def mission_of(run: Run) -> Mission:
    """Give the mission of one run, its scenario saying where it truly starts."""
    start = {"position": tuple(run.position.tolist()), "velocity": tuple(run.velocity.tolist())}
    initial = jax.tree.map(lambda array: array[0], initial_states([run]))
    around = replace(run.flown.surroundings, scenario=run.scenario.replace(start=start))
    return replace(run.flown, surroundings=around, initial=initial)


def _apart(one: np.ndarray, other: np.ndarray) -> float:
    if np.array_equal(one, other, equal_nan=True):
        return 0.0
    difference = np.abs(np.asarray(one, float) - np.asarray(other, float))
    return float(np.max(np.where(np.isnan(difference), np.inf, difference)))
