"""Flights to be replayed, from memory or from flight files, with the surfaces that their law and guard flew by."""

import functools
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from keepout.apps.inspection.coverage import Coverage
from keepout.apps.unknown.growth import Growth
from keepout.core.audit.audit import Audit, audit
from keepout.core.errors import FlightError, KeepoutError
from keepout.core.fields.field import Field
from keepout.core.fields.model import FieldModel
from keepout.core.flight.record import EXPLORED, FlightRecord
from keepout.core.geometry.target import Target
from keepout.core.guard.field import guard_field
from keepout.core.mission import environment
from keepout.core.mission.build import closing_radius, load_model, load_target
from keepout.core.mission.flight import Flight
from keepout.core.mission.scenario import Scenario
from keepout.core.progress import Progress, part_of, silent
from keepout.flights.replay.clearance import proved_clearance


@dataclass(frozen=True, eq=False)
class Level:
    """A level surface to be drawn: {`field` = `level`} (m), where a bound of ‖∇f̃‖ is `steepest`.

    `proved` says whether the certificate behind it is one; `identity` is equal for equal fields.
    """

    kind: Literal["envelope", "guard"]
    identity: str
    field: Field
    level: float
    steepest: float
    error_bound: float
    proved: bool


@dataclass(frozen=True, eq=False)
class Replayed:
    """One flight of a replay: what was recorded, its scenario and target, the audit, and what surfaces it has.

    `growth` is of a flight that explored: the map by which it flew, as it grew. `coverage` is of one that inspected:
    what it saw when.
    """

    name: str
    record: FlightRecord
    scenario: Scenario
    target: Target
    verdict: Audit
    levels: tuple[Level, ...] = ()
    growth: Growth | None = None
    coverage: Coverage | None = None

    @functools.cached_property
    def shown(self) -> FlightRecord:
        """The flight up to the first position or attitude that is not a number: there is no path from there on.

        Raises:
            FlightError: that is its first row.

        """
        rows = np.isfinite(np.concatenate([self.record.position, self.record.attitude], axis=1)).all(axis=1)
        until = self.record.steps + 1 if np.all(rows) else int(np.argmin(rows))
        if until == 0:
            raise FlightError(f"{self.name}: its first position or attitude is not a number; there is nothing to draw")
        return FlightRecord(self.record.header, **{name: of[:until] for name, of in self.record.columns.items()})

    @functools.cached_property
    def proved(self) -> Float[np.ndarray, "steps"]:
        """A proved lower bound of the clearance over each step that is shown, m; see `proved_clearance`."""
        return proved_clearance(
            self.shown,
            self.target.distance,
            chaser_radius=self.scenario.chaser.radius,
            bounds=environment.flight_bounds(self.scenario),
        )


def of_flights(flights: Mapping[str, Flight]) -> list[Replayed]:
    """Gather flights that are in memory, by name; one that does not know its mission has no surfaces."""
    gathered = []
    for name, flight in flights.items():
        levels: list[Level] = []
        if flight.mission is not None:
            levels.append(_envelope(flight.mission.model, flight.scenario))
            if flight.mission.guard is not None:
                guard = flight.mission.guard
                radius = flight.scenario.chaser.radius
                identity = f"{flight.target.sha256} {guard.threshold!r}"
                error_bound = guard.threshold - radius
                levels.append(
                    Level("guard", identity, guard.field, guard.threshold, guard.lipschitz, error_bound, True)
                )
        gathered.append(Replayed(name, flight.record, flight.scenario, flight.target, flight.audit, tuple(levels)))
    return gathered


def of_records(records: Mapping[str, FlightRecord], *, progress: Progress = silent) -> list[Replayed]:
    """Gather recorded flights, by name; what they flew around is loaded as their scenarios say.

    Raises:
        KeepoutError: a record without a scenario, or whose mesh or field cannot be read or is another one now; the
            message begins with the flight's name.

    """
    surroundings = Surroundings()
    return [
        surroundings.of(name, record, progress=part_of(progress, place / len(records), (place + 1) / len(records)))
        for place, (name, record) in enumerate(records.items())
    ]


def of_files(paths: Sequence[Path], *, progress: Progress = silent) -> list[Replayed]:
    """Gather flight files; each is named by its scenario's name, or by its path where that does not tell them apart.

    Raises:
        KeepoutError: a file that cannot be read as a flight, or what `of_records` raises; the message names the file.

    """
    records = {str(path): FlightRecord.load(path) for path in paths}
    gathered = of_records(records, progress=progress)
    names = [flight.scenario.name for flight in gathered]
    if len(set(names)) < len(names):
        return gathered
    return [
        Replayed(name, flight.record, flight.scenario, flight.target, flight.verdict, flight.levels)
        for name, flight in zip(names, gathered)
    ]


class Surroundings:
    """Targets, fields and guards' fields, loaded once for all recorded flights that share them."""

    def __init__(self) -> None:
        self.targets: dict[str, Target] = {}
        self.models: dict[tuple[str, str], FieldModel] = {}
        self.guards: dict[tuple[str, float, float, float], FieldModel] = {}

    def of(self, name: str, record: FlightRecord, *, progress: Progress = silent) -> Replayed:
        """Gather one recorded flight.

        Raises:
            KeepoutError: as `of_records` says.

        """
        try:
            return self._gathered(name, record, progress)
        except KeepoutError as error:
            raise type(error)(f"{name}: {error}") from error

    def _gathered(self, name: str, record: FlightRecord, progress: Progress) -> Replayed:
        scenario = _scenario(record)
        entry = scenario.target.model_dump_json()
        if entry not in self.targets:
            self.targets[entry] = load_target(scenario.target)
        target = self.targets[entry]
        flown = record.header.get("target_sha256")
        if flown and flown != target.sha256:
            raise FlightError(
                f"the mesh {scenario.target.source} is not the one it was flown around (digest {target.sha256[:12]}…, "
                f"flown {flown[:12]}…); put that mesh back"
            )
        levels = () if record.header.get(EXPLORED) else self._levels(scenario, target, entry, progress)
        verdict = audit(
            record,
            target,
            chaser_radius=scenario.chaser.radius,
            bounds=environment.flight_bounds(scenario),
            force_limit=scenario.chaser.force_limit,
            speed_limit=scenario.chaser.speed_limit,
        )
        return Replayed(name, record, scenario, target, verdict, levels)

    def _levels(self, scenario: Scenario, target: Target, entry: str, progress: Progress) -> tuple[Level, ...]:
        """Give the surfaces that law and guard flew by, of a scenario whose target's entry is `entry`."""
        key = entry, scenario.field.model_dump_json()
        if key not in self.models:
            self.models[key] = load_model(scenario, target)
        model, radius = self.models[key], scenario.chaser.radius
        levels = [_envelope(model, scenario)]
        if scenario.guard.enabled:
            made_from = target.sha256, radius, model.offset, closing_radius(model)
            if made_from not in self.guards:
                self.guards[made_from] = guard_field(
                    target, radius, offset=model.offset, closing_radius=closing_radius(model), progress=progress
                )
            kept = self.guards[made_from]
            certificate = kept.certificate(radius)
            level = certificate.error_bound + radius
            identity = f"{target.sha256} {level!r}"
            levels.append(
                Level("guard", identity, kept.field, level, certificate.gradient_bound, certificate.error_bound, True)
            )
        return tuple(levels)


def _scenario(record: FlightRecord) -> Scenario:
    text = record.header.get("scenario")
    try:
        tree = json.loads(text) if isinstance(text, str) and text else None
    except json.JSONDecodeError:
        tree = None
    if not isinstance(tree, dict):
        raise FlightError("its header holds no scenario, so what it was flown around is not known; fly it with Keepout")
    return Scenario.parse(tree, where="its scenario")


def _envelope(model: FieldModel, scenario: Scenario) -> Level:
    certificate = model.certificate(scenario.chaser.radius)
    level = certificate.error_bound + certificate.chaser_radius
    return Level(
        "envelope",
        f"{model.sha256} {level!r}",
        model.field,
        level,
        certificate.gradient_bound,
        certificate.error_bound,
        certificate.kind == "certified",
    )
