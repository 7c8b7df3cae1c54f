"""A recorded flight as CCSDS messages: the orbit of chaser or target, and the attitude of the target."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal

from keepout.core.mission.entries import TargetEntry
from keepout.core.mission.epoch import format_instant
from keepout.flights.exchange.attitude_message import Attitude, write_aem
from keepout.flights.exchange.inertial import CENTRE, FRAME, TIME_SYSTEM, InertialFlight
from keepout.flights.exchange.orbit_message import Orbit, write_oem

Craft = Literal["chaser", "target"]
BODY = "SC_BODY_1"
"""Name of the target's body frame in an attitude message."""


def export_orbit(flight: InertialFlight, scenario: str, path: Path, *, craft: Craft, xml: bool) -> dict[str, Any]:
    """Write the orbit of chaser or target as an OEM; its summary says what stands in it."""
    chaser = craft == "chaser"
    orbit = Orbit(
        path,
        f"KEEPOUT-{craft.upper()}",
        CENTRE,
        FRAME,
        TIME_SYSTEM,
        flight.epochs,
        flight.chaser_position if chaser else flight.target_position,
        flight.chaser_velocity if chaser else flight.target_velocity,
    )
    of = "the chaser's centre" if chaser else "the target's centre of mass"
    write_oem(orbit, comments=_comments(flight, scenario, f"States of {of}."), xml=xml)
    return {"craft": craft, "frame": FRAME, "centre": CENTRE, **_span(flight)}


def export_attitude(
    flight: InertialFlight, scenario: str, mesh: TargetEntry, path: Path, *, xml: bool
) -> dict[str, Any]:
    """Write the target's attitude as an AEM; its summary says what stands in it."""
    attitude = Attitude(path, "KEEPOUT-TARGET", FRAME, BODY, TIME_SYSTEM, flight.epochs, flight.quaternion)
    said = f"{BODY} is the target's body frame, in which its mesh is given."
    if mesh.rotation is not None or mesh.origin is not None:
        said = f"{BODY} is the target's body frame: a point of its mesh file, in m, is at rotation (point - origin)."
    write_aem(attitude, centre=CENTRE, comments=[*_comments(flight, scenario, said), *_placed(mesh)], xml=xml)
    return {"craft": "target", "frame_a": FRAME, "frame_b": BODY, **_span(flight)}


def _comments(flight: InertialFlight, scenario: str, said: str) -> list[str]:
    centre = _numbers(flight.centre_of_mass)
    return [f"Scenario {scenario}. {said}", f"Centre of mass in the target's body frame: {centre} m."]


def _placed(mesh: TargetEntry) -> list[str]:
    """Say how a mesh file lies in the body frame; a line each, as a line of a message is no longer than 254 letters."""
    rows = [f"Rotation, row {k + 1}: {_numbers(row)}." for k, row in enumerate(mesh.rotation or ())]
    return rows if mesh.origin is None else [*rows, f"Origin in file axes: {_numbers(mesh.origin)} m."]


def _numbers(numbers: Iterable[float]) -> str:
    return " ".join(f"{number:.17g}" for number in numbers)


def _span(flight: InertialFlight) -> dict[str, Any]:
    return {
        "time_system": TIME_SYSTEM,
        "start_time": format_instant(int(flight.epochs[0])),
        "stop_time": format_instant(int(flight.epochs[-1])),
        "rows": len(flight.epochs),
    }
