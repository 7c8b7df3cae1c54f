"""Commands on meshes and fields: targets, describe, fit, certify, measure."""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from keepout.cli import options
from keepout.cli.options import AsJson, ChaserRadius, MeshFile, Seed, app, example, from_zero, grouped, into
from keepout.core.errors import FieldError
from keepout.core.progress import Progress, part_of
from keepout.core.whole_file import require_place
from keepout.flights.pages import terminal

if TYPE_CHECKING:
    from keepout.core.mission.entries import TargetEntry

Mesh = Annotated[str, typer.Argument(help="A mesh file, a map (.keepmap), a built-in target, or a mission's target.")]
WhereMesh = Annotated[str | None, typer.Option(help="The mesh, if it is not where `fit` found it.")]
DrawnInto = Annotated[Path | None, into("Also draw it into this folder.")]
_RADIUS = 0.5
"""Of the chaser that a mesh is learned for where nothing says another, m."""


def _read(mesh: str, read: MeshFile) -> tuple["TargetEntry", float]:
    """Make the entry `[target]` of a mesh, or read it in a mission, with its chaser's radius (m)."""
    if not mesh.lower().endswith(".toml"):
        return read.entry(mesh), _RADIUS
    from keepout.core.mission.first_look import require_mesh

    scenario = options.mission_for_mesh(mesh, vars(read))
    require_mesh(scenario.target.source)
    return scenario.target, scenario.chaser.radius


@app.command(epilog=example("keepout targets", "keepout targets --pictures out/targets"))
def targets(
    pictures: Annotated[Path | None, typer.Option(help="Also draw them into this folder.")] = None,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """List the built-in targets, with sizes and parameters."""
    with terminal.progress("targets") as progress:
        rows = describe_targets(pictures, progress)
    options.answer({"targets": rows, "seed": seed}, as_json, terminal.targets_table(rows))


def describe_targets(pictures: Path | None, progress: Progress) -> list[dict[str, Any]]:
    """List the built-in targets with size, triangles and parameters; draw them into `pictures` where it is given."""
    from keepout.core.fields import shipped_names
    from keepout.core.geometry.builtin import BUILTINS
    from keepout.core.geometry.target import Target, enclosed_volume
    from keepout.flights.pages.folder import results_in

    rows = []
    with results_in(pictures):
        for place, (name, builtin) in enumerate(BUILTINS.items()):
            progress(place / len(BUILTINS), name)
            target = Target.load(name)
            row: dict[str, Any] = {
                "name": name,
                "extents_m": [float(extent) for extent in target.vertices.max(axis=0) - target.vertices.min(axis=0)],
                "volume_m3": enclosed_volume(target.vertices, target.faces),
                "triangles": len(target.faces),
                "shipped_field": name in shipped_names(),
                "parameters": {key: parameter.default for key, parameter in builtin.parameters.items()},
            }
            if pictures is not None:
                from keepout.flights.pages.mesh_pictures import draw_target

                picture = pictures / f"{name}.png"
                draw_target(picture, target)
                row["picture"] = str(picture)
            rows.append(row)
    return rows


@app.command(
    epilog=example(
        "keepout describe satellite.glb --units m -o out/satellite",
        "keepout describe out/explore/map.keepmap",
        "keepout describe mission.toml -o out/target",
    )
)
@grouped
def describe(mesh: Mesh, *, out: DrawnInto = None, read: MeshFile, seed: Seed = 0, as_json: AsJson = False) -> None:
    """Report what a mesh is, what is wrong with it, and what reading it left out."""
    if mesh.endswith(".keepout"):
        raise typer.BadParameter(f"{mesh} is a field; `keepout measure {mesh}` measures it against its mesh")
    with terminal.progress(f"describe {mesh}") as progress:
        entry, _ = _read(mesh, read)
        from keepout.verbs.meshes import describe as described

        summary = described(entry, out=out, progress=progress)
    options.answer({**summary, "seed": seed}, as_json, terminal.mesh_table(summary))


@app.command(
    epilog=example(
        "keepout fit satellite.glb --units m -o satellite.keepout",
        "keepout fit satellite.stl --units mm --certify -o satellite.keepout",
        "keepout fit out/explore/map.keepmap --certify -o debris.keepout",
        "keepout fit satellite.glb --units m --until-bound 0.0 --at-most 300 -o satellite.keepout",
        "keepout fit mission.toml --certify -o satellite.keepout",
    )
)
@grouped
def fit(
    mesh: Mesh,
    *,
    out: Annotated[Path, into("The field file to write (.keepout).")],
    profile: Annotated[
        str,
        typer.Option(
            help="default, fine (two to four times the work), quick (rough), paper (its network, its loss), "
            "paper_printed (its loss as printed)."
        ),
    ] = "default",
    batch: Annotated[int | None, typer.Option(help="Points a step, instead of the profile's.")] = None,
    chaser_radius: Annotated[
        float | None, from_zero("Of the ball that holds the chaser, m; unset: a mission's own, else 0.5.")
    ] = None,
    certify: Annotated[bool, typer.Option("--certify", help="Then `certify` it.")] = False,
    first: Annotated[
        str | None,
        typer.Option(
            "--from",
            help="Begin with a similar mesh's field, a file or built-in target: half the time or less.",
        ),
    ] = None,
    until_bound: Annotated[
        float | None,
        typer.Option(help="End once no over-statement above this is found, m; the proved bound is some mm more."),
    ] = None,
    at_most: Annotated[float | None, typer.Option(help="End after about this time, s, the proof not counted.")] = None,
    read: MeshFile,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Learn a target's signed distance, tightest where the chaser touches.

    A killed run resumes from its last checkpoint when started again.
    """
    with terminal.progress(f"fit {mesh}") as progress:
        entry, radius = _read(mesh, read)
        radius = radius if chaser_radius is None else chaser_radius
        from keepout.core.learning.losses import find_profile
        from keepout.verbs.fields import field_named

        with options.usage():
            numbers = find_profile(profile)
            numbers = profile if batch is None else numbers.with_batch(batch)
        options.require_file(out, ".keepout", "a field file", refusal=FieldError)
        part = part_of(progress, 0.0, 0.9) if certify else progress
        begun = None if first is None else field_named(first)
        settings = {"profile": numbers, "chaser_radius": radius, "seed": seed, "first": begun}
        settings |= {"until_bound": until_bound, "at_most": at_most}
        summary = {**_fitted(entry, out, settings, part), "profile": profile, "seed": seed}
        proof: dict[str, Any] = {}
        if certify:
            part = part_of(progress, 0.9, 1.0)
            proof["certificate"] = _certified(out, radius, seed=seed, progress=part)
    tables = [terminal.facts_table(title.capitalize(), of) for title, of in {"fit": summary, **proof}.items()]
    options.answer(summary | proof, as_json, *tables)


def _fitted(entry: "TargetEntry", out: Path, settings: Mapping[str, Any], progress: Progress) -> dict[str, Any]:
    """Fit a field to a mesh and save it."""
    from keepout.core.measures.quality import surface_errors
    from keepout.core.mission.target import load_target
    from keepout.verbs.fields import learned

    target = load_target(entry)
    start = time.perf_counter()
    model = learned(target, entry, out, settings, progress=progress)
    seconds = time.perf_counter() - start
    errors = surface_errors(model.field, target, seed=settings["seed"])
    return {
        "field": str(out),
        "seconds": seconds,
        "ended": model.training["ended"],
        "epsilon_m": errors.epsilon,
        "epsilon_plus_m": errors.epsilon_plus,
        "sampled_maximum_m": errors.maximum,
        "target": target.name,
        "target_sha256": target.sha256,
        "warnings": list(target.report.warnings),
    }


@app.command(
    epilog=example(
        "keepout certify satellite.keepout --chaser-radius 0.5",
        "keepout certify --check satellite.keepout",
    )
)
def certify(
    field: Annotated[Path, typer.Argument(help="A field file (.keepout), which gets the certificate.")],
    chaser_radius: ChaserRadius = _RADIUS,
    prove_slope: Annotated[bool, typer.Option("--prove-slope", help="Prove a bound of ‖∇f̃‖ too: minutes.")] = False,
    check: Annotated[
        bool,
        typer.Option(
            "--check",
            help="Only prove the file's certificates again; exit code 1: not proved.",
        ),
    ] = False,
    mesh: WhereMesh = None,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Bound how far the field can over-state the distance where this chaser would touch."""
    if check and prove_slope:
        raise typer.BadParameter("--prove-slope adds a proof; --check proves what the file says and adds none")
    if not check:
        with terminal.progress(f"certify {field.name}") as progress:
            summary = _certified(field, chaser_radius, prove_slope=prove_slope, mesh=mesh, seed=seed, progress=progress)
        options.answer(summary, as_json, terminal.facts_table("Certificate", summary))
        return
    with terminal.progress(f"check {field.name}") as progress:
        summary = _checked(field, mesh, seed, progress)
    said = {True: "proved", False: "not proved"}
    rows = summary["certificates"]
    titles = [f"Certificate for {row['chaser_radius_m']:g} m: {said[row['proved']]}" for row in rows]
    options.answer(summary, as_json, *map(terminal.facts_table, titles, rows))
    raise typer.Exit(0 if summary["proved"] else 1)


def _certified(
    path: Path,
    chaser_radius: float,
    *,
    prove_slope: bool = False,
    mesh: str | None = None,
    seed: int,
    progress: Progress,
) -> dict[str, Any]:
    """Add a certificate for a chaser radius to a field file; the mesh is found where `fit` found it unless given."""
    from keepout.core.fields.model import FieldModel
    from keepout.core.mission.target import load_target
    from keepout.core.proof.certificate import certify
    from keepout.verbs.meshes import recorded_target

    model = FieldModel.load(path)
    require_place(path, refusal=FieldError)
    target = load_target(recorded_target(path, model, mesh))
    proof = {"chaser_radius": chaser_radius, "prove_slope": prove_slope}
    model = certify(model, target, **proof, seed=seed, progress=progress)
    model.save(path)
    certificate = model.certificate(chaser_radius)
    return {
        "field": str(path),
        "kind": certificate.kind,
        "error_bound_m": certificate.error_bound,
        "chaser_radius_m": certificate.chaser_radius,
        "sampled_maximum_m": certificate.sampled_maximum,
        "gradient_bound": certificate.gradient_bound,
        "gradient_kind": certificate.gradient_kind,
        "gradient_found": certificate.gradient_found,
        "seconds": certificate.seconds,
        "target_sha256": certificate.target_sha256,
    }


def _checked(path: Path, mesh: str | None, seed: int, progress: Progress) -> dict[str, Any]:
    """Prove all certificates of a field file again, from its field and its mesh alone; the file stays as it is.

    Raises:
        FieldError: no certificate in it, or a mesh that the field was not made for.

    """
    from keepout.core.fields.model import FieldModel
    from keepout.core.mission.target import load_target
    from keepout.core.proof.certificate import check_certificate
    from keepout.verbs.meshes import recorded_target

    model = FieldModel.load(path)
    if not model.certificates:
        raise FieldError(f"{path}: has no certificate to check; `keepout certify {path}` adds one")
    target = load_target(recorded_target(path, model, mesh))
    model.require_target(target, where=str(path))
    rows = []
    for place, stated in enumerate(model.certificates):
        part = part_of(progress, place / len(model.certificates), (place + 1) / len(model.certificates))
        check = check_certificate(model, target, stated, seed=seed, progress=part)
        rows.append(
            {
                "chaser_radius_m": stated.chaser_radius,
                "kind": stated.kind,
                "proved": check.proved,
                "error_bound_m": stated.error_bound,
                "error_bound_now_m": check.error_bound,
                "evaluation_error_m": stated.evaluation_error,
                "evaluation_error_now_m": check.evaluation_error,
                "gradient_kind": stated.gradient_kind,
                "gradient_bound": stated.gradient_bound,
                "gradient_bound_now": check.gradient_bound,
            }
        )
    return {
        "field": str(path),
        "target_sha256": target.sha256,
        "proved": all(row["proved"] for row in rows),
        "certificates": rows,
    }


@app.command(
    epilog=example(
        "keepout measure satellite.keepout -o out/satellite",
        "keepout measure intelsat30 --shipped",
    )
)
def measure(
    field: Annotated[str, typer.Argument(help="A field file (.keepout), or with --shipped a built-in target.")],
    out: DrawnInto = None,
    mesh: WhereMesh = None,
    shipped: Annotated[bool, typer.Option("--shipped", help="Take the package's field.")] = False,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Measure a field against its mesh, and list its certificates."""
    if not shipped and not field.endswith(".keepout"):
        raise typer.BadParameter(
            f"{field} is not a .keepout file; `keepout describe {field}` says what is wrong with a mesh"
        )
    with terminal.progress(f"measure {field}") as progress:
        from keepout.core.fields import shipped_path
        from keepout.core.fields.model import FieldModel
        from keepout.core.mission.target import load_target
        from keepout.verbs.measures import measured
        from keepout.verbs.meshes import recorded_target

        with options.usage():
            path = shipped_path(field) if shipped else Path(field)
        target = load_target(recorded_target(path, FieldModel.load(path), mesh))
        model = FieldModel.load(path, target=target)
        summary = {"field": str(path), **measured(model, target, out, seed=seed, progress=progress)}
    options.answer(summary, as_json, *terminal.measures_tables(summary))
