"""Verbs on files of flights and fields, and on those of others: replay, report, export, audit."""

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from keepout.core.errors import ExchangeError, UsageError
from keepout.core.fields.model import FieldModel
from keepout.core.flight.record import FlightRecord
from keepout.core.mission.build import Mission
from keepout.core.mission.entries import TargetEntry
from keepout.core.mission.flight import Flight
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.target import load_target
from keepout.core.plug_ins import load, names
from keepout.core.progress import Progress, part_of, silent
from keepout.core.whole_file import require_place
from keepout.flights.exchange.audited import Given, audit_files
from keepout.flights.exchange.export import Export, export_field, export_flight, export_to
from keepout.flights.pages.filmed import film, require_film
from keepout.flights.pages.flight_page import require_page
from keepout.flights.pages.printed import print_report
from keepout.flights.pages.replay_page import write_replay
from keepout.flights.pages.replayed import of_files, of_flights, of_records
from keepout.verbs.meshes import MeshLike, mesh_entry, mesh_of, recorded_target

FlightLike = Flight | FlightRecord | str | Path


def replay(
    flights: FlightLike | Sequence[FlightLike],
    out: str | Path = "replay.html",
    *,
    title: str | None = None,
    video: str | Path | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Write flights around one target as one page to watch them in any browser, offline.

    Args:
        flights: one or several: flights, their records, or flight files (.parquet, .npz).
        out: the page (.html).
        title: of the page; the first flight's name if absent.
        video: also film it (.mp4, .gif, .webp, or .png for pictures in a row), in an installed Chromium.
        progress: called as the work goes on.

    Returns:
        The page's path under `replay`, its size under `bytes`, the names of the flights, and the film under `video`.

    Raises:
        KeepoutError: a file that is no flight, flights around different targets, or a page that cannot be written.

    """
    page, given = Path(out), [flights] if isinstance(flights, FlightLike) else list(flights)
    if not given:
        raise UsageError("replay: no flight is given; at least one is valid")
    require_page(page)
    if video is not None:
        require_film(Path(video))
    end = 1.0 if video is None else 0.3
    paths = [Path(one) for one in given if isinstance(one, str | Path)]
    part = part_of(progress, 0.0, 0.4 * end)
    if len(paths) == len(given):
        gathered = of_files(paths, progress=part)
    else:
        gathered = []
        for place, one in enumerate(given, 1):
            name = str(one) if isinstance(one, str | Path) else f"flight {place}"
            if isinstance(one, Flight):
                gathered += of_flights({name if len(given) > 1 else one.scenario.name: one})
            else:
                record = one if isinstance(one, FlightRecord) else FlightRecord.load(one)
                gathered += of_records({name: record}, progress=part)
    first = gathered[0]
    title = title or f"{first.scenario.name} · {first.target.name}"
    written: dict[str, Any] = {**write_replay(page, gathered, title=title, progress=part_of(progress, 0.4 * end, end))}
    if video is not None:
        written["video"] = str(film(page, Path(video), progress=part_of(progress, end, 1.0)))
    return written


def report(folder: str | Path, out: str | Path | None = None, *, progress: Progress = silent) -> Path:
    """Print a folder of results as a PDF of four sheets: mission, what is proved, what was flown, requirements.

    Args:
        folder: that `keepout fly`, `explore`, `inspect` or `campaign` wrote.
        out: the file (.pdf); `report.pdf` in that folder if absent.
        progress: called as the work goes on.

    Returns:
        The file's path.

    Raises:
        KeepoutError: the folder holds no flight and no campaign, its files cannot be read, or another ending.

    """
    return print_report(Path(folder), None if out is None else Path(out), progress=progress)


def export(
    source: Flight | FieldModel | Scenario | Mission | str | Path,
    to: str,
    out: str | Path,
    *,
    seed: int = 0,
    progress: Progress = silent,
    **wanted: Any,
) -> dict[str, Any]:
    """Write a flight, a field or a mission for other programs, with its epoch, frames and units stated.

    Args:
        source: a `Flight`, a flight file (.parquet, .npz), a field, a field file (.keepout), a mission, or a scenario
            or its file (.toml).
        to: of a flight "oem", "aem", "czml", "csv", "parquet", "npz" or "glb"; of a field "onnx" or "glb"; of a mission
            "c", its flight code.
        out: the file to write; of a `Flight` a folder too, of a mission a folder.
        seed: of the points at which an ONNX file is measured.
        progress: called as the work goes on.
        **wanted: `craft` (of an OEM: "chaser" or "target"), `xml` (OEM, AEM), `chaser_radius` (m; of a field with
            several certificates the one that is meant), `mesh` (GLB: the mesh, where it is elsewhere now).

    Returns:
        The format under `to`, the path under `file` or the paths under `files`, and what stands in it, as plain values.

    Raises:
        KeepoutError: a format that does not go with the source, or a file that cannot be read or written.

    """
    path = Path(out)
    if isinstance(source, Scenario | Mission) or (isinstance(source, str | Path) and Path(source).suffix == ".toml"):
        if to not in names("mission_exports"):
            raise ExchangeError(f"--to {to}: valid for a mission: {', '.join(names('mission_exports'))}")
        if wanted := {name: value for name, value in wanted.items() if value}:
            raise ExchangeError(f"--to {to}: takes no {', '.join(wanted)}")
        return {"to": to, **load("mission_exports", to)(source, path, progress=progress)}
    if isinstance(source, Flight):
        return {"to": to, "files": [str(file) for file in export_to(source, to, path, **wanted)]}
    chosen = Export(to, **wanted)
    chosen.check(Path("field.keepout") if isinstance(source, FieldModel) else Path(source))
    require_place(path, refusal=ExchangeError)
    if isinstance(source, FieldModel) or Path(source).suffix == ".keepout":
        model = source if isinstance(source, FieldModel) else FieldModel.load(source)
        name = model.target_name if isinstance(source, FieldModel) else source
        target = load_target(recorded_target(name, model, chosen.mesh)) if to == "glb" else None
        written = export_field(model, chosen, path, target=target, seed=seed, progress=progress)
    else:
        written = export_flight(Path(source), chosen, path, progress=progress)
    progress(1.0, "")
    return {"to": to, "file": str(path), **written}


def audit(
    chaser: str | Path,
    target_orbit: str | Path,
    *,
    target: MeshLike,
    chaser_radius: float,
    acceleration_bound: float,
    progress: Progress = silent,
    **given: Any,
) -> dict[str, Any]:
    """Bound the clearance of any flight, between its samples too, on the exact mesh: from OEM and AEM files.

    Args:
        chaser: OEM of the chaser's centre.
        target_orbit: OEM of the target's centre of mass.
        target: a `Target`, a built-in target's name or a mesh file; or a scenario, whose target and centre of mass.
        chaser_radius: of the ball that holds the chaser, m.
        acceleration_bound: of the chaser relative to the target in inertial axes, thrust and all else together, m/s².
        progress: called as the work goes on.
        **given: more of `keepout audit`'s options: `target_attitude` (AEM), `target_fixed_in` ("vvlh" or "inertial"),
            `turning_acceleration_bound` (rad/s²), `centre_of_mass` (m, body frame), `sample_error` (m),
            `attitude_error` (rad), `tolerance` (m), and the names `chaser_object`, `target_object`,
            `attitude_object` and `attitude_frame`.

    Returns:
        Plain values: `contact_verdict`, `minimum_clearance_m` (proved), `measured_clearance_m`, assumptions, remarks.

    Raises:
        KeepoutError: a file or a number cannot be used; the message names it.

    """
    known = [field.name for field in fields(Given)]
    for name in given:
        if name not in known:
            raise UsageError(f"audit: {name}: no such option; valid: {', '.join(known)}")
    if given.get("target_attitude") is not None:
        given["target_attitude"] = Path(given["target_attitude"])
    stated = Given(
        chaser=Path(chaser),
        target_orbit=Path(target_orbit),
        chaser_radius=chaser_radius,
        acceleration_bound=acceleration_bound,
        **given,
    )
    if isinstance(target, TargetEntry | Mapping | str | Path) or hasattr(target, "target"):
        entry = mesh_entry(target)  # pyright: ignore[reportArgumentType]
        if stated.centre_of_mass is None and "centre_of_mass" in entry.model_fields_set:
            stated = replace(stated, centre_of_mass=entry.centre_of_mass)
        target = entry
    return audit_files(mesh_of(target)[0], stated, progress=progress)
