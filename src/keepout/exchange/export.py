"""The command `keepout export`: which formats there are for a flight and a field, and what each of them writes."""

import json
from pathlib import Path
from typing import Any

from keepout.errors import ExchangeError
from keepout.exchange.inertial import inertial_flight
from keepout.exchange.messages_of_flight import export_attitude, export_orbit
from keepout.fields.model import FieldModel
from keepout.flight.record import FlightRecord
from keepout.mission.scenario import Scenario
from keepout.progress import Progress, silent

FLIGHT_FORMATS = ("oem", "aem", "czml", "csv", "parquet", "npz", "glb")
FIELD_FORMATS = ("onnx", "glb")
CRAFT = ("chaser", "target")
_FLIGHT_ENDINGS = (".parquet", ".npz")


def export_file(
    source: Path,
    to: str,
    out: Path,
    *,
    craft: str | None = None,
    xml: bool = False,
    chaser_radius: float | None = None,
    mesh: str | None = None,
    seed: int = 0,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Write a flight file or a field file in another program's format; the answer is plain JSON values.

    Args:
        source: a flight file (`.parquet`, `.npz`) or a field file (`.keepout`).
        to: the format, one of `FLIGHT_FORMATS` or `FIELD_FORMATS`.
        out: the file to write.
        craft: of an OEM: "chaser", as if absent, or "target".
        xml: OEM and AEM as XML; so they are too where `out` ends in `.xml`.
        chaser_radius: of a field: the one whose certificate is meant, m; as needed where there are several.
        mesh: where the target's mesh is, if not where the flight or the field says.
        seed: of the points at which an ONNX file is measured.
        progress: called as the work goes on.

    Raises:
        KeepoutError: a file cannot be read or written, or an option does not go with the format; the message names it.

    """
    field = source.suffix == ".keepout"
    valid = FIELD_FORMATS if field else FLIGHT_FORMATS
    if not field and source.suffix.lower() not in _FLIGHT_ENDINGS:
        raise ExchangeError(f"{source}: a flight file ends in .parquet or .npz, a field file in .keepout")
    if to not in valid:
        raise ExchangeError(f"--to {to}: valid for a {'field' if field else 'flight'}: {', '.join(valid)}")
    _refuse_unused("--of", craft is not None, to in ("oem",), "oem")
    _refuse_unused("--xml", xml, to in ("oem", "aem"), "oem and aem")
    _refuse_unused("--chaser-radius", chaser_radius is not None, field, "a field")
    _refuse_unused("--mesh", mesh is not None, to == "glb", "glb")
    if craft is not None and craft not in CRAFT:
        raise ExchangeError(f"--of {craft}: valid: {', '.join(CRAFT)}")
    if not out.absolute().parent.is_dir():
        raise ExchangeError(f"{out}: the folder {out.parent} does not exist")
    xml = xml or out.suffix.lower() == ".xml"
    progress(0.0, "reading")
    if field:
        written = _export_field(FieldModel.load(source), to, out, chaser_radius, mesh, seed, progress)
    else:
        written = _export_flight(source, to, out, craft or "chaser", xml, mesh, progress)
    progress(1.0, "")
    return {"source": str(source), "to": to, "file": str(out), **written}


def _refuse_unused(option: str, given: bool, used: bool, of: str) -> None:
    if given and not used:
        raise ExchangeError(f"{option}: only for {of}")


def _export_flight(
    source: Path, to: str, out: Path, craft: str, xml: bool, mesh: str | None, progress: Progress
) -> dict[str, Any]:
    record = FlightRecord.load(source)
    scenario = _scenario(source, record)
    match to:
        case "oem":
            return export_orbit(inertial_flight(record, scenario), scenario.name, out, craft=craft, xml=xml)  # pyright: ignore[reportArgumentType]
        case "aem":
            return export_attitude(inertial_flight(record, scenario), scenario.name, out, xml=xml)
    raise AssertionError(to)


def _scenario(source: Path, record: FlightRecord) -> Scenario:
    text = record.header.get("scenario")
    if not text:
        raise ExchangeError(f"{source}: its header has no scenario, so no orbit; a flight of `keepout fly` has one")
    return Scenario.parse(json.loads(text), where=str(source))


def _export_field(
    model: FieldModel,
    to: str,
    out: Path,
    chaser_radius: float | None,
    mesh: str | None,
    seed: int,
    progress: Progress,
) -> dict[str, Any]:
    raise AssertionError(to)
