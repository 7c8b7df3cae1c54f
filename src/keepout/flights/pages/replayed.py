"""Flights to be replayed, from memory or from flight files, with the surfaces that their law and guard flew by."""

import functools
import json
import os
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from jaxtyping import Float

from keepout.core.audit.audit import AUDITED, Audit
from keepout.core.audit.tube import FlightBounds, Tube
from keepout.core.compiled.kept_programs import keep_programs
from keepout.core.errors import FlightError, KeepoutError
from keepout.core.fields.field import Field
from keepout.core.fields.model import FieldModel
from keepout.core.fields.zones import ZonedField
from keepout.core.flight.record import EXPLORED, FlightRecord
from keepout.core.geometry.distance import Distance
from keepout.core.geometry.target import Target
from keepout.core.mission.flight import Flight, judge
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.core.progress import Progress, part_of, silent
from keepout.flights.pages.approach_drawn import distance_left

if TYPE_CHECKING:
    from keepout.flights.campaign.plan import Workshop
    from keepout.flights.pages.scene import Packing

_PIECES = 4
"""Pieces of a step that are bounded apart: each is nearer to its middle than the whole step is."""
_ROUNDING = 1e-9
"""Metres taken off every bound, as the audit does."""
_CONSISTENCY = 1e-6
"""What the flight's own integrator may err by in a step, m, as the audit allows."""


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


class Layer(ABC):
    """What an application adds to the replay of its flight: the map that grew, what was seen of the surface.

    `name` is that under which the viewer finds it in a flight's data.
    """

    name: ClassVar[str]

    @abstractmethod
    def told(self, packing: "Packing", start: float) -> dict[str, Any]:
        """Give it as JSON holds it, with the arrays packed; times count from `start`, s."""

    def share_at(self, time: Float[np.ndarray, "rows"]) -> Float[np.ndarray, "rows"] | None:
        """Give the share of the surface that was seen up to each time (s); None of a flight that has a goal instead."""
        return None


@dataclass(frozen=True, eq=False)
class Replayed:
    """One flight of a replay: what was recorded, its scenario and target, the audit, its surfaces and its layer.

    `field_sha256` is the digest of the field that the law flew by; empty where it is not known.
    """

    name: str
    record: FlightRecord
    scenario: Scenario
    target: Target
    verdict: Audit
    levels: tuple[Level, ...] = ()
    layer: Layer | None = None
    field_sha256: str = ""

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
    def nearest(self) -> tuple[Float[np.ndarray, "rows"], Float[np.ndarray, "rows 3"]]:
        """The distance to the mesh, m, and its closest point, body frame, m, at each row that is shown."""
        distance, closest, _ = self.target.distance.closest(self.shown.position)
        return distance, closest

    @property
    def clearance(self) -> Float[np.ndarray, "rows"]:
        """From the chaser's surface to the mesh at each row that is shown, m."""
        return self.nearest[0] - self.scenario.chaser.radius

    @functools.cached_property
    def proved(self) -> Float[np.ndarray, "steps"]:
        """A proved lower bound of the clearance over each step that is shown, m; see `proved_clearance`."""
        radius, bounds = self.scenario.chaser.radius, Surroundings(self.scenario).flight_bounds
        return proved_clearance(self.shown, self.target.distance, chaser_radius=radius, bounds=bounds)

    @functools.cached_property
    def error(self) -> Float[np.ndarray, "rows"] | None:
        """Distance to the goal, or to the place of the leg under way, at each row that is shown, m; None: no goal."""
        if self.share is not None:
            return None
        return distance_left(self.scenario, self.shown)

    @functools.cached_property
    def share(self) -> Float[np.ndarray, "rows"] | None:
        """The share of the surface that was seen up to each row that is shown; None of a flight that has a goal."""
        return None if self.layer is None else self.layer.share_at(self.shown.time)


def of_flights(flights: Mapping[str, Flight], layer: Layer | None = None) -> list[Replayed]:
    """Gather flights that are in memory, by name; one that does not know its mission has no surfaces."""
    gathered = []
    for name, flight in flights.items():
        levels: list[Level] = []
        field = "" if flight.mission is None else flight.mission.model.sha256
        if flight.mission is not None:
            levels.append(_envelope(flight.mission.model, flight.scenario))
            guard = flight.mission.guard
            if guard is not None:
                error_bound = guard.threshold - flight.scenario.chaser.radius
                mesh = guard.field.inner if isinstance(guard.field, ZonedField) else guard.field
                levels.append(_guards(flight.target, mesh, guard.threshold, guard.lipschitz, error_bound))
        told = flight.record, flight.scenario, flight.target, flight.audit, tuple(levels), layer, field
        gathered.append(Replayed(name, *told))
    return gathered


def of_records(records: Mapping[str, FlightRecord], *, progress: Progress = silent) -> list[Replayed]:
    """Gather recorded flights, by name; what they flew around is loaded as their scenarios say, once for all of them.

    Raises:
        KeepoutError: a record without a scenario, or whose mesh or field cannot be read or is another one now; the
            message begins with the flight's name.

    """
    from keepout.flights.campaign.plan import Workshop  # for which nobody waits who replays what is in memory

    workshop = Workshop()
    return [
        of_record(name, record, workshop, progress=part_of(progress, place / len(records), (place + 1) / len(records)))
        for place, (name, record) in enumerate(records.items())
    ]


def of_record(name: str, record: FlightRecord, workshop: "Workshop", *, progress: Progress = silent) -> Replayed:
    """Gather one recorded flight; what it shares with others is loaded once in the workshop.

    Raises:
        KeepoutError: as `of_records` says.

    """
    try:
        return _gathered(name, record, workshop, progress)
    except KeepoutError as error:
        raise type(error)(f"{name}: {error}") from error


def of_files(paths: Sequence[Path], *, progress: Progress = silent) -> list[Replayed]:
    """Gather flight files; each is named by its scenario, or by its path below their common folder if names are alike.

    Raises:
        KeepoutError: a file that cannot be read as a flight, or what `of_records` raises; the message names the file.

    """
    keep_programs()  # a surface that `fly` has cut for its own page is not cut again
    gathered = of_records({str(path): FlightRecord.load(path) for path in paths}, progress=progress)
    names = [flight.scenario.name for flight in gathered]
    if len(set(names)) < len(names):
        common = os.path.commonpath([path.absolute().parent for path in paths])
        names = [path.absolute().relative_to(common).with_suffix("").as_posix() for path in paths]
    if len(set(names)) < len(names):  # one file twice, or two that differ by their ending
        return gathered
    return [replace(flight, name=name) for flight, name in zip(gathered, names, strict=True)]


def _gathered(name: str, record: FlightRecord, workshop: "Workshop", progress: Progress) -> Replayed:
    scenario = _scenario(record)
    chaser, target, flown = scenario.chaser, workshop.target(scenario), record.header.get("target_sha256")
    if flown and flown != target.sha256:
        raise FlightError(
            f"the mesh {scenario.target.source} is not the one it was flown around (digest {target.sha256[:12]}…, "
            f"flown {flown[:12]}…); put that mesh back"
        )
    levels: list[Level] = []
    field = ""
    if not record.header.get(EXPLORED):
        field = workshop.model(scenario).sha256
        levels.append(_envelope(workshop.model(scenario), scenario))
        if scenario.guard.enabled:
            kept = workshop.guard_field(scenario, progress=progress)
            proof = kept.certificate(chaser.radius)
            level = proof.error_bound + chaser.radius
            levels.append(_guards(target, kept.field, level, proof.gradient_bound, proof.error_bound))
    [verdict] = judge(scenario, target, {name: getattr(record, name)[None] for name in AUDITED})
    return Replayed(name, record, scenario, target, verdict, tuple(levels), field_sha256=field)


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
    proof = model.certificate(scenario.chaser.radius)
    level, proved = proof.error_bound + proof.chaser_radius, proof.kind == "certified"
    identity = f"{model.sha256} {level!r}"
    return Level("envelope", identity, model.field, level, proof.gradient_bound, proof.error_bound, proved)


def _guards(target: Target, field: Field, level: float, steepest: float, error_bound: float) -> Level:
    return Level("guard", f"{target.sha256} {level!r}", field, level, steepest, error_bound, proved=True)


def proved_clearance(
    record: FlightRecord, distance: Distance, *, chaser_radius: float, bounds: FlightBounds
) -> Float[np.ndarray, "steps"]:
    """Bound the clearance from below over each step of a flight.

    The distance to the mesh at the middle of a quarter of a step, less how far the path can be from there within it
    (`audit.tube`) and the chaser's radius, is a bound for that quarter; the least of four is the step's. It is weaker
    than the audit's, which splits the steps that matter until the bound is tight.

    Args:
        record: the flight.
        distance: exact, to the target's mesh.
        chaser_radius: m.
        bounds: on what the record does not hold.

    Returns:
        Metres, one a step. Not a number where nothing is proved: a step that holds a number which is not finite, that
        no motion within the bounds can have flown, or that may have gone beyond where gravity is bounded.

    """
    states = np.isfinite(np.concatenate([record.position, record.velocity], axis=1))
    finite = np.all(states, axis=1, keepdims=True)[:, 0]
    readable = finite[:-1] & finite[1:] & np.isfinite(record.force[:-1]).all(axis=1)
    position, velocity, force = (
        np.where(np.isfinite(array), array, 0.0)[None] for array in (record.position, record.velocity, record.force)
    )
    tube = Tube.of(record.time, position, velocity, force, bounds)
    proved = readable & ~tube.beyond[0] & (tube.inconsistency()[0] <= _CONSISTENCY)
    step = np.arange(record.steps)
    flight = np.zeros(record.steps, int)
    least = np.full(record.steps, np.inf)
    for piece in range(_PIECES):
        start, end = (np.full(record.steps, edge / _PIECES) for edge in (piece, piece + 1))
        point, _, radius = tube.piece(flight, step, start, end)
        least = np.minimum(least, distance.distance(point) - radius)
    return np.where(proved, least - chaser_radius - _ROUNDING, np.nan)
