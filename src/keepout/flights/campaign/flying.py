"""Drawn runs flown in batches: grouped by the program that flies them, each group filled up to whole batches."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import numpy as np

from keepout.core.audit.tube import FlightBounds
from keepout.core.flight.batches import fly_batches
from keepout.core.flight.outcome import FlightOutcome
from keepout.core.flight.setup import FlightSetup, flown_setup
from keepout.core.mission import environment
from keepout.core.mission.scenario import Scenario
from keepout.core.motion.relative import MotionState, RelativeMotion
from keepout.core.progress import Progress, silent
from keepout.flights.campaign.drawing import Run
from keepout.flights.campaign.programs import Program, program_for, stacked_setup

NEAR = 490.0
"""Starts within so many metres are within the range that gravity is bounded in anyway, 1000 m."""

Landed = Callable[[Sequence[Run], dict[str, np.ndarray]], None]
"""Called with runs that landed and their log columns, each (runs, steps + 1, ...)."""


@eqx.filter_jit
def _state(motion: RelativeMotion, position: jax.Array, velocity: jax.Array) -> MotionState:
    return motion.initial_state(position, velocity)


def initial_state(run: Run) -> MotionState:
    """Give the true state in which a run starts."""
    return jax.tree.map(lambda array: array[0], initial_states([run]))


def initial_states(runs: Sequence[Run]) -> MotionState:
    """Give the true states in which runs start, with a leading axis: of the target, those of each mission."""
    states: dict[int, MotionState] = {}
    for run in runs:
        assert run.mission is not None
        if id(run.mission) not in states:
            at = jax.device_put(run.position), jax.device_put(run.velocity)
            states[id(run.mission)] = jax.device_get(_state(run.mission.setup.motion, *at))
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *(states[id(run.mission)] for run in runs))
    begun = tuple(np.stack([getattr(run, name) for run in runs]) for name in ("position", "velocity"))
    return eqx.tree_at(lambda state: (state.position, state.velocity), stacked, begun)


def by_mission(runs: Sequence[Run]) -> list[list[int]]:
    """Give the places of the runs that are flown, those of one mission together."""
    places: dict[int, list[int]] = {}
    for place, run in enumerate(runs):
        if run.mission is not None:
            places.setdefault(id(run.mission), []).append(place)
    return list(places.values())


def fly_runs(
    runs: Sequence[Run],
    programs: Sequence[Program],
    *,
    seed: int,
    batch: int,
    columns: Sequence[str],
    landed: Landed,
    workers: int | None = None,
    progress: Progress = silent,
) -> dict[int, FlightOutcome]:
    """Fly all runs that are not refused; how each flies does not depend on the others.

    Args:
        runs: as drawn.
        programs: of the campaign.
        seed: of the campaign.
        batch: flights in a batch; a group's last batch is filled up.
        columns: names of `FlightLog` columns to hand to `landed`.
        landed: gets each batch.
        workers: batches in flight at once; by default one for each core.
        progress: told as flights land.

    Returns:
        The outcome of each flown run, by number.

    """
    flown: dict[int, tuple[Any, Program, FlightSetup]] = {}  # of each mission
    for place, *_ in by_mission(runs):
        mission = runs[place].mission
        assert mission is not None
        setup = flown_setup(mission.setup)
        flown[id(mission)] = *program_for(programs, setup), setup
    groups: dict[Any, tuple[Program, list[Run], list[FlightSetup]]] = {}
    for run in runs:
        if run.mission is not None:
            key, program, setup = flown[id(run.mission)]
            _, members, setups = groups.setdefault(
                (key, run.mission.steps, run.scenario.control.period), (program, [], [])
            )
            members.append(run)
            setups.append(setup)
    total = sum(len(members) for _, members, _ in groups.values())
    outcomes: dict[int, FlightOutcome] = {}
    done = 0
    for (_, steps, _), (program, members, setups) in groups.items():
        initial = initial_states(members)

        def land(begin: int, log: dict[str, np.ndarray], members: list[Run] = members, before: int = done) -> None:
            count = len(log["time"])
            landed(members[begin : begin + count], log)
            progress((before + begin + count) / total, f"{before + begin + count} of {total} flights")

        outcome = fly_batches(
            stacked_setup(program, setups),
            initial,
            steps,
            seed=seed,
            places=np.array([run.number for run in members]),
            vary=program.vary,
            alike=program.alike,
            columns=tuple(dict.fromkeys(("time", *columns))),
            landed=land,
            batch=batch,
            workers=workers,
        )
        for i, run in enumerate(members):
            outcomes[run.number] = jax.tree.map(lambda array, i=i: array[i], outcome)
        done += len(members)
    return outcomes


def bounds_of(runs: Sequence[Run]) -> list[tuple[FlightBounds, list[int]]]:
    """Bound what the records of runs of one mission do not hold, for the audit; each with the places of its runs.

    A start far away takes gravity's bounds with it.
    """
    far = [k for k, run in enumerate(runs) if np.linalg.norm(run.position) > NEAR]
    near = sorted(set(range(len(runs))) - set(far))
    found = [(environment.flight_bounds(runs[near[0]].scenario), near)] if near else []
    for k in far:
        at = tuple(runs[k].position.tolist())
        scenario = runs[k].scenario.replace(campaign={"lower": at, "upper": at})
        found.append((environment.flight_bounds(scenario), [k]))
    return found


def with_start(run: Run) -> Scenario:
    """Give the scenario of one run alone, its start as drawn."""
    start = {"position": tuple(run.position.tolist()), "velocity": tuple(run.velocity.tolist())}
    return run.scenario.replace(start=start)


def mission_of(run: Run) -> Any:
    """Give the mission of one run, its scenario saying where it truly starts."""
    assert run.mission is not None
    return replace(run.mission, scenario=with_start(run), initial=initial_state(run))
