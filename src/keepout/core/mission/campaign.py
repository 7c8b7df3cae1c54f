"""Many flights of one scenario from random starts, each audited on the exact mesh."""

import io
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Bool, Float

from keepout.core.audit.audit import Audit, Contact
from keepout.core.errors import ScenarioError
from keepout.core.fields.model import FieldModel
from keepout.core.flight.batches import alike_among, states_at
from keepout.core.flight.outcome import FlightOutcome
from keepout.core.geometry.target import Target
from keepout.core.guard.status import flag_names
from keepout.core.mission.assumptions import guard_numbers
from keepout.core.mission.audited import fly_audited
from keepout.core.mission.build import Mission, prepare
from keepout.core.mission.places import has_way_out, room_to_start
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.series import SERIES, FlightSeries, SeriesKeeper
from keepout.core.mission.statuses import flag_counts, status_counts
from keepout.core.motion.relative import MotionState
from keepout.core.progress import Progress, part_of, silent
from keepout.core.whole_file import write_whole


class Starts(NamedTuple):
    """Where a campaign's flights start.

    `position` (flights, 3) m, body frame. `drawn_again` counts the draws in their place that lay inside the target,
    too near it, or where no free way out was found.
    """

    position: Float[np.ndarray, "flights 3"]
    drawn_again: int


@dataclass(frozen=True)
class Campaign:
    """What became of every flight of a campaign.

    Attributes:
        scenario: as it was flown.
        target: its mesh.
        starts: positions, m, body frame, at rest.
        outcome: with one entry a flight.
        audits: the verdicts on the exact mesh, in the same order.
        seconds: wall-clock time that it took.
        starts_certified: of each flight, whether the guard's theorem holds from its start; None without a guard.
        assumptions_broken: what is flown beyond what the scenario declares.
        guard: what the guard assumes and what follows, as numbers; None without a guard.
        starts_drawn_again: draws of the whole campaign that could not be starts; see `Starts`.
        series: what is kept of every flight over time.

    """

    scenario: Scenario
    target: Target
    starts: Float[np.ndarray, "flights 3"]
    outcome: FlightOutcome
    audits: tuple[Audit, ...]
    seconds: float
    starts_certified: Bool[np.ndarray, "flights"] | None = None
    assumptions_broken: tuple[str, ...] = ()
    guard: dict[str, Any] | None = None
    starts_drawn_again: int = 0
    series: FlightSeries | None = None

    def summary(self) -> dict[str, Any]:
        """Give the campaign's figures as plain numbers for JSON; a contact is whatever the audit does not exclude."""
        verdicts = [audit.contact for audit in self.audits]
        return {
            "runs": len(verdicts),
            "reached": int(np.sum(self.outcome.reached)),
            "contacts": sum(verdict is not Contact.NO for verdict in verdicts),
            "undecided": sum(verdict is Contact.UNDECIDED for verdict in verdicts),
            "minimum_clearance_m": min(audit.minimum_clearance for audit in self.audits),
            "minimum_barrier_m": _least(self.outcome.minimum_barrier),
            "below_barrier": int(np.sum(np.asarray(self.outcome.minimum_barrier) < 0.0)),
            "starts_drawn_again": self.starts_drawn_again,
            "median_delta_v_mps": float(np.median(self.outcome.delta_v)),
            "median_propellant_kg": None
            if self.outcome.propellant is None
            else float(np.median(self.outcome.propellant)),
            "saturated_fraction": float(np.mean(self.outcome.saturated_fraction)),
            "guard_interventions": int(np.sum(self.outcome.guard_interventions)),
            "statuses": status_counts(self.outcome),
            "starts_certified": None if self.starts_certified is None else int(self.starts_certified.sum()),
            "assumptions_broken": list(self.assumptions_broken),
            "guard": self.guard,
            "flagged": self.flagged(),
            "faults": self.scenario.faults.model_dump(exclude_defaults=True),
            "seconds": self.seconds,
            "seed": self.scenario.seed,
        }

    def flagged(self) -> dict[str, int]:
        """Count the flights in which the guard raised each flag; flags never raised are left out."""
        return flag_counts(np.asarray(self.outcome.guard_flags))

    def columns(self) -> dict[str, np.ndarray]:
        """Give one entry a flight of each figure that is kept of it: numbers, and text for the verdict and flags."""
        return {
            **{f"start_{axis}": self.starts[:, k] for k, axis in enumerate("xyz")},
            "reached": np.asarray(self.outcome.reached),
            "final_error": np.asarray(self.outcome.final_error),
            "time_to_reach": np.asarray(self.outcome.time_to_reach),
            "delta_v": np.asarray(self.outcome.delta_v),
            "saturated_fraction": np.asarray(self.outcome.saturated_fraction),
            "guard_interventions": np.asarray(self.outcome.guard_interventions),
            "guard_flags": np.array([" ".join(flag_names(int(f))) for f in np.asarray(self.outcome.guard_flags)], str),
            "contact": np.array([str(audit.contact) for audit in self.audits], str),
            "minimum_clearance": np.array([audit.minimum_clearance for audit in self.audits]),
            "minimum_barrier": np.asarray(self.outcome.minimum_barrier),
            "largest_speed": np.array([audit.largest_speed for audit in self.audits]),
            **({} if self.outcome.propellant is None else {"propellant": np.asarray(self.outcome.propellant)}),
        }

    def save(self, path: Path) -> None:
        """Write one row a flight into a Parquet file, the scenario in its metadata."""
        table = pa.table(self.columns()).replace_schema_metadata({"scenario": self.scenario.model_dump_json()})
        stream = io.BytesIO()
        pq.write_table(table, stream)
        write_whole(path, stream.getvalue())


def _least(values: Any) -> float | None:
    """Give the least, or None where none is a number."""
    least = float(np.min(np.asarray(values)))
    return least if np.isfinite(least) else None


@dataclass(frozen=True)
class CampaignPlan:
    """A campaign made flyable: the mission, and where each flight starts. Build with `plan_campaign`.

    Attributes:
        mission: all that the flights share.
        starts: of all flights.
        initial: their states at rest.
        starts_certified: of each flight, whether the guard's theorem holds from its start; None without a guard.

    """

    mission: Mission
    starts: Starts
    initial: MotionState
    starts_certified: Bool[np.ndarray, "flights"] | None

    def fly(
        self,
        first: int = 0,
        last: int | None = None,
        *,
        series: Sequence[str] = tuple(SERIES),
        stride: int | None = None,
        batch: int | None = None,
        progress: Progress = silent,
    ) -> Campaign:
        """Fly the flights from place `first` up to `last` (by default all) and audit each.

        A flight is the same to the bit whether it is flown with all others or in a part, in batches of one size; the
        batch's size is part of a campaign's identity (`core/flight/batches.py`).

        Args:
            first: place of the first flight.
            last: place after the last one.
            series: what to keep of every flight over time, names of `series.SERIES`.
            stride: control steps from sample to sample of it; by default 1, or as many as keep the series of these
                flights below `series.MOST_NUMBERS`.
            batch: flights in a batch; see `fly_batches`.
            progress: told after each batch.

        """
        began = time.perf_counter()
        mission, scenario = self.mission, self.mission.scenario
        positions = self.starts.position[first:last]
        keeper = SeriesKeeper(
            series,
            flights=len(positions),
            steps=mission.steps,
            period=scenario.control.period,
            goal=scenario.goal.position,
            stride=stride,
        )
        result, audits = fly_audited(
            scenario,
            mission.target,
            mission.setup,
            jax.tree.map(lambda array: array[first:last], self.initial),
            columns=keeper.columns,
            landed=keeper.land,
            seed=scenario.seed,
            first=first,
            alike=alike_among(self.initial),
            batch=batch,
            progress=progress,
        )
        return Campaign(
            scenario,
            mission.target,
            positions,
            result,
            audits,
            time.perf_counter() - began,
            starts_certified=None if self.starts_certified is None else self.starts_certified[first:last],
            assumptions_broken=mission.assumptions_broken,
            guard=None if mission.guard is None else guard_numbers(mission.guard, scenario),
            starts_drawn_again=self.starts.drawn_again,
            series=keeper.kept(),
        )


def plan_campaign(
    scenario: Scenario,
    *,
    target: Target | None = None,
    model: FieldModel | None = None,
    progress: Progress = silent,
) -> CampaignPlan:
    """Build what a campaign's flights share, and draw their starts: at rest in its box.

    Starts are uniform over the part of the box that lies outside the target, with the chaser's radius, the margin and
    0.2 m of clearance; the same seed draws the same starts.

    Args:
        scenario: what to fly.
        target: already loaded; else the scenario's.
        model: its field, already loaded; else the scenario's.
        progress: called while it is built.

    Raises:
        KeepoutError: something in the scenario cannot be flown, it names dispersions, or the box leaves almost no room
            outside the target.

    """
    if scenario.campaign.dispersions:
        raise ScenarioError(
            f"campaign.dispersions: {', '.join(scenario.campaign.dispersions)}; `plan_campaign` and `run_campaign` "
            "vary the start in the box only: fly these by `keepout campaign` or "
            "keepout.flights.campaign.run.fly_campaign"
        )
    mission = prepare(scenario, target=target, model=model, progress=progress)
    starts = draw_starts(scenario, mission.target)
    initial = states_at(mission.setup.motion, starts.position)
    guard, certified = mission.guard, None
    if guard is not None:
        certified = np.asarray(eqx.filter_jit(eqx.filter_vmap(guard.certified_start))(initial))
        certified = certified & (not mission.assumptions_broken)
    return CampaignPlan(mission, starts, initial, certified)


def run_campaign(
    scenario: Scenario,
    *,
    target: Target | None = None,
    series: Sequence[str] = tuple(SERIES),
    stride: int | None = None,
    progress: Progress = silent,
) -> Campaign:
    """Fly `scenario.campaign.runs` flights from random starts at rest in its box, and audit each.

    Starts are drawn as `plan_campaign` says; `series` and `stride` say what is kept over time, as for
    `CampaignPlan.fly`.

    Raises:
        ScenarioError: the box leaves almost no room outside the target.

    """
    began = time.perf_counter()
    progress(0.0, "preparing")
    plan = plan_campaign(scenario, target=target, progress=part_of(progress, 0.0, 0.1))
    flown = plan.fly(series=series, stride=stride, progress=part_of(progress, 0.1, 1.0))
    return replace(flown, seconds=time.perf_counter() - began)


def draw_starts(scenario: Scenario, target: Target) -> Starts:
    """Draw the campaign's starting positions: each with a free way out of the target for the chaser."""
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
    return Starts(np.concatenate(kept), near + enclosed)
