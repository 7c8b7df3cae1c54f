"""Which formats there are for a flight and for a field, and what each of them writes.

Binary glTF (GLB) is written here: mesh, envelope and path in metres and in the body frame, as the scene's `extras` say.
The envelope is the surface {f̃ = R + e_h}: wherever the exact distance is at most the chaser's radius R, f̃ is not
above that level, so the centre of a chaser outside it touches nothing. It is cut into triangles to be looked at, at a
spacing that `extras` tell; the proof is of the field, not of the triangles. Coordinates are float32, and the body
frame's axes stay what they are: glTF's viewers show its y axis upwards.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Float

from keepout.core.errors import ExchangeError
from keepout.core.fields.model import Certificate, FieldModel
from keepout.core.flight.record import FlightRecord
from keepout.core.geometry.target import Target
from keepout.core.mission.build import load_model, load_target
from keepout.core.mission.flight import Flight
from keepout.core.mission.scenario import Scenario
from keepout.core.progress import Progress, silent
from keepout.core.whole_file import require_place, write_whole
from keepout.flights.exchange import flight_files
from keepout.flights.exchange.flight_files import Craft, inertial_flight
from keepout.flights.pages.folder import make_folder

FlightFormat = Literal["oem", "aem", "czml", "csv", "parquet", "npz", "glb"]
FieldFormat = Literal["onnx", "glb"]


@dataclass(frozen=True)
class Export:
    """What is to be written of a flight or a field.

    Attributes:
        to: the format, a `FlightFormat` or a `FieldFormat`.
        craft: of an OEM: whose orbit, a `Craft`; the chaser's if absent.
        xml: OEM and AEM as XML; a file that ends in .xml is anyway.
        chaser_radius: of a field: the one whose certificate the file tells, m; needed where there are several.
        mesh: of a GLB: where the target's mesh is, if not where flight or field say.

    """

    to: str
    craft: str | None = None
    xml: bool = False
    chaser_radius: float | None = None
    mesh: str | None = None

    def check(self, source: Path) -> None:
        """Refuse what cannot be exported of a flight or field file before anything is read.

        Raises:
            ExchangeError: a file's ending, a format, or an option that does not go with it.

        """
        field, to = source.suffix == ".keepout", self.to
        if not field and source.suffix.lower() not in (".parquet", ".npz"):
            raise ExchangeError(f"{source}: a flight file ends in .parquet or .npz, a field file in .keepout")
        valid = get_args(FieldFormat if field else FlightFormat)
        if to not in valid:
            raise ExchangeError(f"--to {to}: valid for a {'field' if field else 'flight'}: {', '.join(valid)}")
        uses = {"of": (self.craft, ("oem",)), "xml": (self.xml or None, ("oem", "aem")), "mesh": (self.mesh, ("glb",))}
        for option, (given, formats) in uses.items():
            if given is not None and to not in formats:
                raise ExchangeError(f"--{option}: only for --to {' and --to '.join(formats)}, not --to {to}")
        if self.chaser_radius is not None and not field:
            raise ExchangeError("--chaser-radius: only for a field; a flight's is its scenario's")
        if self.craft not in (None, *get_args(Craft)):
            raise ExchangeError(f"--of {self.craft}: valid: {', '.join(get_args(Craft))}")


def export_flight(source: Path, wanted: Export, out: Path, *, progress: Progress = silent) -> dict[str, Any]:
    """Write a flight file of `keepout fly`, whose header holds the scenario; the answer is plain JSON values.

    Args:
        source: the flight file.
        wanted: of it.
        out: the file to write.
        progress: called as the work goes on.

    Raises:
        KeepoutError: a file cannot be read or written; the message names it.

    """
    record = FlightRecord.load(source)
    text = record.header.get("scenario")
    if not text:
        raise ExchangeError(f"{source}: its header has no scenario, so no orbit; a flight of `keepout fly` has one")
    scenario = Scenario.parse(json.loads(text), where=str(source))
    return _export(record, scenario, wanted, out, lambda: _around(source, record, scenario, wanted.mesh), progress)


def export_to(flight: Flight, to: str, where: Path, **wanted: Any) -> list[Path]:
    """Write a flight that is in memory: into a folder, or one file.

    Args:
        flight: to write.
        to: a `FlightFormat`.
        where: a folder, or a file by its ending.
        **wanted: more of `Export`.

    Raises:
        KeepoutError: what cannot be written; the message names it.

    """
    chosen, name, mission = Export(to, **wanted), flight.scenario.name, flight.mission
    chosen.check(Path(f"{name}.parquet"))

    def around() -> _Around:
        if mission is not None:
            return flight.target, mission.model
        return _around(name, flight.record, flight.scenario, chosen.mesh)

    if where.suffix:
        written = {where: chosen}
    else:
        make_folder(where)
        crafts = [chosen.craft] if chosen.craft else get_args(Craft)
        written = {where / ("target.aem" if to == "aem" else f"{name}.{to}"): chosen}
        if to == "oem":
            written = {where / f"{craft}.oem": replace(chosen, craft=craft) for craft in crafts}
    for file, what in written.items():
        require_place(file, refusal=ExchangeError)
        _export(flight.record, flight.scenario, what, file, around, silent)
    return list(written)


_Around = tuple[Target, FieldModel]
"""What a flight was flown around, and the field that it was flown by."""


def _export(
    record: FlightRecord,
    scenario: Scenario,
    wanted: Export,
    out: Path,
    around: Callable[[], _Around],
    progress: Progress,
) -> dict[str, Any]:
    if wanted.to == "glb":
        target, model = around()
        told = {"scenario": scenario.name, "epoch": scenario.epoch, "path_seconds": float(record.time[-1])}
        flown = {"way": record.position, "told": told, "certificate": model.certificate(scenario.chaser.radius)}
        return export_scene(target, out, model=model, **flown, progress=progress)
    if wanted.to not in ("oem", "aem", "czml"):
        return flight_files.export_table(record, scenario, out, to=wanted.to)
    flight, xml = inertial_flight(record, scenario), wanted.xml or out.suffix.lower() == ".xml"
    if wanted.to == "oem":
        return flight_files.export_orbit(flight, scenario.name, out, craft=wanted.craft or "chaser", xml=xml)
    if wanted.to == "aem":
        return flight_files.export_attitude(flight, scenario.name, scenario.target, out, xml=xml)
    return flight_files.export_czml(flight, scenario, out)


def _around(source: Path | str, record: FlightRecord, scenario: Scenario, mesh: str | None) -> _Around:
    """Load what a recorded flight was flown around and by."""
    entry = scenario.target if mesh is None else scenario.target.model_copy(update={"source": mesh})
    target = load_target(entry)
    flown = record.header.get("target_sha256")
    if flown and flown != target.sha256:
        raise ExchangeError(
            f"{source}: was flown around another mesh ({flown[:12]}) than {entry.source} ({target.sha256[:12]}); name "
            "the one it was flown around with --mesh"
        )
    return target, load_model(scenario, target)


def export_field(
    model: FieldModel, wanted: Export, out: Path, *, target: Target | None, seed: int = 0, progress: Progress = silent
) -> dict[str, Any]:
    """Write a field; the answer is plain JSON values.

    Args:
        model: the field.
        wanted: of it.
        out: the file to write.
        target: the mesh the field was made for, needed by "glb".
        seed: of the points at which an ONNX file is measured.
        progress: called as the work goes on.

    Raises:
        KeepoutError: there is no such certificate, or the file cannot be written.

    """
    certificate = _certificate(model, wanted.chaser_radius)
    if wanted.to == "onnx":
        try:
            from keepout.flights.exchange.onnx_field import export_onnx
        except ModuleNotFoundError as error:
            if error.name != "onnx":
                raise
            raise ExchangeError("--to onnx: is written with onnx; pip install 'keepout-gnc[export]'") from None
        return export_onnx(model, out, certificate=certificate, seed=seed, progress=progress)
    assert target is not None, "a scene has a target"
    model.require_target(target, where="--mesh")
    return export_scene(target, out, model=model, certificate=certificate, progress=progress)


def _certificate(model: FieldModel, chaser_radius: float | None) -> Certificate | None:
    if chaser_radius is not None:
        return model.certificate(chaser_radius)
    if len(model.certificates) > 1:
        have = ", ".join(f"{c.chaser_radius:g}" for c in model.certificates)
        raise ExchangeError(f"--chaser-radius: the field has certificates for {have} m; name one of them")
    return model.certificates[0] if model.certificates else None


_COARSENESS = 3.0
"""Of the envelope, in units of the spacing with which surfaces are measured: a tenth of the triangles."""


def export_scene(
    target: Target,
    path: Path,
    *,
    model: FieldModel,
    certificate: Certificate | None,
    way: Float[np.ndarray, "n 3"] | None = None,
    told: dict[str, Any] | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Write a GLB file; its summary says what stands in it.

    Args:
        target: the mesh.
        path: the file.
        model: the field whose envelope is drawn.
        certificate: gives the level of the envelope; the zero level is drawn where there is none.
        way: positions of the chaser's centre in the body frame, m.
        told: further entries of the scene's extras.
        progress: called as the envelope is cut.

    Raises:
        ExchangeError: the file cannot be written.

    """
    import trimesh  # takes long with the rest: only where a scene is written
    from trimesh.visual.material import PBRMaterial
    from trimesh.visual.texture import TextureVisuals

    from keepout.flights.surface import default_spacing, extract_surface, steepest_slope

    level = 0.0 if certificate is None else certificate.chaser_radius + certificate.error_bound
    steepest = steepest_slope(model.field, target.distance) if certificate is None else certificate.gradient_bound
    spacing = _COARSENESS * default_spacing(target.distance)
    surface = extract_surface(
        model.field, target.distance, level, steepest=steepest, spacing=spacing, progress=progress
    )
    scene = trimesh.Scene()

    def add(name: str, vertices: np.ndarray, faces: np.ndarray, **material: Any) -> None:
        look = TextureVisuals(material=PBRMaterial(**material))
        mesh = trimesh.Trimesh(vertices, faces, process=False, visual=look)
        scene.add_geometry(mesh, geom_name=name, node_name=name)

    proper = target.faces[~(target.faces == target.faces[:, :1]).all(axis=1)]
    if len(proper):
        add("target", target.vertices, proper, baseColorFactor=[190, 195, 205, 255])
    else:  # a point cloud
        scene.add_geometry(trimesh.PointCloud(target.vertices), geom_name="target", node_name="target")
    glass = {"baseColorFactor": [60, 130, 220, 80], "alphaMode": "BLEND", "doubleSided": True}
    add("envelope", surface.vertices, surface.faces, **glass)
    if way is not None:
        scene.add_geometry(trimesh.load_path(way), geom_name="path", node_name="path")
    extras: dict[str, Any] = {
        "format": "keepout-scene 1",
        "units": "m",
        "frame": "the target's body frame; its axes are the file's axes",
        "target_name": target.name,
        "target_sha256": target.sha256,
        "field_sha256": model.sha256,
        "envelope_level_m": level,
        "envelope_spacing_m": surface.spacing,
        "envelope_kind": "zero level" if certificate is None else certificate.kind,
        **({} if certificate is None else {"chaser_radius_m": certificate.chaser_radius}),
        **(told or {}),
    }
    scene.metadata["keepout"] = extras
    content = scene.export(file_type="glb")
    assert isinstance(content, bytes)
    write_whole(path, content, refusal=ExchangeError)
    drawn = {"target_triangles": len(proper), "envelope_triangles": len(surface.faces)}
    return {**extras, **drawn, "path_points": 0 if way is None else len(way)}
