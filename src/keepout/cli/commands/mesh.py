"""Commands on meshes and fields as functions: what `targets`, `describe`, `fit`, `certify` and `measure` do."""

import time
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from keepout.cli.commands import usage
from keepout.cli.commands.named_target import recorded_target, target_entry
from keepout.core.errors import FieldError, UsageError
from keepout.core.progress import Progress, part_of, silent
from keepout.core.whole_file import require_place


def describe_targets(*, pictures: Path | None = None, progress: Progress = silent) -> list[dict[str, Any]]:
    """List the built-in targets with size, triangles and parameters; draw them into `pictures` where it is given."""
    from keepout.core.fields import shipped_names
    from keepout.core.geometry.builtin import BUILTINS
    from keepout.core.geometry.mesh_report import enclosed_volume
    from keepout.core.geometry.target import Target
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


def _field_path(path: Path) -> Path:
    if path.suffix != ".keepout":
        raise UsageError(f"{path}: a field file ends in .keepout")
    if not path.absolute().parent.is_dir():
        raise FieldError(f"{path}: the folder {path.parent} does not exist")
    require_place(path, refusal=FieldError)
    return path


def fit_to_file(
    source: Mapping[str, Any],
    out: Path,
    *,
    profile: str = "default",
    chaser_radius: float = 0.5,
    certified: bool = False,
    seed: int = 0,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Learn the field of a mesh file or built-in target and write it to `out`, where asked with its certificate.

    While it runs, a checkpoint stands beside `out`; a run that was killed goes on from there. The field is written
    before it is certified, so that a proof that is stopped loses nothing.
    """
    from keepout.core.learning.losses import find_profile
    from keepout.core.learning.training import fit
    from keepout.core.measures.quality import surface_errors
    from keepout.core.mission.build import load_target

    with usage():
        find_profile(profile)
    out = _field_path(out)
    entry = target_entry(source)
    target = load_target(entry)
    start = time.perf_counter()
    model = fit(
        target,
        profile=profile,
        chaser_radius=chaser_radius,
        seed=seed,
        checkpoint=out.with_name(out.name + ".checkpoint"),
        progress=part_of(progress, 0.0, 0.9) if certified else progress,
    )
    seconds = time.perf_counter() - start
    located = entry.model_dump()
    if Path(entry.source).exists():
        located["source"] = str(Path(entry.source).resolve())
    model = model.with_training(target=located)
    model.save(out)
    errors = surface_errors(model.field, target, seed=seed)
    proof: dict[str, Any] = {}
    if certified:
        part = part_of(progress, 0.9, 1.0)
        proof["certificate"] = certify_file(out, chaser_radius=chaser_radius, seed=seed, progress=part)
    return {
        "field": str(out),
        "seconds": seconds,
        "epsilon_m": errors.epsilon,
        "epsilon_plus_m": errors.epsilon_plus,
        "sampled_maximum_m": errors.maximum,
        "profile": profile,
        "seed": seed,
        "target": target.name,
        "target_sha256": target.sha256,
        "warnings": list(target.report.warnings),
        **proof,
    }


def certify_file(
    path: Path,
    *,
    chaser_radius: float,
    prove_slope: bool = False,
    mesh: str | None = None,
    seed: int = 0,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Add a certificate for a chaser radius to a field file; the mesh is found where `fit` found it unless given."""
    from keepout.core.fields.model import FieldModel
    from keepout.core.mission.build import load_target
    from keepout.core.proof.certificate import certify

    model = FieldModel.load(path)
    require_place(path, refusal=FieldError)
    entry = recorded_target(path, model, mesh)
    model = certify(
        model,
        load_target(entry),
        chaser_radius=chaser_radius,
        prove_slope=prove_slope,
        seed=seed,
        progress=progress,
    )
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


def check_file(path: Path, *, mesh: str | None = None, seed: int = 0, progress: Progress = silent) -> dict[str, Any]:
    """Prove all certificates of a field file again, from its field and its mesh alone; the file stays as it is.

    Raises:
        FieldError: no certificate in it, or a mesh that the field was not made for.

    """
    from keepout.core.fields.model import FieldModel
    from keepout.core.mission.build import load_target
    from keepout.core.proof.certificate import check_certificate

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


def measure_field(
    path: Path, out: Path | None = None, *, mesh: str | None = None, seed: int = 0, progress: Progress = silent
) -> dict[str, Any]:
    """Measure a field against its mesh and list its certificates; draw slices and surface into `out` if given."""
    from keepout.core.fields.model import FieldModel
    from keepout.core.measures.quality import measure_model
    from keepout.core.mission.build import load_target
    from keepout.flights.pages.folder import results_in

    model = FieldModel.load(path)
    target = load_target(recorded_target(path, model, mesh))
    model = FieldModel.load(path, target=target)
    with results_in(out):
        measures, surface = measure_model(model, target, seed=seed, progress=part_of(progress, 0.0, 0.9))
        summary: dict[str, Any] = {"field": str(path), **measures}
        if out is not None:
            from keepout.flights.pages.mesh_pictures import draw_slices, draw_surface

            progress(0.9, "pictures")
            draw_slices(out / "slices.png", model, target)
            draw_surface(out / "surface.png", target, surface, level=measures["surface"]["level"])
            summary["pictures"] = [str(out / "slices.png"), str(out / "surface.png")]
    progress(1.0, "")
    return summary


def describe_mesh(source: Mapping[str, Any], out: Path | None = None, *, progress: Progress = silent) -> dict[str, Any]:
    """Report what is known about a mesh before anything is learned from it; draw it into `out` if that is given."""
    from keepout.core.geometry.target import survey
    from keepout.core.mission.build import load_target
    from keepout.flights.pages.folder import results_in

    target = load_target(target_entry(source))
    summary: dict[str, Any] = {"lengths": _lengths(source)}
    with results_in(out):
        summary |= asdict(survey(target, progress=part_of(progress, 0.0, 0.95)))
        if out is not None:
            from keepout.flights.pages.mesh_pictures import draw_target

            picture = out / f"{target.name}.png"
            draw_target(picture, target)
            summary["picture"] = str(picture)
    progress(1.0, "")
    return summary


def _lengths(source: Mapping[str, Any]) -> str:
    """Say in which unit a mesh's report is, and what the file's numbers were taken for."""
    if source.get("scale") is not None:
        return f"m; one unit of the file is {source['scale']:g} m, as given"
    if source.get("units") is not None:
        return f"m; the file's numbers are in {source['units']}, as given"
    if not Path(source["source"]).exists():
        return "m"  # a built-in target
    return "m; no --units or --scale was given, so the file's own unit holds, or metres where it names none"
