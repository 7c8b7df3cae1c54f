"""Commands on meshes and fields: targets, fit, certify, inspect."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from keepout.cli.options import AsJson, ChaserRadius, DropStray, Scale, Seed, Units, answer, app, example
from keepout.report import terminal


@app.command(epilog=example("keepout targets", "keepout targets --pictures out/targets"))
def targets(
    pictures: Annotated[Path | None, typer.Option(help="Also draw each target into this folder.")] = None,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """List the built-in targets: extents, volume, triangles, parameters."""
    from keepout.commands.mesh import describe_targets

    with terminal.progress("targets") as progress:
        rows = describe_targets(pictures=pictures, progress=progress)
    answer({"targets": rows, "seed": seed}, as_json)
    if not as_json:
        Console().print(terminal.targets_table(rows))


@app.command(
    epilog=example(
        "keepout fit satellite.glb --units m -o satellite.keepout",
        "keepout fit satellite.stl --units mm --certify -o satellite.keepout",
        "keepout fit out/explore/map.keepmap --certify -o debris.keepout",
    )
)
def fit(
    mesh: Annotated[str, typer.Argument(help="A mesh file, a map file (.keepmap), or a built-in target's name.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The field file to write (.keepout).")],
    profile: Annotated[
        str,
        typer.Option(
            help="default; quick, rough, for trying out; paper, the source paper's network and loss; "
            "paper_printed, with the loss as printed."
        ),
    ] = "default",
    chaser_radius: ChaserRadius = 0.5,
    certify: Annotated[
        bool, typer.Option("--certify", help="Then prove its error bound for this radius, as `keepout certify` does.")
    ] = False,
    units: Units = None,
    scale: Scale = None,
    drop_stray: DropStray = False,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Learn a target's signed distance, tightest where the chaser touches.

    A killed run resumes from its last checkpoint when started again.
    """
    from keepout.commands.mesh import fit_to_file

    source = {"source": mesh, "units": units, "scale": scale, "drop_stray": drop_stray}
    with terminal.progress(f"fit {mesh}") as progress:
        summary = fit_to_file(
            source, out, profile=profile, chaser_radius=chaser_radius, certified=certify, seed=seed, progress=progress
        )
    answer(summary, as_json)
    if not as_json:
        certificate = summary.pop("certificate", None)
        Console().print(terminal.facts_table("Fit", summary))
        if certificate is not None:
            Console().print(terminal.facts_table("Certificate", certificate))


@app.command(epilog=example("keepout certify satellite.keepout --chaser-radius 0.5"))
def certify(
    field: Annotated[Path, typer.Argument(help="A field file (.keepout); the certificate is added to it.")],
    chaser_radius: ChaserRadius = 0.5,
    prove_slope: Annotated[bool, typer.Option("--prove-slope", help="Prove a bound of ‖∇f̃‖ too: minutes.")] = False,
    mesh: Annotated[str | None, typer.Option(help="The mesh, where it is not where `fit` found it.")] = None,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Bound how far the field can over-state the distance where a chaser of this radius would touch."""
    from keepout.commands.mesh import certify_file

    with terminal.progress(f"certify {field.name}") as progress:
        summary = certify_file(
            field, chaser_radius=chaser_radius, prove_slope=prove_slope, mesh=mesh, seed=seed, progress=progress
        )
    answer(summary, as_json)
    if not as_json:
        Console().print(terminal.facts_table("Certificate", summary))


@app.command(
    epilog=example(
        "keepout inspect satellite.keepout -o out/satellite",
        "keepout inspect satellite.glb",
        "keepout inspect intelsat30 --shipped",
    )
)
def inspect(
    source: Annotated[str, typer.Argument(help="A field file (.keepout), a mesh file, or a built-in target's name.")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Also draw it into this folder.")] = None,
    mesh: Annotated[
        str | None, typer.Option(help="Of a field: the mesh, where it is not where `fit` found it.")
    ] = None,
    shipped: Annotated[
        bool, typer.Option("--shipped", help="Of a built-in target: measure the field that comes with the package.")
    ] = False,
    units: Units = None,
    scale: Scale = None,
    drop_stray: DropStray = False,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Measure a field against its mesh and list its certificates; or report what is wrong with a mesh."""
    from keepout.commands.mesh import inspect_file, inspect_mesh
    from keepout.fields.shipped import shipped_path

    of_field = shipped or source.endswith(".keepout")
    if mesh is not None and not of_field:
        raise typer.BadParameter(f"{mesh}: only a field has a mesh to be named; {source} is not a .keepout file")
    with terminal.progress(f"inspect {source}") as progress:
        if of_field:
            path = shipped_path(source) if shipped else Path(source)
            summary = inspect_file(path, out, mesh=mesh, seed=seed, progress=progress)
            tables = terminal.inspection_tables(summary)
        else:
            given = {"source": source, "units": units, "scale": scale, "drop_stray": drop_stray}
            summary = inspect_mesh(given, out, progress=progress)
            tables = [terminal.facts_table("Mesh", summary)]
    answer(summary, as_json)
    if not as_json:
        for table in tables:
            Console().print(table)
