"""Each command of the command line as a function from its arguments to its JSON summary."""

import time
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from keepout.errors import FieldError, ScenarioError
from keepout.fields.model import FieldModel
from keepout.fields.shipped import shipped_names
from keepout.geometry.builtin import BUILTINS
from keepout.geometry.shape import enclosed_volume
from keepout.geometry.survey import survey
from keepout.geometry.target import Target
from keepout.learning.training import fit
from keepout.measures.inspection import inspect_model
from keepout.measures.quality import surface_errors
from keepout.mission.build import load_target
from keepout.mission.campaign import run_campaign
from keepout.mission.entries import TargetEntry
from keepout.mission.flight import fly
from keepout.mission.scenario import Scenario
from keepout.progress import Progress, part_of, silent
from keepout.proof.certificate import certify
from keepout.rare_events.event import FLIGHTS, RUNS, rare
from keepout.report import target_view
from keepout.report.campaign_view import draw_campaign
from keepout.report.field_view import draw_slices, draw_surface
from keepout.report.folder import make_folder, write_flights, write_summary
from keepout.report.rare_view import write_rare


def describe_targets(*, pictures: Path | None = None, progress: Progress = silent) -> list[dict[str, Any]]:
    """List the built-in targets with size, triangles and parameters; draw them into `pictures` where it is given."""
    if pictures is not None:
        make_folder(pictures)
    rows = []
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
            picture = pictures / f"{name}.png"
            target_view.draw_target(picture, name, target.vertices, target.faces)
            row["picture"] = str(picture)
        rows.append(row)
    return rows


def _entry(source: Mapping[str, Any]) -> TargetEntry:
    given = {key: value for key, value in source.items() if value is not None}
    try:
        return Scenario.parse({"target": given}).target
    except ScenarioError as error:  # the user gave options, not a scenario
        raise ScenarioError(str(error).replace("scenario: target.", "--")) from None


def _field_path(path: Path) -> Path:
    if path.suffix != ".keepout":
        raise FieldError(f"{path}: a field file ends in .keepout")
    if not path.absolute().parent.is_dir():
        raise FieldError(f"{path}: the folder {path.parent} does not exist")
    return path


def fit_to_file(
    source: Mapping[str, Any],
    out: Path,
    *,
    profile: str = "default",
    chaser_radius: float = 0.5,
    seed: int = 0,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Learn the field of a mesh file or built-in target and write it to `out`.

    While it runs, a checkpoint stands beside `out`; a run that was killed goes on from there.
    """
    out = _field_path(out)
    entry = _entry(source)
    target = load_target(entry)
    start = time.perf_counter()
    model = fit(
        target,
        profile=profile,
        chaser_radius=chaser_radius,
        seed=seed,
        checkpoint=out.with_name(out.name + ".checkpoint"),
        progress=progress,
    )
    seconds = time.perf_counter() - start
    located = entry.model_dump()
    if Path(entry.source).exists():
        located["source"] = str(Path(entry.source).resolve())
    model = model.with_training(target=located)
    model.save(out)
    errors = surface_errors(model.field, target, seed=seed)
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
    model = FieldModel.load(path)
    entry = _recorded_target(path, model, mesh)
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


def inspect_file(
    path: Path, out: Path | None = None, *, mesh: str | None = None, seed: int = 0, progress: Progress = silent
) -> dict[str, Any]:
    """Measure a field against its mesh and list its certificates; draw slices and surface into `out` if given."""
    model = FieldModel.load(path)
    target = load_target(_recorded_target(path, model, mesh))
    model = FieldModel.load(path, target=target)
    if out is not None:
        make_folder(out)
    measures, surface = inspect_model(model, target, seed=seed, progress=part_of(progress, 0.0, 0.9))
    summary: dict[str, Any] = {"field": str(path), **measures}
    if out is not None:
        progress(0.9, "pictures")
        draw_slices(out / "slices.png", model, target)
        draw_surface(out / "surface.png", target, surface, level=measures["surface"]["level"])
        summary["pictures"] = [str(out / "slices.png"), str(out / "surface.png")]
    progress(1.0, "")
    return summary


def inspect_mesh(source: Mapping[str, Any], out: Path | None = None, *, progress: Progress = silent) -> dict[str, Any]:
    """Report what is known about a mesh before anything is learned from it; draw it into `out` if that is given."""
    target = load_target(_entry(source))
    summary = asdict(survey(target, progress=part_of(progress, 0.0, 0.95)))
    if out is not None:
        make_folder(out)
        picture = out / f"{target.name}.png"
        target_view.draw_target(picture, target.name, target.vertices, target.faces)
        summary["picture"] = str(picture)
    progress(1.0, "")
    return summary


def _recorded_target(path: Path, model: FieldModel, mesh: str | None) -> TargetEntry:
    """Say where a field's mesh is: as given, or as `fit` recorded it, or the built-in of its name."""
    recorded = model.training.get("target")
    if mesh is not None:
        return _entry({**(recorded or {}), "source": mesh})
    if recorded is not None:
        return _entry(recorded)
    if model.target_name in BUILTINS:
        return _entry({"source": model.target_name})
    raise FieldError(f"{path}: does not say where its mesh is; name it with --mesh")


def fly_to_folder(
    scenario: Scenario, out: Path, *, figures: bool = True, progress: Progress = silent
) -> dict[str, Any]:
    """Fly a scenario; write flight file, figures, page and `summary.json` into `out`."""
    make_folder(out)
    flight = fly(scenario, progress=part_of(progress, 0.0, 0.9))
    introduction = (
        f"Target {flight.target.name}, start {list(scenario.start.position)} m, goal {list(scenario.goal.position)} m."
    )
    [summary] = write_flights(
        out, {scenario.name: flight}, title=f"Flight {scenario.name}", introduction=introduction, figures=figures
    )
    write_summary(out, summary)
    return summary


def campaign_to_folder(scenario: Scenario, out: Path, *, progress: Progress = silent) -> dict[str, Any]:
    """Fly a scenario's campaign; write one row a flight, their series, a figure and `summary.json` into `out`."""
    make_folder(out)
    flown = run_campaign(scenario, progress=progress)
    flights = out / f"{scenario.name}-flights.parquet"
    flown.save(flights)
    summary = {**flown.summary(), "flights": str(flights)}
    if flown.series is not None:
        series = out / f"{scenario.name}-series.npz"
        flown.series.save(series)
        summary |= {"series": str(series), "series_stride": flown.series.stride}
    draw_campaign(out / "campaign.png", flown)
    write_summary(out, summary)
    return summary


def rare_to_folder(
    scenario: Scenario,
    out: Path,
    *,
    below: float = 0.0,
    runs: int = RUNS,
    flights: int = FLIGHTS,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Measure a rare event; write levels, curve, the worst flight, a page and `summary.json` into `out`.

    Stopped, it goes on from its last level when it is started again.
    """
    make_folder(out)
    event = rare(scenario, below=below, runs=runs, flights=flights, state=out, progress=part_of(progress, 0.0, 0.97))
    summary = write_rare(out, event)
    write_summary(out, summary)
    return summary
