"""Meshes as verbs take them, and the verb describe. Needs no JAX."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

from keepout.core.errors import FieldError, ScenarioError, UsageError
from keepout.core.geometry.builtin import BUILTINS
from keepout.core.geometry.target import Target, survey
from keepout.core.mission.entries import TargetEntry
from keepout.core.mission.scenario import Scenario, ScenarioLike
from keepout.core.mission.target import load_target
from keepout.core.progress import Progress, part_of, silent
from keepout.flights.pages.folder import results_in

if TYPE_CHECKING:
    from keepout.core.fields.model import FieldModel

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


def recorded_target(path: Path | str, model: "FieldModel", mesh: str | None = None) -> TargetEntry:
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
            from keepout.flights.pages.mesh_pictures import draw_target

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
