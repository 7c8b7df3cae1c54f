"""What a replay's page holds: one target, its surfaces, and flights around it, as JSON with references into its bytes.

Positions are metres in the target's body frame; times s from a flight's start.
"""

import base64
import zlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial.transform import Rotation

from keepout.core.control.law import ControlStatus
from keepout.core.errors import FlightError
from keepout.core.flight.record import FlightRecord
from keepout.core.guard.safety_layer import GuardFlag, GuardStatus, flag_names
from keepout.core.mission.approach import has_rules
from keepout.core.mission.bounds import orbit_of, sun_of
from keepout.core.mission.entries import SunEntry
from keepout.core.mission.flight import allowed_speed
from keepout.core.mission.scenario import Scenario
from keepout.core.motion.orbit import Orbit
from keepout.core.motion.rotation import vvlh_axes, without_jumps
from keepout.core.progress import Progress, part_of, silent
from keepout.flights.pages import approach_drawn
from keepout.flights.pages.drawn import drawn_body, drawn_surface
from keepout.flights.pages.replayed import Level, Replayed

FORMAT = 1
"""Of the page's data; the viewer refuses another."""
MOST_ROWS = 5000
"""Rows of a flight that are drawn; of a longer one every second, third, … row."""
_JOINED = 400
"""Runs of one kind that are nearer than this part of the flight are one mark."""
_ALIGNMENT = 4
"""Bytes: JavaScript reads an array of 32-bit numbers only from a multiple of four."""
_STEPS = 32767
"""Steps of a 16-bit number to either side of 0."""

Quaternions = Float[np.ndarray, "rows 4"]


class Packing:
    """Collects arrays, and gives a reference to each that JSON can hold.

    A reference holds `offset` (bytes), `type` (a NumPy name), `shape`, and, for numbers stored in steps, `scale` and
    `origin`: the number is origin + scale × what is stored, one of each for each column.
    """

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._length = 0

    def exact(self, array: np.ndarray, kind: str = "float32") -> dict[str, Any]:
        """Store an array in a NumPy type, and give its reference."""
        stored = np.ascontiguousarray(array, dtype=np.dtype(kind).newbyteorder("<"))
        reference = {"offset": self._length, "type": kind, "shape": list(stored.shape)}
        content = stored.tobytes()
        padding = -len(content) % _ALIGNMENT
        self._parts.append(content + bytes(padding))
        self._length += len(content) + padding
        return reference

    def steps(self, array: np.ndarray) -> dict[str, Any]:
        """Store finite numbers in 16 bits each, in 65 534 even steps over the range of each column.

        What is read back is off by half a step at most: the column's range divided by 131 068.
        """
        rows = np.asarray(array, np.float64)
        columns = rows.reshape(len(rows), -1)
        lower = columns.min(axis=0, initial=np.inf) if len(columns) else np.zeros(columns.shape[1])
        upper = columns.max(axis=0, initial=-np.inf) if len(columns) else np.zeros(columns.shape[1])
        origin, scale = 0.5 * (lower + upper), (upper - lower) / (2 * _STEPS)
        stored = np.rint((columns - origin) / np.where(scale > 0.0, scale, 1.0))
        reference = self.exact(stored.reshape(rows.shape), "int16")
        return reference | {"origin": origin.tolist(), "scale": scale.tolist()}

    def indices(self, array: np.ndarray) -> dict[str, Any]:
        """Store indices in the smallest of the two types that a graphics card takes."""
        small = array.size == 0 or int(array.max()) < 2**16
        return self.exact(array, "uint16" if small else "uint32")

    def text(self) -> str:
        """Give all bytes, compressed (zlib) and as base64."""
        return base64.b64encode(zlib.compress(b"".join(self._parts), 9)).decode("ascii")


@dataclass(frozen=True)
class Scene:
    """A replay's data: what JSON holds, and the bytes it refers to, as text."""

    told: dict[str, Any]
    content: str


def scene(flights: Sequence[Replayed], *, progress: Progress = silent) -> Scene:
    """Gather what the page of some flights holds.

    Args:
        flights: at least one, all around one target.
        progress: told how far it is.

    Raises:
        FlightError: no flight, or flights around different targets.

    """
    if not flights:
        raise FlightError("replay: no flight; name at least one flight file")
    first = flights[0]
    for flight in flights[1:]:
        if flight.target.sha256 != first.target.sha256:
            raise FlightError(
                f"{flight.name}: flown around {flight.target.name} (digest {flight.target.sha256[:12]}…), and "
                f"{first.name} around {first.target.name} ({first.target.sha256[:12]}…); one replay shows one target"
            )
    packing = Packing()
    wanted = {(level.kind, level.identity): level for flight in flights for level in flight.levels}
    surfaces = [
        _surface(packing, level, first, part_of(progress, 0.7 * place / len(wanted), 0.7 * (place + 1) / len(wanted)))
        for place, level in enumerate(wanted.values())
    ]
    places = {key: place for place, key in enumerate(wanted)}
    told_flights = []
    for place, flight in enumerate(flights):
        progress(0.7 + 0.3 * place / len(flights), flight.name)
        told = _flight(packing, flight)
        told["surfaces"] = [places[level.kind, level.identity] for level in flight.levels]
        if flight.layer is not None:
            told[flight.layer.name] = flight.layer.told(packing, float(flight.record.time[0]))
        if has_rules(flight.scenario):
            told["approach"] = approach_drawn.told(flight.scenario, float(flight.record.time[0]))
        told_flights.append(told)
    told = {"format": FORMAT, "target": _target(packing, first), "surfaces": surfaces, "flights": told_flights}
    progress(1.0, "")
    return Scene(told, packing.text())


def _target(packing: Packing, flight: Replayed) -> dict[str, Any]:
    target = flight.target
    body = drawn_body(target)
    return {
        "name": target.name,
        "triangles": body.triangles,
        "remark": body.remark,
        "ball_radius": target.ball_radius,
        "lower": target.distance.lower.tolist(),
        "upper": target.distance.upper.tolist(),
        "vertices": packing.steps(body.vertices),
        "faces": packing.indices(body.faces),
        "openness": packing.exact(np.rint(255.0 * body.openness), "uint8"),
    }


def _surface(packing: Packing, level: Level, flight: Replayed, progress: Progress) -> dict[str, Any]:
    drawn = drawn_surface(level.field, flight.target.distance, level.level, steepest=level.steepest, progress=progress)
    return {
        "kind": level.kind,
        "level": level.level,
        "error_bound": level.error_bound,
        "proved": level.proved,
        "spacing": drawn.spacing,
        "vertices": packing.steps(drawn.vertices),
        "normals": packing.exact(np.rint(127.0 * drawn.normals), "int8"),
        "faces": packing.indices(drawn.faces),
    }


def rows_shown(rows: int) -> Int[np.ndarray, "shown"]:
    """Choose the rows of a flight that are drawn: evenly, the last one among them."""
    stride = -(-(rows - 1) // MOST_ROWS)
    return np.unique(np.append(np.arange(0, rows, max(stride, 1)), rows - 1))


def _flight(packing: Packing, flight: Replayed) -> dict[str, Any]:
    record, scenario, chaser = flight.shown, flight.scenario, flight.scenario.chaser
    clearance, closest = flight.clearance, flight.nearest[1]
    error = np.full(len(clearance), np.nan) if flight.error is None else flight.error
    rows, least = rows_shown(len(record.time)), flight.verdict.minimum_clearance
    legs = approach_drawn.leg_labels(scenario, record)
    remark = ""
    if len(rows) < len(record.time):
        remark = f"Path and plots are drawn with {len(rows):,} of the flight's {len(record.time):,} rows"
        remark += "; verdict, marks and lower bound are of all."
    return {
        "name": flight.name,
        "rows": len(rows),
        "remark": remark,
        "radius": chaser.radius,
        "force_limit": chaser.force_limit,
        "speed_limit": chaser.speed_limit,
        "margin": scenario.safety.margin,
        "goal": np.asarray(scenario.goal.position).tolist(),
        "tolerance": scenario.goal.tolerance,
        "turns": scenario.attitude.kind,
        "guarded": scenario.guard.enabled,
        "contact": str(flight.verdict.contact),
        "least_clearance": float(least) if np.isfinite(least) else None,
        "remarks": list(flight.verdict.remarks),
        "marks": [asdict(mark) for mark in marks(record, clearance, error, scenario.goal.tolerance, legs)],
        "arrays": _arrays(packing, flight, rows, {"clearance": clearance, "error": error, "closest": closest}),
    }


def _arrays(packing: Packing, flight: Replayed, rows: Int[np.ndarray, "shown"], found: dict[str, np.ndarray]) -> Any:
    """Pack the columns of a flight at the rows that are drawn: as they are, or in even steps."""
    record, scenario = flight.shown, flight.scenario
    exact = {
        **found,
        "time": record.time - record.time[0],
        "speed": np.linalg.norm(record.velocity, axis=1),
        "force": np.linalg.norm(record.force, axis=1),
        "barrier": record.barrier,
        "position": record.position,
    }
    if flight.share is not None:
        exact["seen"] = flight.share
    if record.leg is not None:
        exact["within"] = approach_drawn.places(scenario, record)[1]
    if scenario.approach.speed_by_distance:
        exact["allowed"] = allowed_speed(scenario, record.position, found["clearance"])
    steps = {"applied_force": record.force, "safe_velocity": record.safe_velocity}
    if scenario.sun != SunEntry():
        steps["sun"] = toward_sun(record, scenario)
    steps = {name: np.nan_to_num(array) for name, array in steps.items()}
    steps |= {"to_vvlh": to_vvlh(record), "to_inertial": to_inertial(record, scenario)}
    # Of the steps between two rows that are drawn the least bound counts; the last row begins no step.
    bound = np.minimum.reduceat(np.append(flight.proved, np.nan), rows)
    return {
        **{name: packing.exact(array[rows]) for name, array in exact.items()},
        "bound": packing.exact(bound),
        **{name: packing.steps(array[rows]) for name, array in steps.items()},
        "guard": packing.exact(record.guard_status[rows], "int32"),
        "law": packing.exact(record.control_status[rows], "int32"),
    }


def to_vvlh(record: FlightRecord) -> Quaternions:
    """Rotations VVLH ← body as unit quaternions, scalar first, each on the side of the one before."""
    return without_jumps(Rotation.from_quat(record.attitude, scalar_first=True).inv().as_quat(scalar_first=True))


def to_inertial(record: FlightRecord, scenario: Scenario) -> Quaternions:
    """Rotations ECI ← body as unit quaternions, scalar first: by the recorded orbit, or the scenario's Kepler orbit."""
    if record.target_orbit is None:
        orbit = jax.tree.map(np.asarray, orbit_of(scenario.orbit))
        axes = np.asarray(_on_ellipse(orbit, record.time))
    else:
        axes = np.asarray(_on_states(record.target_orbit))
    body_from_vvlh = Rotation.from_quat(record.attitude, scalar_first=True)
    return without_jumps((body_from_vvlh * Rotation.from_matrix(axes)).inv().as_quat(scalar_first=True))


def toward_sun(record: FlightRecord, scenario: Scenario) -> Float[np.ndarray, "rows 3"]:
    """Give unit vectors to the scenario's sun, in body axes."""
    inertial_from_body = Rotation.from_quat(to_inertial(record, scenario), scalar_first=True)
    return inertial_from_body.inv().apply(np.asarray(sun_of(scenario)))


@jax.jit
def _on_ellipse(orbit: Orbit, times: Float[Array, "rows"]) -> Float[Array, "rows 3 3"]:
    return jax.vmap(lambda time: vvlh_axes(*orbit.inertial_state(time)))(times)


@jax.jit
def _on_states(states: Float[Array, "rows 6"]) -> Float[Array, "rows 3 3"]:
    return jax.vmap(lambda state: vvlh_axes(state[:3], state[3:]))(states)


@dataclass(frozen=True)
class Mark:
    """A time, or a span of time, s from the flight's start; `times` says how many runs were joined into it."""

    kind: str
    words: str
    start: float
    end: float
    times: int = 1


def marks(
    record: FlightRecord,
    clearance: Float[np.ndarray, "rows"],
    error: Float[np.ndarray, "rows"],
    tolerance: float,
    legs: Sequence[str] = (),
) -> list[Mark]:
    """Find the marks of a flight, in order of time.

    Args:
        record: the flight; what was done in its last row was not flown.
        clearance: m.
        error: distance to the goal, or to the place of the leg under way, m.
        tolerance: within which the goal is reached, m.
        legs: their names, where the flight has legs; the last one leads to the goal.

    """
    time = record.time - record.time[0]
    guard, law = record.guard_status[:-1], record.control_status[:-1]
    action = guard & int(GuardStatus.ESCAPING)
    found: list[Mark] = []
    for status in GuardStatus:
        if status is not GuardStatus.CLEAR:
            found += _spans("guard", f"guard: {_said(status.name)}", action == status, time)
    for flag in GuardFlag:
        [name] = flag_names(flag)
        found += _spans("flag", f"flag: {_said(name)}", (guard & flag) != 0, time)
    for status in ControlStatus:
        if status != 0:
            found += _spans("law", f"law: {_said(status.name)}", law == status, time)
    leg = np.zeros(len(time), int) if record.leg is None else record.leg
    for number, name in enumerate(legs):
        found += _spans("leg", name, leg[:-1] == number, time)
    if np.isfinite(clearance).any():
        nearest = int(np.nanargmin(clearance))
        found.append(Mark("nearest", "least clearance", float(time[nearest]), float(time[nearest])))
    away = np.flatnonzero(~((error < tolerance) & (leg == max(len(legs) - 1, 0))))
    arrived = int(away[-1]) + 1 if len(away) else 0
    if arrived < len(time):
        found.append(Mark("reached", "goal reached, to stay", float(time[arrived]), float(time[arrived])))
    return sorted(found, key=lambda mark: (mark.start, mark.end))


def _spans(kind: str, words: str, spoke: Bool[np.ndarray, "steps"], time: Float[np.ndarray, "rows"]) -> list[Mark]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], spoke, [False]]).astype(np.int8)))
    joined: list[Mark] = []
    for first, after in edges.reshape(-1, 2):
        start, end = float(time[first]), float(time[after])
        if joined and start - joined[-1].end < float(time[-1]) / _JOINED:
            joined[-1] = Mark(kind, words, joined[-1].start, end, joined[-1].times + 1)
        else:
            joined.append(Mark(kind, words, start, end))
    return joined


def _said(name: str) -> str:
    return name.lower().replace("_", " ")
