"""Scenarios flown, one flight or many together, and judged on the exact mesh: what became of them, in numbers.

What became of a flight's legs and of its rule of speeds is measured at the samples, of the true motion.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from enum import IntEnum
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
from jaxtyping import Float, Int

from keepout.core.audit.audit import AUDITED, Audit, Contact, ExactMesh, Limits, audit_campaign
from keepout.core.audit.tube import FlightBounds
from keepout.core.control.law import ControlStatus
from keepout.core.flight import loop
from keepout.core.flight.batches import Batching, Landed, fly_batches
from keepout.core.flight.loop import FlightOutcome, outcome
from keepout.core.flight.record import FlightRecord
from keepout.core.flight.setup import FlightSetup
from keepout.core.geometry.target import Target
from keepout.core.guard.guard import Guard
from keepout.core.guard.safety_layer import GuardFlag, GuardStatus, flag_names
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings, guard_numbers
from keepout.core.mission.zones import named, regions
from keepout.core.motion.relative import MotionState
from keepout.core.plug_ins import load
from keepout.core.progress import Progress, silent


@dataclass(frozen=True)
class LegFlown:
    """One leg, by the true positions at the control steps.

    Attributes:
        name: of the leg.
        begun: when it was begun, s; None where the flight ended before.
        reached: from when on the chaser stayed within the tolerance until the leg was over, s; None: it did not.
        left: when the next leg was begun, s; None for a leg that the flight ended on.
        held: how long it stayed there by then, s.
        largest_error: distance from the place over the last `dwell` seconds of the leg, m, at most.
        kept: whether the place was held within its tolerance for its dwell, and reached within its window.

    """

    name: str
    begun: float | None
    reached: float | None
    left: float | None
    held: float
    largest_error: float | None
    kept: bool

    def summary(self) -> dict[str, Any]:
        """Give the leg as plain values, named with their units."""
        units = {"name": "name", "kept": "kept", "largest_error": "largest_error_m"}
        return {units.get(key, f"{key}_s"): value for key, value in asdict(self).items()}


def legs_flown(
    scenario: Scenario,
    time: Float[np.ndarray, "rows"],
    position: Float[np.ndarray, "rows 3"],
    leg: Int[np.ndarray, "rows"],
) -> tuple[LegFlown, ...]:
    """Judge each leg of a flight; of one that was abandoned those that were over before.

    Args:
        scenario: as flown.
        time: of the rows, s.
        position: the true one, m.
        leg: under way in each row, counted from 0.

    """
    found: list[LegFlown] = []
    abort = scenario.faults.abort_at
    abandoned = abort is not None and scenario.approach.abort == "retreat" and time[-1] >= abort
    if abandoned:
        before = time < abort
        time, position, leg = time[before], position[before], leg[before]
    for number, entry in enumerate(scenario.leg):
        name, rows = named("leg", entry, number), np.flatnonzero(leg == number)
        if not rows.size:
            found.append(LegFlown(name, None, None, None, 0.0, None, kept=False))
            continue
        away = np.linalg.norm(position[rows] - np.asarray(entry.position), axis=1)
        outside = np.flatnonzero(~(away < entry.tolerance))
        first = 0 if not outside.size else int(outside[-1]) + 1
        there = first < len(rows)
        reached = float(time[rows[first]]) if there else None
        held = float(time[rows[-1]] - time[rows[first]]) if there else 0.0
        dwelling = time[rows] >= time[rows[-1]] - entry.dwell - 1e-6
        in_time = entry.within is None or (reached is not None and reached <= entry.within[1])
        ended = rows[-1] + 1 < len(time)
        found.append(
            LegFlown(
                name=name,
                begun=float(time[rows[0]]),
                reached=reached,
                left=float(time[rows[-1] + 1]) if ended else None,
                held=held,
                largest_error=float(away[dwelling].max()),
                kept=there and held >= entry.dwell - 1e-6 and in_time,
            )
        )
    return tuple(one for one in found if not abandoned or one.left is not None)


def speed_excess(
    scenario: Scenario,
    position: Float[np.ndarray, "rows 3"],
    velocity: Float[np.ndarray, "rows 3"],
    clearance: Float[np.ndarray, "rows"],
) -> float:
    """Give by how much, m/s, the rule of speeds was passed at most at a sample; at most 0: it was kept.

    Args:
        scenario: with the rule.
        position: the true one, m.
        velocity: likewise, m/s.
        clearance: from the chaser's surface to the mesh, m.

    """
    allowed = allowed_speed(scenario, position, clearance)
    return float(np.nanmax(np.linalg.norm(velocity, axis=1) - allowed))


def allowed_speed(
    scenario: Scenario, position: Float[np.ndarray, "rows 3"], clearance: Float[np.ndarray, "rows"]
) -> Float[np.ndarray, "rows"]:
    """Give the largest speed, m/s, that the rule of speeds allows at each sample; arguments as of `speed_excess`."""
    rule, point = np.array(scenario.approach.speed_by_distance)[::-1], scenario.approach.distance_to
    to_mesh = clearance + scenario.chaser.radius
    distance = to_mesh if point is None else np.linalg.norm(position - np.asarray(point), axis=1)
    return np.interp(distance, rule[:, 0], rule[:, 1])


if TYPE_CHECKING:
    from keepout.core.mission.build import Mission


@dataclass(frozen=True)
class Verdict:
    """What is known of a contact in a flight, and whether it was certified before it began.

    Attributes:
        contact: by the audit on the exact mesh: "proved free", "contact" (proved too) or "undecided".
        certified: whether the guard's theorem held from the start; None without a guard.
        why: what both rest on, in words.

    """

    contact: str
    certified: bool | None
    why: str

    def __str__(self) -> str:
        certified = {True: "certified from the start", False: "not certified", None: "flown without a certified guard"}
        return f"{self.contact}, {certified[self.certified]}: {self.why}"


def _finite(number: Any) -> float | None:
    """Give a figure as JSON has it: None where it is not finite."""
    return float(number) if np.isfinite(number) else None


@dataclass(frozen=True)
class Flight:
    """One flown scenario: what was recorded, what became of it, and the audit on the exact mesh.

    Attributes:
        scenario: as it was flown.
        target: its mesh.
        record: the flight's rows.
        outcome: what became of it.
        audit: the verdict on the exact mesh.
        clearance: from the chaser's surface to the mesh at every recorded sample, m.
        violated_conditions: the design conditions that the law does not meet, each with its numbers.
        start_certified: whether the guard's theorem holds from the start; None without a guard.
        assumptions_broken: what is flown beyond what the scenario declares.
        guard: what the guard assumes and what follows, as numbers; None without a guard.
        mission: what was flown, with its fields; None where it is not at hand.

    """

    scenario: Scenario
    target: Target
    record: FlightRecord
    outcome: FlightOutcome
    audit: Audit
    clearance: Float[np.ndarray, "samples"]
    violated_conditions: tuple[str, ...] = ()
    start_certified: bool | None = None
    assumptions_broken: tuple[str, ...] = ()
    guard: dict[str, Any] | None = None
    mission: "Mission | None" = None

    def summary(self) -> dict[str, Any]:
        """Give the flight's figures as plain numbers for JSON.

        `contact` is true unless the audit proves that there was none; `contact_verdict` tells the cases apart. A
        figure that is not finite, after a command that was no number, is None.
        """
        return {
            "reached": bool(self.outcome.reached),
            "contact": self.audit.contact is not Contact.NO,
            "contact_verdict": str(self.audit.contact),
            "minimum_clearance_m": _finite(self.audit.minimum_clearance),
            "measured_clearance_m": _finite(self.audit.measured_clearance),
            "final_error_m": _finite(self.outcome.final_error),
            "delta_v_mps": _finite(self.outcome.delta_v),
            "propellant_kg": None if self.outcome.propellant is None else float(self.outcome.propellant),
            "saturated_fraction": float(self.outcome.saturated_fraction),
            "guard_interventions": int(self.outcome.guard_interventions),
            "time_to_reach_s": float(self.outcome.time_to_reach) if self.outcome.reached else None,
            "largest_speed_mps": _finite(self.audit.largest_speed),
            "statuses": status_counts(self.outcome),
            "start_certified": self.start_certified,
            "assumptions_broken": list(self.assumptions_broken),
            "guard": self.guard,
            "guard_flags": self.guard_flags(),
            "navigation": self.navigation_figures(),
            "faults": self.scenario.faults.model_dump(exclude_defaults=True),
            "violated_conditions": list(self.violated_conditions),
            "remarks": list(self.audit.remarks),
        } | self._approach_figures()

    def zone_figures(self) -> dict[str, Any]:
        """Give what the audit says of zones and corridors; nothing where there are none."""
        zones = [
            {
                "name": zone.name,
                "entered": str(zone.entered),
                "minimum_clearance_m": _finite(zone.minimum_clearance),
                "measured_clearance_m": _finite(zone.measured_clearance),
            }
            for zone in self.audit.zones
        ]
        return {"zones_entered": str(self.audit.zones_entered), "zones": zones} if zones else {}

    def _approach_figures(self) -> dict[str, Any]:
        """Give what became of zones, legs and the rule of speeds, of those that the scenario has."""
        figures = self.zone_figures()
        if self.legs:
            figures["holds_kept"] = all(leg.kept for leg in self.legs)
            figures["legs"] = [leg.summary() for leg in self.legs]
        if self.scenario.approach.speed_by_distance:
            figures["speed_rule_excess_mps"] = speed_excess(
                self.scenario, self.record.position, self.record.velocity, self.clearance
            )
        if self.scenario.approach.abort_time is not None:
            figures["drifts"] = self._drifts
        return figures

    @cached_property
    def _drifts(self) -> list[dict[str, Any]]:
        return load("flight", "drifts")(self)

    @property
    def legs(self) -> tuple[LegFlown, ...]:
        """What became of each leg; () where the law flew none."""
        record = self.record
        return () if record.leg is None else legs_flown(self.scenario, record.time, record.position, record.leg)

    @property
    def verdict(self) -> Verdict:
        """Say in one value whether a contact is excluded, and whether it was so before the flight began."""
        audit = self.audit
        known = f"at no instant is the clearance below {audit.minimum_clearance:.4g} m"
        found = f"at {audit.minimum_time:.4g} s it is {audit.measured_clearance:.4g} m"
        contact, why = {
            Contact.NO: ("proved free", [known]),
            Contact.YES: ("contact", [found]),
            Contact.UNDECIDED: ("undecided", [known, found] if np.isfinite(audit.minimum_clearance) else []),
        }[audit.contact]
        if self.start_certified is not None:
            beyond = self.assumptions_broken or ("the guard's theorem does not cover the start",)
            why += ["the guard's theorem covers the start"] if self.start_certified else beyond
        return Verdict(contact, self.start_certified, "; ".join([*why, *audit.remarks]))

    def table(self) -> pa.Table:
        """Give the record as an Arrow table, which pandas and polars take: a row a control step, SI units, body frame.

        Its columns are those of `FlightRecord`; a vector is a column a component, as `position_x`.
        """
        return self.record.table()

    def save(self, path: str | Path) -> Path:
        """Write the flight file that `keepout replay` and `keepout export` read, and return its path.

        Args:
            path: ends in `.parquet` or `.npz`.

        Raises:
            FlightError: another ending, or a place that cannot be written.

        """
        return self.record.save(path)

    def replay(self, path: str | Path = "replay.html", *, title: str | None = None) -> Path:
        """Write one page to watch the flight in any browser, offline, and return its path.

        Args:
            path: the page (.html).
            title: of the page; the scenario's name if absent.

        Raises:
            KeepoutError: another ending, or a place that cannot be written.

        """
        return load("flight", "replay")(self, Path(path), title)

    def export(self, to: str, where: str | Path = ".", **wanted: Any) -> list[Path]:
        """Write the flight for other programs, with epoch, frames and units stated, and return the paths.

        Args:
            to: "oem" (of chaser and target), "aem", "czml", "csv", "parquet", "npz" or "glb".
            where: a folder, or the file to write.
            **wanted: more of `Export`: `craft` and `xml`.

        Raises:
            KeepoutError: no such format, or a file that cannot be written.

        """
        return load("flight", "export")(self, to, Path(where), **wanted)

    def plot(self, path: str | Path | None = None) -> Any:
        """Draw the path around the target, and clearance, speed, force and distance to the goal over time.

        Args:
            path: also write it there (.png, .pdf or .svg).

        Returns:
            A Matplotlib `Figure`.

        """
        return load("flight", "plot")(self, path)

    def _repr_html_(self) -> str:
        return load("notebook", "flight")(self)

    def guard_flags(self) -> dict[str, int]:
        """Count the steps in which the guard raised each flag; flags never raised are left out."""
        return flag_counts(self.record.guard_status[:-1])

    def navigation_figures(self) -> dict[str, Any] | None:
        """Give what the sensors left to know, and what was made of it; None where no sensors fly.

        The errors are those of the law's estimate at the control steps flown. `probability_beyond` bounds the
        probability per flight that the guard's set misses the truth because noise went beyond its bound.
        """
        record, entry = self.record, self.scenario.navigation
        if entry.suite == "none" or record.outliers is None or record.contradicted is None:
            return None
        assumed = Surroundings(self.scenario, self.target).guard_assumptions
        figures: dict[str, Any] = {
            "suite": entry.suite,
            "estimate": entry.estimate,
            "position_error_cap_m": float(assumed.position_error),
            "velocity_error_cap_mps": float(assumed.velocity_error),
        }
        for name, unit in (("position", "m"), ("velocity", "mps")):
            wrong = np.linalg.norm(getattr(record, f"estimated_{name}") - getattr(record, name), axis=1)[:-1]
            figures[f"{name}_error_rms_{unit}"] = float(np.sqrt(np.mean(wrong**2)))
            figures[f"{name}_error_largest_{unit}"] = float(wrong.max())
        return figures | {
            "outliers": int(record.outliers[:-1].sum()),
            "contradicted_steps": int(record.contradicted[:-1].sum()),
            "probability_beyond": load("navigation", "suite")(entry).probability_beyond(record.steps),
        }


def judged(mission: "Mission", log: loop.FlightLog, **known: Any) -> Flight:
    """Give the flight of a mission that was already flown: its record, outcome, and audit on the exact mesh.

    Args:
        mission: what was flown.
        log: of that one flight.
        **known: `result` and `extra` of `recorded`.

    """
    standing = mission.start_certified, mission.assumptions_broken
    flight = recorded(mission.scenario, mission.target, mission.setup, log, mission.bounds, standing, **known)
    violated = tuple(str(c) for c in mission.setup.controller.conditions if not c.satisfied)
    return replace(flight, violated_conditions=violated, mission=mission)


def recorded(
    scenario: Scenario,
    target: Target,
    setup: FlightSetup,
    log: loop.FlightLog,
    bounds: FlightBounds,
    standing: tuple[bool | None, tuple[str, ...]],
    *,
    result: FlightOutcome | None = None,
    extra: Mapping[str, Any] | None = None,
) -> Flight:
    """Give a flight of any setup: its record, outcome, and audit on the exact mesh.

    Args:
        scenario: as flown.
        target: its mesh.
        setup: of the flight.
        log: of that one flight.
        bounds: of what the record does not hold.
        standing: whether the guard's theorem holds from the start (None without a guard), and what is flown beyond what
            the scenario declares, which leaves nothing certified.
        result: the outcome, where it is known already.
        extra: further entries of the record's header.

    """
    result = outcome(setup, log) if result is None else result
    record = record_of(scenario, target, log, result, extra)
    [verdict] = judge(scenario, target, {name: getattr(record, name)[None] for name in AUDITED}, bounds=bounds)
    known = np.isfinite(record.position).all(axis=1)  # a law of one's own may command what is no number
    clearance = np.full(len(record.position), np.nan)
    clearance[known] = target.distance.distance(record.position[known]) - scenario.chaser.radius
    guard = guard_numbers(setup.guard, scenario) if isinstance(setup.guard, Guard) else None
    certified, broken = standing
    certified = None if certified is None else certified and not broken
    return Flight(scenario, target, record, result, verdict, clearance, (), certified, broken, guard)


def record_of(
    scenario: Scenario,
    target: Target,
    log: loop.FlightLog,
    result: FlightOutcome,
    extra: Mapping[str, Any] | None = None,
) -> FlightRecord:
    """Give the record of a flight; arguments as of `recorded`."""
    return FlightRecord.of_log(
        log,
        outcome=result,
        scenario=scenario.model_dump_json(),
        seed=scenario.seed,
        target_sha256=target.sha256,
        statuses=legend(),
        extra=extra,
    )


def fly_audited(
    scenario: Scenario,
    target: ExactMesh,
    setup: FlightSetup,
    initial: MotionState,
    *,
    columns: Sequence[str] = (),
    landed: Landed | None = None,
    tolerance: float = 1e-3,
    progress: Progress = silent,
    **batches: Any,
) -> tuple[FlightOutcome, tuple[Audit, ...]]:
    """Fly a setup from many initial states, and audit each flight.

    Args:
        scenario: how long the flights are, and what they are judged by: chaser, and all that bounds their motion.
        target: the mesh.
        setup: of every flight; what differs between flights is named by `vary`.
        initial: states with a leading axis of flights.
        columns: of the log, for `landed` beside `AUDITED`.
        landed: gets each batch's columns once it is judged.
        tolerance: how close to the truth the clearance bounds are driven, m.
        progress: told after each batch.
        **batches: entries of `Batching`, such as `vary`, `seed` or `batch`.

    Returns:
        The outcomes with a leading axis of flights, and the verdicts in the same order.

    """
    bounds, audits = Surroundings(scenario).flight_bounds, []

    def land(first: int, log: dict[str, np.ndarray]) -> None:
        audits.extend(judge(scenario, target, log, bounds=bounds, tolerance=tolerance))
        if landed is not None:
            landed(first, log)

    wanted = tuple(dict.fromkeys((*AUDITED, *columns)))
    batching = Batching(**batches)
    outcome = fly_batches(setup, initial, scenario.steps, batching, columns=wanted, landed=land, progress=progress)
    return outcome, tuple(audits)


def judge(
    scenario: Scenario,
    target: ExactMesh,
    log: Mapping[str, np.ndarray],
    *,
    bounds: FlightBounds | None = None,
    tolerance: float = 1e-3,
) -> list[Audit]:
    """Audit flights that were flown together, by the columns `AUDITED` of their log, each (flights, steps + 1, ...).

    Args:
        scenario: gives the chaser's radius and limits.
        target: the mesh.
        log: more columns do not matter.
        bounds: on what the log does not hold; by default the scenario's.
        tolerance: how close to the truth the clearance bounds are driven, m.

    """
    chaser, around = scenario.chaser, Surroundings(scenario)
    limits = Limits(chaser.radius, chaser.force_limit, chaser.speed_limit)
    bounds = around.flight_bounds if bounds is None else bounds
    return audit_campaign(log, target, limits, bounds, regions=regions(around), tolerance=tolerance)


LAYERS: Mapping[str, type[IntEnum]] = {"control": ControlStatus, "guard": GuardStatus}
"""The enumeration of each layer's statuses."""


def legend() -> dict[str, dict[int, str]]:
    """Name every number that a flight file's columns `control_status` and `guard_status` are made of."""
    names = {f"{layer}_status": {int(s): s.name.lower() for s in kind} for layer, kind in LAYERS.items()}
    names["guard_status"] |= {int(flag): name for flag in GuardFlag for name in flag_names(flag)}
    return names


def status_counts(outcome: FlightOutcome) -> dict[str, dict[str, int]]:
    """Count the steps of one flight, or of all flights of a batch, by layer and status; those never met are left out.

    Args:
        outcome: of one flight, or with leading axes of many.

    """
    counted = {}
    for layer, kind in LAYERS.items():
        count = np.asarray(getattr(outcome, f"{layer}_status_counts"))
        count = count.reshape(-1, count.shape[-1]).sum(axis=0)
        counted[layer] = {status.name.lower(): int(count[status]) for status in kind if count[status]}
    return counted


def flag_counts(statuses: Int[np.ndarray, "n"]) -> dict[str, int]:
    """Count among guard statuses, of steps or of whole flights, those with each flag; flags never met are left out."""
    counts = {name: int(np.count_nonzero(statuses & flag)) for flag in GuardFlag for name in flag_names(flag)}
    return {name: count for name, count in counts.items() if count}
