"""Verbs on fields: fit and measure."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from keepout.core.compiled.kept_programs import keep_programs
from keepout.core.errors import FieldError, UsageError
from keepout.core.fields import load_shipped, shipped_names
from keepout.core.fields.model import FieldModel
from keepout.core.geometry.offset_solid import OffsetSolid
from keepout.core.geometry.target import Target
from keepout.core.learning import training
from keepout.core.learning.losses import TrainingProfile
from keepout.core.measures.quality import curvature, distance_errors, margin_cost, surface_errors
from keepout.core.mission.build import load_model
from keepout.core.mission.entries import TargetEntry
from keepout.core.mission.scenario import Scenario, ScenarioLike
from keepout.core.mission.target import load_target
from keepout.core.progress import Progress, part_of, silent
from keepout.core.proof.certificate import certify as _certify
from keepout.core.whole_file import require_place
from keepout.flights.pages.folder import results_in
from keepout.flights.pages.mesh_pictures import draw_slices, draw_surface
from keepout.flights.surface import Surface, extract_surface, measure_volumes, steepest_slope, surface_distance
from keepout.verbs.meshes import MeshLike, mesh_of, recorded_target

BANDS = ((0.05, 1.0), (1.0, 5.0))
"""Metres. Distances from the surface that count as near and far."""
CURVATURE_LEVELS = (0.1, 0.3, 1.0)
"""Metres. Distances from the surface at which the Hessian is measured."""


def fit(
    target: MeshLike,
    *,
    profile: str | TrainingProfile = "default",
    chaser_radius: float | None = None,
    certify: bool = False,
    out: str | Path | None = None,
    first: FieldModel | str | Path | None = None,
    until_bound: float | None = None,
    at_most: float | None = None,
    seed: int = 0,
    progress: Progress = silent,
    **how: Any,
) -> FieldModel:
    """Learn a target's signed distance, tightest where the chaser touches; with `certify`, prove its error bound.

    With `out` a fit that was stopped goes on from its last checkpoint when it is called again.

    Args:
        target: a `Target`, a built-in target's name, a mesh or map file, or a scenario, whose target.
        profile: "default", "fine" (twice the steps), "quick" (rough), "paper" or "paper_printed"; or a
            `TrainingProfile`.
        chaser_radius: of the ball that holds the chaser, m; a scenario's own, and else 0.5, if absent.
        certify: then prove by how much the field over-states the distance (e_h, m), for this radius.
        out: the field file (.keepout) to write, before and after the proof.
        first: the field, or its file, of a mesh that differs little, to begin with: less than half the time.
        until_bound: end as soon as no over-statement above this is found, m.
        at_most: end after about this time, s; the proof's is not counted.
        seed: the same seed, target and profile on the same machine give the same field, but for `at_most`.
        progress: called as the work goes on.
        **how: `checkpoint` (a file kept up to date while training) and `solid` (the target's `OffsetSolid`).

    Returns:
        The field, with its certificate where it was asked for.

    Raises:
        KeepoutError: an unknown profile, a radius that is negative or too large, a mesh that cannot be used, a
            checkpoint of another fit, or a file that cannot be written.

    """
    path = None if out is None else Path(out)
    if path is not None:
        if path.suffix != ".keepout":
            raise UsageError(f"{path}: a field file ends in .keepout")
        require_place(path, refusal=FieldError)
    if isinstance(target, Mapping) or (isinstance(target, str | Path) and Path(target).suffix.lower() == ".toml"):
        target = Scenario.of(target)
    if chaser_radius is None:
        chaser_radius = target.chaser.radius if isinstance(target, Scenario) else 0.5
    loaded, entry = mesh_of(target)
    part = part_of(progress, 0.0, 0.9) if certify else progress
    first = FieldModel.load(first) if isinstance(first, str | Path) else first
    ends = {"first": first, "until_bound": until_bound, "at_most": at_most}
    settings = {"profile": profile, "chaser_radius": chaser_radius, "seed": seed, **ends, **how}
    model = learned(loaded, entry, path, settings, progress=part)
    if certify:
        part = part_of(progress, 0.9, 1.0)
        model = _certify(model, loaded, chaser_radius=chaser_radius, seed=seed, progress=part)
        if path is not None:
            model.save(path)
    return model


def learned(
    target: Target, entry: TargetEntry | None, path: Path | None, settings: Mapping[str, Any], *, progress: Progress
) -> FieldModel:
    """Fit a field, note where its mesh is, and save it; a checkpoint beside the file lets a stopped fit go on.

    Args:
        target: what to learn.
        entry: where it was found; None where that is not known.
        path: the file, if it is to be written.
        settings: of `core/learning/training.fit`.
        progress: called as the work goes on.

    """
    kept: dict[str, Any] = {} if path is None else {"checkpoint": path.with_name(path.name + ".checkpoint")}
    model = training.fit(target, **(kept | dict(settings)), progress=progress)
    if entry is not None:
        located = entry.model_dump()
        if Path(entry.source).exists():
            located["source"] = str(Path(entry.source).resolve())
        model = model.with_training(target=located)
    if path is not None:
        model.save(path)  # before it is certified, so that a proof that is stopped loses nothing
    return model


def measure(
    field: FieldModel | ScenarioLike,
    target: MeshLike | None = None,
    *,
    out: str | Path | None = None,
    seed: int = 0,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Measure a field against its mesh, as `keepout measure` does: a measurement, no proof.

    Args:
        field: a field, its file (.keepout), the name of a built-in target that has a shipped one, or a scenario, whose.
        target: its mesh; if absent where `fit` found it.
        out: a folder to draw slices and surface into.
        seed: of the points at which it is measured.
        progress: called as the work goes on.

    Returns:
        Plain values: errors (m), slopes, volumes (m³), surface, certificates.

    Raises:
        KeepoutError: the field or its mesh cannot be read, or they do not belong together.

    """
    scenario = isinstance(field, Scenario | Mapping) or Path(str(field)).suffix.lower() == ".toml"
    mesh = None if target is None else mesh_of(target)[0]
    if not isinstance(field, FieldModel) and scenario:
        flown = Scenario.of(field)
        mesh = load_target(flown.target) if mesh is None else mesh
        model = load_model(flown, mesh)
    else:
        model = field if isinstance(field, FieldModel) else _field_named(field)
        mesh = load_target(recorded_target(model.target_name, model)) if mesh is None else mesh
        model.require_target(mesh, where="field")
    return measured(model, mesh, None if out is None else Path(out), seed=seed, progress=progress)


def _field_named(name: Any) -> FieldModel:
    if str(name) in shipped_names():
        return load_shipped(str(name))
    if isinstance(name, str | Path) and Path(name).suffix == ".keepout":
        return FieldModel.load(name)
    valid = f"a .keepout file, or one of {', '.join(shipped_names())}"
    raise UsageError(f"{name}: no field; it must be {valid}. `keepout describe {name}` says what is wrong with a mesh")


def measured(model: FieldModel, target: Target, out: Path | None, *, seed: int, progress: Progress) -> dict[str, Any]:
    """Measure a field against its mesh, and draw both into a folder where one is given."""
    with results_in(out):
        measures, surface = measure_model(model, target, seed=seed, progress=part_of(progress, 0.0, 0.9))
        summary: dict[str, Any] = dict(measures)
        if out is not None:
            progress(0.9, "pictures")
            draw_slices(out / "slices.png", model, target)
            draw_surface(out / "surface.png", target, surface, level=measures["surface"]["level"])
            summary["pictures"] = [str(out / "slices.png"), str(out / "surface.png")]
    progress(1.0, "")
    return summary


def measure_model(
    model: FieldModel, target: Target, *, seed: int = 0, progress: Progress = silent
) -> tuple[dict[str, Any], Surface]:
    """Measure a field against its mesh.

    Args:
        model: the field and its certificates.
        target: the mesh it was made for.
        seed: of all samples.
        progress: called as the measures are taken.

    Returns:
        Plain JSON values, lengths in metres and volumes in cubic metres; and the surface on which the distances were
        measured: the level certified for radius 0, or the zero level where there is none.

    """
    keep_programs()
    progress(0.0, "offset solid")
    closing = float(model.training.get("closing_radius", 0.25))
    solid = OffsetSolid.build(target.distance, offset=model.offset, closing_radius=closing)
    field, certificates = model.field, model.certificates
    progress(0.1, "errors")
    errors = surface_errors(field, target, seed=seed)
    near, far = (distance_errors(field, solid, nearest=low, farthest=high, seed=seed) for low, high in BANDS)
    progress(0.2, "curvature")
    curvatures = [curvature(field, solid, level, seed=seed) for level in CURVATURE_LEVELS]
    steepest = max((c.gradient_bound for c in certificates), default=0.0) or steepest_slope(field, target.distance)
    contact_level = next((c.error_bound for c in certificates if c.chaser_radius == 0.0), 0.0)
    surface = extract_surface(
        field, target.distance, contact_level, steepest=steepest, progress=part_of(progress, 0.3, 0.55)
    )
    progress(0.55, "distance between the surfaces")
    apart = surface_distance(surface, solid, contact_level, seed=seed)
    levels = [(c.chaser_radius, c.chaser_radius + c.error_bound) for c in certificates] or [(0.0, 0.0)]
    volumes = measure_volumes(
        field, solid, levels, steepest=steepest, seed=seed, progress=part_of(progress, 0.65, 0.95)
    )
    progress(0.95, "margins")
    summary = {
        "target": model.target_name,
        "target_sha256": model.target_sha256,
        "epsilon_m": errors.epsilon,
        "epsilon_plus_m": errors.epsilon_plus,
        "sampled_maximum_m": errors.maximum,
        "sealed_volume_m3": solid.sealed_volume,
        "near": {"from_m": BANDS[0][0], "to_m": BANDS[0][1], **dataclasses.asdict(near)},
        "far": {"from_m": BANDS[1][0], "to_m": BANDS[1][1], **dataclasses.asdict(far)},
        "curvature": [dataclasses.asdict(entry) for entry in curvatures],
        "surface": dataclasses.asdict(apart),
        "volumes": [dataclasses.asdict(entry) for entry in volumes],
        "certificates": [
            dataclasses.asdict(c)
            | {
                "margin": dataclasses.asdict(
                    margin_cost(field, solid, error_bound=c.error_bound, chaser_radius=c.chaser_radius, seed=seed)
                )
            }
            for c in certificates
        ],
    }
    progress(1.0, "")
    return summary, surface
