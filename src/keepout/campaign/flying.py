"""Drawn runs flown in batches: grouped by the program that flies them, each group filled up to whole batches."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import numpy as np

from keepout.audit.tube import FlightBounds
from keepout.campaign.drawing import Run
from keepout.campaign.programs import Program, flown_setup, program_for, stacked_setup
from keepout.flight.batches import fly_batches
from keepout.flight.outcome import FlightOutcome
from keepout.mission import environment
from keepout.mission.scenario import Scenario
from keepout.motion.relative import MotionState, RelativeMotion
from keepout.progress import Progress, silent

NEAR = 490.0
"""Starts within so many metres are within the range that gravity is bounded in anyway, 1000 m."""

Landed = Callable[[Sequence[Run], dict[str, np.ndarray]], None]
"""Called with runs that landed and their log columns, each (runs, steps + 1, ...)."""


@eqx.filter_jit
def _state(motion: RelativeMotion, position: jax.Array, velocity: jax.Array) -> MotionState:
    return motion.initial_state(position, velocity)


def initial_state(run: Run) -> MotionState:
    """Give the true state in which a run starts."""
    assert run.mission is not None
    return _state(run.mission.setup.motion, jax.device_put(run.position), jax.device_put(run.velocity))


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
    groups: dict[Any, tuple[Program, list[Run], list[Any]]] = {}
    for run in runs:
        if run.mission is not None:
            setup = flown_setup(run.mission.setup)
            key, program = program_for(programs, setup)
            _, members, setups = groups.setdefault(
                (key, run.mission.steps, run.scenario.control.period), (program, [], [])
            )
            members.append(run)
            setups.append(setup)
    total = sum(len(members) for _, members, _ in groups.values())
    outcomes: dict[int, FlightOutcome] = {}
    done = 0
    for (_, steps, _), (program, members, setups) in groups.items():
        states = [initial_state(run) for run in members]
        initial = jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *states)

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


def bounds_of(run: Run) -> FlightBounds:
    """Bound what a run's record does not hold, for the audit; a start far away takes gravity's bounds with it."""
    scenario = run.scenario
    if np.linalg.norm(run.position) > NEAR:
        at = tuple(run.position.tolist())
        scenario = scenario.replace(campaign={"lower": at, "upper": at})
    return environment.flight_bounds(scenario)


def with_start(run: Run) -> Scenario:
    """Give the scenario of one run alone, its start as drawn."""
    start = {"position": tuple(run.position.tolist()), "velocity": tuple(run.velocity.tolist())}
    return run.scenario.replace(start=start)


def mission_of(run: Run) -> Any:
    """Give the mission of one run, its scenario saying where it truly starts."""
    assert run.mission is not None
    return replace(run.mission, scenario=with_start(run), initial=initial_state(run))
