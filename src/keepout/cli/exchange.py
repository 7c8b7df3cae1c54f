"""Commands on files of others: export, audit."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from keepout.cli.options import AsJson, Seed, Units, answer, app, at_least, example
from keepout.flights.pages import terminal

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
        float | None,
        typer.Option(callback=at_least(0.0), help="Of a field with several certificates: the one that is meant, m."),
    ] = None,
    mesh: Annotated[str | None, typer.Option(help="glb: the mesh, where it is not where flight or field say.")] = None,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Write a flight or a field for other programs, with its epoch, frames and units stated (docs/export.md)."""
    from keepout.cli.commands.exchange import export_to_file

    with terminal.progress(f"export {source.name}") as progress:
        summary = export_to_file(
            source,
            to,
            out,
            craft=craft,
            xml=xml,
            chaser_radius=chaser_radius,
            mesh=mesh,
            seed=seed,
            progress=progress,
        )
    answer(summary, as_json)
    if not as_json:
        Console().print(terminal.facts_table("Export", summary))


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
    chaser_radius: Annotated[
        float, typer.Option(callback=at_least(0.0), help="Radius of the ball that holds the chaser, m.")
    ],
    acceleration_bound: Annotated[
        float,
        typer.Option(
            callback=at_least(0.0),
            help="Of the chaser relative to the target in inertial axes, thrust and all else together, m/s².",
        ),
    ],
    target_attitude: Annotated[Path | None, typer.Option(help="AEM of the target.")] = None,
    target_fixed_in: Annotated[
        str | None, typer.Option(help="Without an AEM: the axes that the body's are, vvlh (if not given) or inertial.")
    ] = None,
    turning_acceleration_bound: Annotated[
        float | None,
        typer.Option(callback=at_least(0.0), help="Of the target, rad/s²; if not given, measured from the attitudes."),
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
        float,
        typer.Option(
            callback=at_least(0.0),
            help="How far a relative position in the files can be wrong, m, if more than by its digits.",
        ),
    ] = 1e-6,
    attitude_error: Annotated[
        float,
        typer.Option(
            callback=at_least(0.0), help="By what angle an attitude can be wrong, rad, if more than by its digits."
        ),
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
    from keepout.cli.commands.exchange import audit_of_files

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
        summary = audit_of_files(
            target,
            placed=placed,
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
            progress=progress,
        )
    answer(summary, as_json)
    if not as_json:
        told = {key: value for key, value in summary.items() if key != "assumptions"}
        Console().print(terminal.facts_table("Audit", told))
        Console().print(terminal.facts_table("It assumes", summary["assumptions"]))
