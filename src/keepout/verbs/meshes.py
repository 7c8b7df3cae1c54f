"""Verbs on meshes and fields: describe, fit, measure."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from keepout.core.errors import FieldError, ScenarioError, UsageError
from keepout.core.fields import load_shipped, shipped_names
from keepout.core.fields.model import FieldModel
from keepout.core.geometry.builtin import BUILTINS
from keepout.core.geometry.target import Target, survey
from keepout.core.learning import training
from keepout.core.learning.losses import TrainingProfile
from keepout.core.measures.quality import measure_model
from keepout.core.mission.build import load_model
from keepout.core.mission.entries import TargetEntry
from keepout.core.mission.scenario import Scenario, ScenarioLike
from keepout.core.mission.target import load_target
from keepout.core.progress import Progress, part_of, silent
from keepout.core.proof.certificate import certify as _certify
from keepout.core.whole_file import require_place
from keepout.flights.pages.folder import results_in
from keepout.flights.pages.mesh_pictures import draw_slices, draw_surface, draw_target

MeshLike = Target | TargetEntry | ScenarioLike
"""A target, already loaded; a built-in target's name or the path of a mesh file; or a `ScenarioLike`, whose target."""


def mesh_entry(mesh: TargetEntry | ScenarioLike, **read: Any) -> TargetEntry:
    """Say where a mesh is and how it is read.

    Args:
        mesh: a built-in target's name or the path of a mesh file; a scenario, its file or its tables, whose target.
        **read: of a mesh: `units`, `scale`, `drop_stray` and the other entries of `[target]`.

    Raises:
        KeepoutError: no scenario, or an entry that is not valid.

    """
    given = {key: value for key, value in read.items() if value is not None}
    if isinstance(mesh, TargetEntry):
        return mesh
    if isinstance(mesh, str | Path) and Path(mesh).suffix.lower() != ".toml":
        return Scenario.parse({"target": {"source": str(mesh), **given}}).target
    for key in given:
        raise ScenarioError(f"{key}: not with a scenario, whose [target] says how its mesh is read")
    return Scenario.of(mesh).target


def mesh_of(mesh: MeshLike, **read: Any) -> tuple[Target, TargetEntry | None]:
    """Load a target, and say where it was found; None where it was loaded already."""
    if isinstance(mesh, Target):
        return mesh, None
    entry = mesh_entry(mesh, **read)
    return load_target(entry), entry


def recorded_target(path: Path | str, model: FieldModel, mesh: str | None = None) -> TargetEntry:
    """Say where a field's mesh is: as given, or as `fit` recorded it, or the built-in of its name.

    Args:
        path: the field's, for a refusal.
        model: the field.
        mesh: where the mesh is, instead of where `fit` found it.

    Raises:
        KeepoutError: nothing says where it is, or an entry is not valid.

    """
    recorded = model.training.get("target")
    if mesh is None and recorded is None:
        if model.target_name not in BUILTINS:
            raise FieldError(f"{path}: does not say where its mesh is; name it with --mesh")
        recorded = {"source": model.target_name}
    return Scenario.parse({"target": (recorded or {}) | ({} if mesh is None else {"source": mesh})}).target


def describe(
    mesh: MeshLike, *, out: str | Path | None = None, progress: Progress = silent, **read: Any
) -> dict[str, Any]:
    """Report what a mesh is, what is wrong with it, and what reading it left out, as `keepout describe` does.

    Args:
        mesh: a built-in target's name, a mesh or map file, a `Target`, or a scenario.
        out: a folder to draw it into.
        progress: called as the work goes on.
        **read: how a mesh file is read: `units` (m, cm, mm, in, ft), `scale` (m a file unit), `drop_stray`.

    Returns:
        Plain values: counts, extents (m), sealed volumes (m³), warnings and actions.

    Raises:
        KeepoutError: the mesh cannot be used.

    """
    if isinstance(mesh, str | Path) and Path(mesh).suffix.lower() == ".keepout":
        raise UsageError(f"{mesh}: a field; `keepout measure {mesh}` measures it against its mesh")
    target, entry = mesh_of(mesh, **read)
    folder = None if out is None else Path(out)
    summary: dict[str, Any] = {"lengths": "m" if entry is None else _lengths(entry)}
    with results_in(folder):
        summary |= dataclasses.asdict(survey(target, progress=part_of(progress, 0.0, 0.95)))
        if folder is not None:
            draw_target(folder / f"{target.name}.png", target)
            summary["picture"] = str(folder / f"{target.name}.png")
    return summary


def _lengths(entry: TargetEntry) -> str:
    """Say in which unit a mesh's report is, and what the file's numbers were taken for."""
    if entry.scale is not None:
        return f"m; one unit of the file is {entry.scale:g} m, as given"
    if entry.units is not None:
        return f"m; the file's numbers are in {entry.units}, as given"
    if not Path(entry.source).exists():
        return "m"  # a built-in target
    return "m; no --units or --scale was given, so the file's own unit holds, or metres where it names none"


def fit(
    target: MeshLike,
    *,
    profile: str | TrainingProfile = "default",
    chaser_radius: float | None = None,
    certify: bool = False,
    out: str | Path | None = None,
    seed: int = 0,
    progress: Progress = silent,
    **how: Any,
) -> FieldModel:
    """Learn a target's signed distance, tightest where the chaser touches; with `certify`, prove its error bound.

    With `out` a fit that was stopped goes on from its last checkpoint when it is called again.

    Args:
        target: a `Target`, a built-in target's name, a mesh or map file, or a scenario, whose target.
        profile: "default", "quick" (rough, for trying out), "paper" or "paper_printed"; or a `TrainingProfile`.
        chaser_radius: of the ball that holds the chaser, m; a scenario's own, and else 0.5, if absent.
        certify: then prove by how much the field over-states the distance (e_h, m), for this radius.
        out: the field file (.keepout) to write, before and after the proof.
        seed: the same seed, target and profile on the same machine give the same field.
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
        how = {"checkpoint": path.with_name(path.name + ".checkpoint"), **how}
    if isinstance(target, Mapping) or (isinstance(target, str | Path) and Path(target).suffix.lower() == ".toml"):
        target = Scenario.of(target)
    if chaser_radius is None:
        chaser_radius = target.chaser.radius if isinstance(target, Scenario) else 0.5
    loaded, entry = mesh_of(target)
    part = part_of(progress, 0.0, 0.9) if certify else progress
    numbers = {"profile": profile, "chaser_radius": chaser_radius, "seed": seed}
    model = training.fit(loaded, **numbers, **how, progress=part)
    if entry is not None:
        located = entry.model_dump()
        if Path(entry.source).exists():
            located["source"] = str(Path(entry.source).resolve())
        model = model.with_training(target=located)
    if path is not None:
        model.save(path)  # before it is certified, so that a proof that is stopped loses nothing
    if certify:
        part = part_of(progress, 0.9, 1.0)
        model = _certify(model, loaded, chaser_radius=chaser_radius, seed=seed, progress=part)
        if path is not None:
            model.save(path)
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
