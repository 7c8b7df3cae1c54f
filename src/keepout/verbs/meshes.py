"""Meshes as verbs take them, and the verb describe. Needs no JAX."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from keepout.core.errors import FieldError, ScenarioError, UsageError
from keepout.core.geometry.builtin import BUILTINS
from keepout.core.geometry.offset_solid import OffsetSolid
from keepout.core.geometry.target import Target
from keepout.core.mission.entries import TargetEntry
from keepout.core.mission.scenario import Scenario, ScenarioLike
from keepout.core.mission.target import load_target
from keepout.core.progress import Progress, part_of, silent
from keepout.flights.pages.folder import results_in

if TYPE_CHECKING:
    from keepout.core.fields.model import FieldModel

MeshLike = Target | TargetEntry | ScenarioLike
"""A target, already loaded; a built-in target's name or the path of a mesh file; or a `ScenarioLike`, whose target."""

CLOSING_RADIUS, OFFSET = 0.25, 0.03
"""Of the two solids whose sealed volumes are compared, m: the other one's closing radius is the offset."""
LARGEST_CHANGE = 0.2
"""Part of the larger sealed volume by which the two may differ without a warning."""
_COUNTED = ("triangles", "points", "parts", "open_edges", "non_manifold_edges", "degenerate_faces", "stray_parts")


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
        summary |= survey(target, progress=part_of(progress, 0.0, 0.95))
        if folder is not None:
            from keepout.flights.pages.mesh_pictures import draw_target

            draw_target(folder / f"{target.name}.png", target)
            summary["picture"] = str(folder / f"{target.name}.png")
    return summary


def survey(target: Target, *, progress: Progress = silent) -> dict[str, Any]:
    """Survey a target: its mesh report, and the volumes that its offset solid seals at two closing radii.

    Args:
        target: as loaded.
        progress: called as the two solids are built.

    Returns:
        Plain values: `points` are the balls of a point cloud; `sealed_volume_at_offset` is sealed with a closing radius
        as small as the offset; `envelope` is the most by which the offset solid's distance lies below the exact one,
        away from sealed gaps; `warnings` and `actions` are one line each.

    """
    start, report = time.perf_counter(), target.report

    def build(radius: float, part: float) -> OffsetSolid:
        told = part_of(progress, part, part + 0.5)
        return OffsetSolid.build(target.distance, offset=OFFSET, closing_radius=radius, progress=told)

    # One after the other, so that only one solid is in memory.
    closed = build(CLOSING_RADIUS, 0.0)
    volume, envelope = closed.sealed_volume, closed.envelope
    del closed
    at_offset = build(OFFSET, 0.5).sealed_volume
    leak = leak_warning(at_offset, volume)
    return {
        "name": target.name,
        "sha256": target.sha256,
        **{name: getattr(report, name) for name in (*_COUNTED, "watertight", "lower", "upper", "extents")},
        "offset": OFFSET,
        "closing_radius": CLOSING_RADIUS,
        "sealed_volume_at_offset": at_offset,
        "sealed_volume": volume,
        "envelope": envelope,
        "warnings": report.warnings + ((leak,) if leak else ()),
        "actions": report.actions,
        "seconds": time.perf_counter() - start,
    }


def leak_warning(at_offset: float, sealed: float) -> str | None:
    """Say that a compartment has a gap in its wall, where the volumes (m³) sealed at the two radii differ."""
    if abs(sealed - at_offset) <= LARGEST_CHANGE * max(at_offset, sealed):
        return None
    return (
        f"sealed volume {at_offset:.4g} m³ at a closing radius of {OFFSET:g} m but {sealed:.4g} m³ at "
        f"{CLOSING_RADIUS:g} m: a compartment leaks through a gap; a chaser wider than {2.0 * CLOSING_RADIUS:g} m "
        "cannot pass it, and it is sealed"
    )


def _lengths(entry: TargetEntry) -> str:
    """Say in which unit a mesh's report is, and what the file's numbers were taken for."""
    if entry.scale is not None:
        return f"m; one unit of the file is {entry.scale:g} m, as given"
    if entry.units is not None:
        return f"m; the file's numbers are in {entry.units}, as given"
    if not Path(entry.source).exists():
        return "m"  # a built-in target
    return "m; no --units or --scale was given, so the file's own unit holds, or metres where it names none"
