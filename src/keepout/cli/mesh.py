"""Commands on meshes and fields: targets, describe, fit, certify, measure."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from keepout.cli.options import AsJson, ChaserRadius, DropStray, Scale, Seed, Units, answer, app, example
from keepout.flights.pages import terminal


@app.command(epilog=example("keepout targets", "keepout targets --pictures out/targets"))
def targets(
    pictures: Annotated[Path | None, typer.Option(help="Also draw each target into this folder.")] = None,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """List the built-in targets: extents, volume, triangles, parameters."""
    from keepout.cli.commands.mesh import describe_targets

    with terminal.progress("targets") as progress:
        rows = describe_targets(pictures=pictures, progress=progress)
    answer({"targets": rows, "seed": seed}, as_json)
    if not as_json:
        Console().print(terminal.targets_table(rows))


@app.command(
    epilog=example(
        "keepout describe satellite.glb --units m -o out/satellite",
        "keepout describe out/explore/map.keepmap",
        "keepout describe intelsat30",
    )
)
def describe(
    mesh: Annotated[str, typer.Argument(help="A mesh file, a map file (.keepmap), or a built-in target's name.")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Also draw it into this folder.")] = None,
    units: Units = None,
    scale: Scale = None,
    drop_stray: DropStray = False,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Report what a mesh is, what is wrong with it, and what reading it left out."""
    from keepout.cli.commands.mesh import describe_mesh

    if mesh.endswith(".keepout"):
        raise typer.BadParameter(f"{mesh} is a field; `keepout measure {mesh}` measures it against its mesh")
    given = {"source": mesh, "units": units, "scale": scale, "drop_stray": drop_stray}
    with terminal.progress(f"describe {mesh}") as progress:
        summary = describe_mesh(given, out, progress=progress)
    answer({**summary, "seed": seed}, as_json)
    if not as_json:
        Console().print(terminal.facts_table("Mesh", summary))


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
    from keepout.cli.commands.mesh import fit_to_file

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


@app.command(
    epilog=example(
        "keepout certify satellite.keepout --chaser-radius 0.5",
        "keepout certify --check satellite.keepout",
    )
)
def certify(
    field: Annotated[Path, typer.Argument(help="A field file (.keepout); the certificate is added to it.")],
    chaser_radius: ChaserRadius = 0.5,
    prove_slope: Annotated[bool, typer.Option("--prove-slope", help="Prove a bound of ‖∇f̃‖ too: minutes.")] = False,
    check: Annotated[
        bool,
        typer.Option(
            "--check",
            help="Add nothing: prove every certificate of the file again, for all its radii. Exit code 1: not proved.",
        ),
    ] = False,
    mesh: Annotated[str | None, typer.Option(help="The mesh, where it is not where `fit` found it.")] = None,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Bound how far the field can over-state the distance where a chaser of this radius would touch."""
    from keepout.cli.commands.mesh import certify_file, check_file

    if check:
        if prove_slope:
            raise typer.BadParameter("--prove-slope adds a proof; --check proves what the file says and adds none")
        with terminal.progress(f"check {field.name}") as progress:
            summary = check_file(field, mesh=mesh, seed=seed, progress=progress)
        answer(summary, as_json)
        if not as_json:
            for row in summary["certificates"]:
                said = "proved" if row["proved"] else "not proved"
                Console().print(terminal.facts_table(f"Certificate for {row['chaser_radius_m']:g} m: {said}", row))
        raise typer.Exit(0 if summary["proved"] else 1)
    with terminal.progress(f"certify {field.name}") as progress:
        summary = certify_file(
            field, chaser_radius=chaser_radius, prove_slope=prove_slope, mesh=mesh, seed=seed, progress=progress
        )
    answer(summary, as_json)
    if not as_json:
        Console().print(terminal.facts_table("Certificate", summary))


@app.command(
    epilog=example(
        "keepout measure satellite.keepout -o out/satellite",
        "keepout measure intelsat30 --shipped",
    )
)
def measure(
    field: Annotated[str, typer.Argument(help="A field file (.keepout); with --shipped, a built-in target's name.")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Also draw it into this folder.")] = None,
    mesh: Annotated[str | None, typer.Option(help="The mesh, where it is not where `fit` found it.")] = None,
    shipped: Annotated[
        bool, typer.Option("--shipped", help="Measure the field that comes with the package for a built-in target.")
    ] = False,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Measure a field against its mesh, and list its certificates."""
    from keepout.cli.commands import usage
    from keepout.cli.commands.mesh import measure_field
    from keepout.core.fields import shipped_path

    if not shipped and not field.endswith(".keepout"):
        raise typer.BadParameter(
            f"{field} is not a .keepout file; `keepout describe {field}` says what is wrong with a mesh"
        )
    with terminal.progress(f"measure {field}") as progress:
        with usage():
            path = shipped_path(field) if shipped else Path(field)
        summary = measure_field(path, out, mesh=mesh, seed=seed, progress=progress)
        tables = terminal.measures_tables(summary)
    answer(summary, as_json)
    if not as_json:
        for table in tables:
            Console().print(table)
