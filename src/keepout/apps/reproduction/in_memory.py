"""Case 3's campaign, in memory: what became of every flight, and chosen quantities of each over time."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import jax
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Float

from keepout.core.audit.audit import AUDITED, Audit
from keepout.core.errors import ScenarioError
from keepout.core.fields.model import FieldModel
from keepout.core.flight.loop import FlightOutcome
from keepout.core.geometry.target import Target
from keepout.core.mission.build import prepare
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.core.mission.target import has_way_out, room_to_start
from keepout.core.progress import Progress, part_of, silent
from keepout.flights.campaign.bands import SERIES, Columns, quantity
from keepout.flights.campaign.dispersion import Run, design
from keepout.flights.campaign.flying import Flown, fly_judged
from keepout.flights.campaign.plan import Plan, Programs
from keepout.flights.campaign.table import FLOWN, finite, summary, table_of

MOST_NUMBERS = 32_000_000
"""A campaign's series hold at most about so many (128 MB as float32), unless a stride is given."""


FIGURES = (
    *("start_x", "start_y", "start_z", "reached", "final_error", "time_to_reach", "delta_v", "saturated_fraction"),
    *("guard_interventions", "guard_flags", "contact", "minimum_clearance", "minimum_barrier", "largest_speed"),
    "propellant",
)
"""Columns of a campaign's table that `FlownInMemory.columns` gives of every flight."""


@dataclass(frozen=True)
class FlightSeries:
    """Chosen quantities of every flight at common times.

    Attributes:
        time: s after the start: control steps at one distance, and the end.
        values: by name as in `SERIES`, (flights, samples) each, float32; not a number where a flight did not land, or
            had ended.

    """

    time: Float[np.ndarray, "samples"]
    values: dict[str, Float[np.ndarray, "flights samples"]]

    @classmethod
    def empty(
        cls, names: Sequence[str], flights: int, steps: int, period: float, stride: int | None = None
    ) -> "FlightSeries":
        """Begin with no flight landed.

        Raises:
            ScenarioError: an unknown quantity, or a stride below 1.

        """
        unknown = [name for name in names if name not in SERIES]
        if unknown:
            raise ScenarioError(f"series: {unknown[0]!r} is not known; valid: {', '.join(SERIES)}")
        if stride is not None and stride < 1:
            raise ScenarioError(f"series: a stride of {stride} control steps; it must be at least 1")
        stride = stride or max(1, -(-flights * (steps + 1) * len(names) // MOST_NUMBERS))
        rows = np.append(np.arange(0, steps, stride), steps)
        return cls(rows * period, {name: np.full((flights, len(rows)), np.nan, np.float32) for name in names})

    @property
    def columns(self) -> tuple[str, ...]:
        """Log columns that it needs."""
        return tuple(dict.fromkeys(SERIES[name][0] for name in self.values))

    def land(self, places: Sequence[int], log: Columns, goals: Float[np.ndarray, "flights 3"], period: float) -> None:
        """Take the flights at some places from their log columns, (flights, steps + 1, ...) each.

        Each time takes the row nearest to it.
        """
        rows = np.rint(self.time / period).astype(int)
        for name, kept in self.values.items():
            here = rows < log[SERIES[name][0]].shape[1]
            kept[np.ix_(places, here)] = quantity(name, log, rows[here], goals)


@dataclass(frozen=True)
class FlownInMemory:
    """What became of every flight of a campaign.

    Attributes:
        scenario: as it was flown.
        target: its mesh.
        runs: as drawn, those that were refused among them.
        flown: of each run that was flown, by number: its outcome, its audit, and whether the guard's theorem holds.
        starts_drawn_again: draws of the whole campaign that could not be starts: inside the target, too near it, or
            without a free way out.
        seconds: wall-clock time that it took.
        series: what is kept of every flight over time.

    """

    scenario: Scenario
    target: Target
    runs: tuple[Run, ...]
    flown: Mapping[int, Flown]
    starts_drawn_again: int
    seconds: float
    series: FlightSeries

    @cached_property
    def flights(self) -> tuple[Run, ...]:
        """The runs that were flown."""
        return tuple(run for run in self.runs if run.mission is not None)

    @cached_property
    def outcome(self) -> FlightOutcome:
        """Outcomes, with one entry a flight."""
        return jax.tree.map(lambda *one: np.stack(one), *(self.flown[run.number].outcome for run in self.flights))

    @property
    def audits(self) -> tuple[Audit, ...]:
        """The verdicts on the exact mesh, one a flight."""
        return tuple(self.flown[run.number].audit for run in self.flights)

    @cached_property
    def table(self) -> pa.Table:
        """One row a run, as a campaign's folder holds them."""
        return table_of(design(self.scenario), self.scenario, self.runs, self.flown)

    def summary(self) -> dict[str, Any]:
        """Give the campaign's figures as plain numbers for JSON; a contact is whatever the audit does not exclude."""
        propellant = self.table["propellant"].drop_null().to_numpy()
        return {
            **summary(self.table, self.scenario),
            "starts_drawn_again": self.starts_drawn_again,
            "median_propellant_kg": finite(np.median, propellant),
            "seconds": self.seconds,
        }

    def columns(self) -> dict[str, np.ndarray]:
        """Give one entry a flight of each figure that is kept of it: numbers, and text for the verdict and flags.

        What dispersions drew stands beside, with each flight's number.
        """
        drawn: list[str] = []
        if self.scenario.campaign.dispersions:
            names = tuple(dispersion.name for dispersion in design(self.scenario).dispersions)
            drawn = ["run", *(name for name in self.table.column_names if name.startswith(names))]
        flown = self.table.filter(pc.field("status") == FLOWN)
        figures = [name for name in FIGURES if name != "propellant" or flown[name].null_count < len(flown)]
        arrays = {name: flown[name].to_numpy(zero_copy_only=False) for name in (*drawn, *figures)}
        return {name: array.astype(str) if array.dtype == object else array for name, array in arrays.items()}


@dataclass(frozen=True)
class CampaignPlan:
    """A campaign made flyable in memory: its runs as drawn. Build with `plan_campaign`.

    Attributes:
        scenario: of all runs, with its `campaign` table.
        target: its mesh.
        runs: all of them.
        programs: what flies them.
        starts_drawn_again: see `FlownInMemory`.

    """

    scenario: Scenario
    target: Target
    runs: tuple[Run, ...]
    programs: Programs
    starts_drawn_again: int

    def fly(
        self,
        first: int = 0,
        last: int | None = None,
        *,
        series: Sequence[str] = tuple(SERIES),
        stride: int | None = None,
        batch: int = 0,
        progress: Progress = silent,
    ) -> FlownInMemory:
        """Fly the runs from place `first` up to `last` (by default all) and audit each.

        A flight is the same to the bit whether it is flown with all others or in a part, in batches of one size; the
        batch's size is part of a campaign's identity (`core/flight/batches.py`).

        Args:
            first: place of the first run.
            last: place after the last one.
            series: what to keep of every flight over time, names of `SERIES`.
            stride: control steps from sample to sample of it; by default 1, or as many as keep the series of these
                flights below `MOST_NUMBERS`.
            batch: flights in a batch; see `fly_batches`.
            progress: told after each batch.

        """
        began, scenario, runs = time.perf_counter(), self.scenario, self.runs[first:last]
        places = {run.number: place for place, run in enumerate(run for run in runs if run.mission is not None)}
        kept = FlightSeries.empty(series, len(places), scenario.steps, scenario.control.period, stride)

        def land(members: Sequence[Run], log: Columns, _: list[Audit]) -> None:
            goals = np.array([run.scenario.goal.position for run in members])
            kept.land([places[run.number] for run in members], log, goals, members[0].scenario.control.period)

        flown = fly_judged(
            runs,
            replace(self.programs, batch=batch or self.programs.batch),
            columns=(*AUDITED, *kept.columns, *(["leg"] if scenario.leg else [])),
            landed=land,
            # The bounds of the box hold for each start in it.
            bounds=None if scenario.campaign.dispersions else Surroundings(scenario).flight_bounds,
            progress=progress,
        )
        seconds = time.perf_counter() - began
        return FlownInMemory(scenario, self.target, runs, flown, self.starts_drawn_again, seconds, kept)


def plan_campaign(
    scenario: Scenario,
    *,
    target: Target | None = None,
    model: FieldModel | None = None,
    progress: Progress = silent,
) -> CampaignPlan:
    """Build what a campaign's flights share, and draw its runs.

    What the scenario's dispersions vary is drawn as `keepout campaign` draws it: the flights are the same to the bit.
    Without dispersions only the start varies: at rest, uniform over the part of the box that lies outside the target,
    with the chaser's radius, the margin and 0.2 m of clearance; the same seed draws the same starts.

    Args:
        scenario: what to fly.
        target: already loaded; else the scenario's.
        model: the field to fly by without dispersions; else the scenario's.
        progress: called while it is built.

    Raises:
        KeepoutError: something in the scenario cannot be flown, or the box leaves almost no room outside the target.

    """
    if scenario.campaign.dispersions:
        if model is not None:
            raise ScenarioError("campaign.dispersions: each run flies by its own scenario's field; give no model")
        plan = Plan.of(scenario, target=target, progress=progress)
        runs = tuple(plan.draw(0, plan.runs))
        again = sum(run.drawn_again for run in runs)
        return CampaignPlan(plan.scenario, plan.workshop.target(scenario), runs, plan.programs, again)
    mission = prepare(scenario, target=target, model=model, progress=progress)
    scenario = mission.scenario
    starts, again = draw_starts(scenario, mission.target)
    runs = tuple(
        Run(number, {"start.position": start.tolist()}, start, np.zeros(3), 0, mission)
        for number, start in enumerate(starts)
    )
    return CampaignPlan(scenario, mission.target, runs, Programs.of([mission], 0), again)


def run_campaign(
    scenario: Scenario,
    *,
    target: Target | None = None,
    series: Sequence[str] = tuple(SERIES),
    stride: int | None = None,
    progress: Progress = silent,
) -> FlownInMemory:
    """Fly the `scenario.campaign.runs` runs of a scenario's campaign in memory, and audit each.

    They are drawn as `plan_campaign` says: by its dispersions, or else from random starts at rest in its box. `series`
    and `stride` say what is kept over time, as for `CampaignPlan.fly`.

    Raises:
        KeepoutError: something in the scenario cannot be flown, or the box leaves almost no room outside the target.

    """
    began = time.perf_counter()
    progress(0.0, "preparing")
    plan = plan_campaign(scenario, target=target, progress=part_of(progress, 0.0, 0.1))
    flown = plan.fly(series=series, stride=stride, progress=part_of(progress, 0.1, 1.0))
    return replace(flown, seconds=time.perf_counter() - began)


def draw_starts(scenario: Scenario, target: Target) -> tuple[Float[np.ndarray, "flights 3"], int]:
    """Draw starting positions in the campaign's box, each with a free way out of the target for the chaser.

    Returns:
        Them, m, and how many draws in their place lay inside the target, too near it, or had no free way out.

    """
    entry = scenario.campaign
    generator = np.random.default_rng(scenario.seed)
    lower, upper = np.asarray(entry.lower), np.asarray(entry.upper)
    room, mesh = room_to_start(scenario), target.distance
    kept: list[np.ndarray] = []
    drawn, found, enclosed, near, wanted = 0, 0, 0, 0, entry.runs
    while found < wanted:
        points = generator.uniform(lower, upper, (max(wanted, 1000), 3))
        drawn += len(points)
        away = mesh.distance(points)
        roomy = np.flatnonzero(away > room)
        # Those after the last one needed were never asked for.
        asked = len(points) if len(roomy) < wanted - found else roomy[wanted - found - 1] + 1
        points, away = points[roomy[: wanted - found]], away[roomy[: wanted - found]]
        near += int(asked) - len(points)
        free = np.array([has_way_out(scenario, target, *at) for at in zip(points, away.tolist())], dtype=bool)
        kept.append(points[free])
        found += int(free.sum())
        enclosed += int((~free).sum())
        # A search for a way out that is not there is slow, so that few are made where nearly all fail.
        if found < wanted and (drawn >= 20 * max(wanted, 1000) or enclosed > 5 * (found + 2)):
            raise ScenarioError(
                f"campaign: of {drawn} starts drawn between {list(entry.lower)} m and {list(entry.upper)} m only "
                f"{found} lie outside the target with {room:.2f} m of room; widen the box"
            )
    return np.concatenate(kept), near + enclosed
