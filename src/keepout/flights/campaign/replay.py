"""Single runs of a campaign flown again, in full: for a flight file, figures, and to show that they are the same."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow as pa

from keepout.core.errors import ScenarioError
from keepout.core.flight.loop import FlightLog
from keepout.core.mission.flight import Flight, judged
from keepout.flights.campaign.chunk import COLUMNS, fly_rows
from keepout.flights.campaign.drawing import Run
from keepout.flights.campaign.flying import fly_runs, mission_of
from keepout.flights.campaign.plan import Plan

_EVERYTHING = tuple(FlightLog.__annotations__)


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


def replay(plan: Plan, numbers: Sequence[int], *, workers: int | None = None) -> list[Replayed]:
    """Fly runs again, in batches of the campaign's size.

    Args:
        plan: of the campaign.
        numbers: of the runs; all in memory at once, so at most a batch or so.
        workers: batches in flight at once; by default one for each core.

    Raises:
        ScenarioError: there is no such run, or it was refused.

    """
    runs: list[Run] = []
    for number in numbers:
        if not 0 <= number < plan.runs:
            raise ScenarioError(f"run {number}: the campaign has the runs 0 to {plan.runs - 1}")
        [run] = plan.draw(number, number + 1)
        if run.mission is None:
            raise ScenarioError(f"run {number}: was refused and not flown: {run.refusal}")
        runs.append(run)
    exact: dict[int, dict[str, np.ndarray]] = {}
    full: dict[int, dict[str, np.ndarray]] = {}

    def keep(into: dict[int, dict[str, np.ndarray]], members: Sequence[Run], log: dict[str, np.ndarray]) -> None:
        for place, run in enumerate(members):
            into[run.number] = {name: array[place] for name, array in log.items() if array is not None}

    rows = fly_rows(plan, runs, workers=workers, landed=lambda members, log: keep(exact, members, log)).to_pylist()
    outcomes = fly_runs(
        runs,
        plan.programs,
        seed=plan.scenario.seed,
        batch=plan.batch,
        columns=_EVERYTHING,
        landed=lambda members, log: keep(full, members, log),
        workers=workers,
    )
    made = []
    for run, row in zip(runs, rows, strict=True):
        arrays = {name: jnp.asarray(array) for name, array in full[run.number].items()}
        log = FlightLog(**arrays)  # pyright: ignore[reportArgumentType]
        header = {"campaign": plan.sha256, "run": run.number}
        flight = judged(mission_of(run), log, result=jax.device_get(outcomes[run.number]), extra=header)
        apart = max(_apart(exact[run.number][name], full[run.number][name]) for name in COLUMNS)
        made.append(Replayed(run, row, flight, apart))
    return made


def differences(kept: pa.Table, row: dict[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Compare a run's row in a campaign's table with another: the columns in which they differ, with both values."""
    [found] = kept.to_pylist()
    return {name: (found[name], row[name]) for name in found if not _equal(found[name], row[name])}


def _equal(one: Any, other: Any) -> bool:
    return one == other or (one != one and other != other)


def _apart(one: np.ndarray, other: np.ndarray) -> float:
    if np.array_equal(one, other, equal_nan=True):
        return 0.0
    difference = np.abs(np.asarray(one, float) - np.asarray(other, float))
    return float(np.max(np.where(np.isnan(difference), np.inf, difference)))
