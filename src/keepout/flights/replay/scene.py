"""What a replay's page holds: one target, its surfaces, and flights around it, as JSON with references into its bytes.

Positions are metres in the target's body frame; times s from a flight's start.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Int

from keepout.core.errors import FlightError
from keepout.core.mission.entries import SunEntry
from keepout.core.progress import Progress, part_of, silent
from keepout.flights.replay import frames
from keepout.flights.replay.body import drawn_body
from keepout.flights.replay.flights import Level, Replayed
from keepout.flights.replay.marks import marks
from keepout.flights.replay.packing import Packing
from keepout.flights.replay.surfaces import drawn_surface

FORMAT = 1
"""Of the page's data; the viewer refuses another."""
MOST_ROWS = 5000
"""Rows of a flight that are drawn; of a longer one every second, third, … row."""


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
    surfaces: dict[tuple[str, str], int] = {}
    told_surfaces: list[dict[str, Any]] = []
    wanted = {(level.kind, level.identity): level for flight in flights for level in flight.levels}
    for place, (key, level) in enumerate(wanted.items()):
        part = part_of(progress, 0.7 * place / len(wanted), 0.7 * (place + 1) / len(wanted))
        surfaces[key] = len(told_surfaces)
        told_surfaces.append(_surface(packing, level, first, part))
    told_flights = []
    for place, flight in enumerate(flights):
        progress(0.7 + 0.3 * place / len(flights), flight.name)
        shown = [surfaces[level.kind, level.identity] for level in flight.levels]
        told_flights.append(_flight(packing, flight) | {"surfaces": shown})
        if flight.growth is not None:
            told_flights[-1]["growth"] = flight.growth.told(packing, float(flight.record.time[0]))
        if flight.coverage is not None:
            told_flights[-1]["coverage"] = flight.coverage.told(packing, float(flight.record.time[0]))
    told = {"format": FORMAT, "target": _target(packing, first), "surfaces": told_surfaces, "flights": told_flights}
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


def _rows_remark(drawn: int, rows: int) -> str:
    """Say, as a sentence, that not all rows of a flight are drawn; empty where all are."""
    if drawn == rows:
        return ""
    shown = f"Path and plots are drawn with {drawn:,} of the flight's {rows:,} rows"
    return f"{shown}; verdict, marks and lower bound are of all."


def _flight(packing: Packing, flight: Replayed) -> dict[str, Any]:
    record, scenario, chaser = flight.shown, flight.scenario, flight.scenario.chaser
    goal = np.asarray(scenario.goal.position)
    distance, closest, _ = flight.target.distance.closest(record.position)
    clearance = distance - chaser.radius
    error = np.linalg.norm(record.position - goal, axis=1)
    if flight.coverage is not None:
        error = np.full(len(error), np.nan)  # an inspection flies to no goal
    rows = rows_shown(len(record.time))
    # Of the steps between two rows that are drawn the least bound counts; the last row begins no step.
    steps = np.minimum.reduceat(np.append(flight.proved, np.nan), rows)
    speed = np.linalg.norm(record.velocity, axis=1)
    force = np.linalg.norm(record.force, axis=1)
    numbers = {
        "time": record.time - record.time[0],
        "clearance": clearance,
        "speed": speed,
        "force": force,
        "error": error,
        "barrier": record.barrier,
    }
    if flight.coverage is not None:
        numbers["seen"] = flight.coverage.share_at(record.time)
    vectors = {"applied_force": record.force, "safe_velocity": record.safe_velocity}
    turns = {"to_vvlh": frames.to_vvlh(record), "to_inertial": frames.to_inertial(record, scenario)}
    if scenario.sun != SunEntry():
        vectors["sun"] = frames.toward_sun(record, scenario)
    arrays = {name: packing.exact(array[rows]) for name, array in numbers.items()}
    arrays["bound"] = packing.exact(steps)
    arrays["position"] = packing.exact(record.position[rows])
    arrays["closest"] = packing.exact(closest[rows])
    arrays |= {name: packing.steps(np.nan_to_num(array[rows])) for name, array in vectors.items()}
    arrays |= {name: packing.steps(array[rows]) for name, array in turns.items()}
    arrays["guard"] = packing.exact(record.guard_status[rows], "int32")
    arrays["law"] = packing.exact(record.control_status[rows], "int32")
    return {
        "name": flight.name,
        "rows": len(rows),
        "remark": _rows_remark(len(rows), len(record.time)),
        "radius": chaser.radius,
        "force_limit": chaser.force_limit,
        "speed_limit": chaser.speed_limit,
        "margin": scenario.safety.margin,
        "goal": goal.tolist(),
        "tolerance": scenario.goal.tolerance,
        "turns": scenario.attitude.kind,
        "guarded": scenario.guard.enabled,
        "contact": str(flight.verdict.contact),
        "least_clearance": _plain(flight.verdict.minimum_clearance),
        "remarks": list(flight.verdict.remarks),
        "marks": [mark.plain() for mark in marks(record, clearance, error, scenario.goal.tolerance)],
        "arrays": arrays,
    }


def _plain(number: float) -> float | None:
    return float(number) if np.isfinite(number) else None
