"""Commands on files of others: export, audit."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from keepout.cli.options import (
    AsJson,
    Seed,
    Units,
    answer,
    app,
    example,
    from_zero,
    mission_of,
    recorded_target,
    require_file,
    target_entry,
    usage,
)
from keepout.core.errors import ExchangeError, UsageError
from keepout.flights.pages import terminal

if TYPE_CHECKING:
    from keepout.core.mission.entries import TargetEntry

_NineNumbers = tuple[float, float, float, float, float, float, float, float, float]


@app.command(
    epilog=example(
        "keepout export out/case1/case1.parquet --to oem -o chaser.oem",
        "keepout export satellite.keepout --to onnx -o satellite.onnx",
    )
)
def export(
    source: Annotated[Path, typer.Argument(help="A flight file (.parquet, .npz) or a field file (.keepout).")],
    to: Annotated[
        str, typer.Option(help="Of a flight: oem, aem, czml, csv, parquet, npz, glb; of a field: onnx, glb.")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="The file to write.")],
    craft: Annotated[str | None, typer.Option("--of", help="oem: chaser (if not given) or target.")] = None,
    xml: Annotated[bool, typer.Option("--xml", help="oem, aem: as XML; a file that ends in .xml is anyway.")] = False,
    chaser_radius: Annotated[
        float | None, from_zero("Of a field with several certificates: the one that is meant, m.")
    ] = None,
    mesh: Annotated[str | None, typer.Option(help="glb: the mesh, where it is not where flight or field say.")] = None,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Write a flight or a field for other programs, with its epoch, frames and units stated (docs/export.md)."""
    from keepout.flights.exchange.export import check_export, export_field, export_flight

    given = {"--of": craft is not None, "--xml": xml, "--mesh": mesh is not None}
    with usage():
        check_export(source, to, craft=craft, given=given | {"--chaser-radius": chaser_radius is not None})
    require_file(out, "", "", refusal=ExchangeError)
    with terminal.progress(f"export {source.name}") as progress:
        chosen: dict[str, Any] = {"progress": progress}
        if source.suffix == ".keepout":
            from keepout.core.fields.model import FieldModel
            from keepout.core.mission.target import load_target

            model = FieldModel.load(source)
            target = load_target(recorded_target(source, model, mesh)) if to == "glb" else None
            written = export_field(model, to, out, target=target, chaser_radius=chaser_radius, seed=seed, **chosen)  # pyright: ignore[reportArgumentType]
        else:
            xml = xml or out.suffix.lower() == ".xml"
            written = export_flight(source, to, out, craft=craft or "chaser", xml=xml, mesh=mesh, **chosen)  # pyright: ignore[reportArgumentType]
        progress(1.0, "")
    summary = {"source": str(source), "to": to, "file": str(out), **written}
    answer(summary, as_json, terminal.facts_table("Export", summary))


@app.command(
    epilog=example(
        "keepout audit --target satellite.glb --target-units m --chaser chaser.oem --target-orbit target.oem "
        "--target-attitude target.aem --chaser-radius 0.5 --acceleration-bound 0.01"
    )
)
def audit(
    target: Annotated[
        str,
        typer.Option(
            help="The target's mesh file, a built-in target's name, or a scenario file (.toml), whose [target] it is."
        ),
    ],
    chaser: Annotated[Path, typer.Option(help="OEM of the chaser's centre.")],
    target_orbit: Annotated[Path, typer.Option(help="OEM of the target's centre of mass.")],
    chaser_radius: Annotated[float, from_zero("Radius of the ball that holds the chaser, m.")],
    acceleration_bound: Annotated[
        float, from_zero("Of the chaser relative to the target in inertial axes, thrust and all else together, m/s².")
    ],
    target_attitude: Annotated[Path | None, typer.Option(help="AEM of the target.")] = None,
    target_fixed_in: Annotated[
        str | None, typer.Option(help="Without an AEM: the axes that the body's are, vvlh (if not given) or inertial.")
    ] = None,
    turning_acceleration_bound: Annotated[
        float | None, from_zero("Of the target, rad/s²; if not given, measured from the attitudes.")
    ] = None,
    centre_of_mass: Annotated[
        tuple[float, float, float] | None,
        typer.Option(help="Of the target, in body axes, m; if not given, the scenario's, or 0 0 0."),
    ] = None,
    chaser_object: Annotated[
        str | None, typer.Option(help="OBJECT_NAME or OBJECT_ID that the chaser's OEM must have.")
    ] = None,
    target_object: Annotated[
        str | None, typer.Option(help="OBJECT_NAME or OBJECT_ID that the target's OEM must have.")
    ] = None,
    attitude_object: Annotated[
        str | None, typer.Option(help="What the AEM calls the target, if not as the target's OEM does.")
    ] = None,
    attitude_frame: Annotated[
        str | None, typer.Option(help="What the AEM calls the body's frame, if not SC_BODY or SC_BODY_1.")
    ] = None,
    sample_error: Annotated[
        float, from_zero("How far a relative position in the files can be wrong, m, if more than by its digits.")
    ] = 1e-6,
    attitude_error: Annotated[
        float, from_zero("By what angle an attitude can be wrong, rad, if more than by its digits.")
    ] = 0.0,
    target_units: Units = None,
    target_scale: Annotated[
        float | None, typer.Option(help="Metres per unit of a mesh file, instead of units.")
    ] = None,
    target_drop_stray: Annotated[
        bool, typer.Option("--target-drop-stray", help="Leave out parts far from the rest.")
    ] = False,
    target_thickness: Annotated[
        float | None, typer.Option(help="Of a point cloud: each point is a ball this wide, m.")
    ] = None,
    target_rotation: Annotated[
        _NineNumbers | None,
        typer.Option(help="From file axes to body axes: a rotation matrix, row by row.", metavar="NINE NUMBERS"),
    ] = None,
    target_origin: Annotated[
        tuple[float, float, float] | None, typer.Option(help="Of the body frame, in file axes, m.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Bound the clearance of any flight, between its samples too, on the exact mesh: from OEM and AEM files.

    Exit code 0 whatever the verdict is: it is in the answer.
    """
    from keepout.core.mission.target import load_target
    from keepout.flights.exchange.audited import Given, audit_files

    rows = None if target_rotation is None else (target_rotation[:3], target_rotation[3:6], target_rotation[6:])
    placed = {
        "units": target_units,
        "scale": target_scale,
        "drop_stray": target_drop_stray or None,
        "thickness": target_thickness,
        "rotation": rows,
        "origin": target_origin,
    }
    with terminal.progress("audit") as progress:
        if target_fixed_in not in (None, "vvlh", "inertial"):
            raise UsageError(f"--target-fixed-in {target_fixed_in}: valid: vvlh, inertial")
        entry = _audited_target(target, placed)
        if centre_of_mass is None and "centre_of_mass" in entry.model_fields_set:
            centre_of_mass = entry.centre_of_mass
        given = Given(
            chaser=chaser,
            target_orbit=target_orbit,
            chaser_radius=chaser_radius,
            acceleration_bound=acceleration_bound,
            target_attitude=target_attitude,
            fixed_in=target_fixed_in,
            turning_acceleration_bound=turning_acceleration_bound,
            centre_of_mass=centre_of_mass,
            chaser_object=chaser_object,
            target_object=target_object,
            attitude_object=attitude_object,
            attitude_frame=attitude_frame,
            sample_error=sample_error,
            attitude_error=attitude_error,
        )
        summary = audit_files(load_target(entry), given, progress=progress)
    told = {key: value for key, value in summary.items() if key != "assumptions"}
    assumed = terminal.facts_table("It assumes", summary["assumptions"])
    answer(summary, as_json, terminal.facts_table("Audit", told), assumed)


def _audited_target(target: str, placed: Mapping[str, Any]) -> "TargetEntry":
    if not target.lower().endswith(".toml"):
        return target_entry({"source": target, **placed}, options="--target-")
    given = next((name for name, value in placed.items() if value is not None), None)
    if given is not None:
        name = f"--target-{given.replace('_', '-')}"
        raise UsageError(f"{name}: not with the scenario {target}, whose [target] says how its mesh lies")
    return mission_of(Path(target), None).target
