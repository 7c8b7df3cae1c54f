"""Many flights of one scenario from random starts, each audited on the exact mesh."""

import io
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Bool, Float

from keepout.audit.audit import Audit, Contact, audit_campaign
from keepout.audit.outside import proved_outside
from keepout.errors import ScenarioError
from keepout.flight.batches import fly_batches
from keepout.flight.outcome import FlightOutcome
from keepout.geometry.target import Target
from keepout.guard.status import flag_names
from keepout.mission import environment
from keepout.mission.assumptions import guard_numbers
from keepout.mission.build import prepare
from keepout.mission.scenario import Scenario
from keepout.mission.statuses import flag_counts, status_counts
from keepout.progress import Progress, part_of, silent
from keepout.whole_file import write_whole

_AUDITED = ("time", "position", "velocity", "force", "guard_status")


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

    def summary(self) -> dict[str, Any]:
        """Give the campaign's figures as plain numbers for JSON; a contact is whatever the audit does not exclude."""
        verdicts = [audit.contact for audit in self.audits]
        return {
            "runs": len(verdicts),
            "reached": int(np.sum(self.outcome.reached)),
            "contacts": sum(verdict is not Contact.NO for verdict in verdicts),
            "undecided": sum(verdict is Contact.UNDECIDED for verdict in verdicts),
            "minimum_clearance_m": min(audit.minimum_clearance for audit in self.audits),
            "median_delta_v_mps": float(np.median(self.outcome.delta_v)),
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

    def save(self, path: Path) -> None:
        """Write one row a flight into a Parquet file, the scenario in its metadata."""
        columns = {
            **{f"start_{axis}": self.starts[:, k] for k, axis in enumerate("xyz")},
            "reached": np.asarray(self.outcome.reached),
            "final_error": np.asarray(self.outcome.final_error),
            "time_to_reach": np.asarray(self.outcome.time_to_reach),
            "delta_v": np.asarray(self.outcome.delta_v),
            "saturated_fraction": np.asarray(self.outcome.saturated_fraction),
            "guard_interventions": np.asarray(self.outcome.guard_interventions),
            "guard_flags": [" ".join(flag_names(int(flags))) for flags in np.asarray(self.outcome.guard_flags)],
            "contact": [str(audit.contact) for audit in self.audits],
            "minimum_clearance": [audit.minimum_clearance for audit in self.audits],
        }
        table = pa.table(columns).replace_schema_metadata({"scenario": self.scenario.model_dump_json()})
        stream = io.BytesIO()
        pq.write_table(table, stream)
        write_whole(path, stream.getvalue())


def run_campaign(scenario: Scenario, *, target: Target | None = None, progress: Progress = silent) -> Campaign:
    """Fly `scenario.campaign.runs` flights from random starts at rest in its box, and audit each.

    Starts are uniform over the part of the box that lies outside the target, with the chaser's radius, the margin and
    0.2 m of clearance; the same seed draws the same starts.

    Raises:
        ScenarioError: the box leaves almost no room outside the target.

    """
    began = time.perf_counter()
    progress(0.0, "preparing")
    mission = prepare(scenario, target=target, progress=part_of(progress, 0.0, 0.1))
    starts = draw_starts(scenario, mission.target)
    initial = eqx.filter_vmap(mission.setup.motion.initial_state)(jnp.asarray(starts), jnp.zeros_like(starts))
    guard, starts_certified = mission.guard, None
    if guard is not None:
        starts_certified = np.asarray(eqx.filter_jit(eqx.filter_vmap(guard.certified_start))(initial))
        starts_certified = starts_certified & (not mission.assumptions_broken)
    audits: list[Audit | None] = [None] * len(starts)
    bounds = environment.flight_bounds(scenario)

    def landed(first: int, columns: dict[str, np.ndarray]) -> None:
        verdicts = audit_campaign(
            columns["time"][0],
            columns["position"],
            columns["velocity"],
            columns["force"],
            mission.target,
            guard_status=columns["guard_status"],
            chaser_radius=scenario.chaser.radius,
            bounds=bounds,
            force_limit=scenario.chaser.force_limit,
            speed_limit=scenario.chaser.speed_limit,
        )
        audits[first : first + len(verdicts)] = verdicts

    result = fly_batches(
        mission.setup,
        initial,
        mission.steps,
        seed=scenario.seed,
        columns=_AUDITED,
        landed=landed,
        progress=part_of(progress, 0.1, 1.0),
    )
    done = tuple(audit for audit in audits if audit is not None)
    return Campaign(
        scenario,
        mission.target,
        starts,
        result,
        done,
        time.perf_counter() - began,
        starts_certified=starts_certified,
        assumptions_broken=mission.assumptions_broken,
        guard=None if guard is None else guard_numbers(guard),
    )


def draw_starts(scenario: Scenario, target: Target) -> Float[np.ndarray, "flights 3"]:
    """Draw the campaign's starting positions, m, body frame: each with a free way out of the target for the chaser."""
    entry = scenario.campaign
    generator = np.random.default_rng(scenario.seed)
    lower, upper = np.asarray(entry.lower), np.asarray(entry.upper)
    room = scenario.chaser.radius + scenario.safety.margin + 0.2
    mesh = target.distance

    def way_out(point: Float[np.ndarray, "3"]) -> bool:
        return proved_outside(
            point, mesh.distance, mesh.lower, mesh.upper, radius=scenario.chaser.radius, expansions=100
        )

    kept: list[np.ndarray] = []
    drawn, found, enclosed, wanted = 0, 0, 0, entry.runs
    while found < wanted:
        points = generator.uniform(lower, upper, (max(wanted, 1000), 3))
        drawn += len(points)
        points = points[mesh.distance(points) > room][: wanted - found]
        free = np.array([way_out(point) for point in points], dtype=bool)
        kept.append(points[free])
        found += int(free.sum())
        enclosed += int((~free).sum())
        # A search for a way out that is not there is slow, so that few are made where nearly all fail.
        if found < wanted and (drawn >= 20 * max(wanted, 1000) or enclosed > 5 * (found + 2)):
            raise ScenarioError(
                f"campaign: of {drawn} starts drawn between {list(entry.lower)} m and {list(entry.upper)} m only "
                f"{found} lie outside the target with {room:.2f} m of room; widen the box"
            )
    return np.concatenate(kept)
