"""The verb `measure`: a field against its mesh."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from keepout.core.compiled.kept_programs import keep_programs
from keepout.core.fields.model import FieldModel
from keepout.core.geometry.offset_solid import OffsetSolid
from keepout.core.geometry.target import Target
from keepout.core.measures.quality import curvature, distance_errors, margin_cost, surface_errors
from keepout.core.mission.build import load_model
from keepout.core.mission.scenario import Scenario, ScenarioLike
from keepout.core.mission.target import load_target
from keepout.core.progress import Progress, part_of, silent
from keepout.flights.pages.folder import results_in
from keepout.flights.pages.mesh_pictures import draw_slices, draw_surface
from keepout.flights.surface import Surface, extract_surface, measure_volumes, steepest_slope, surface_distance
from keepout.verbs.fields import field_named
from keepout.verbs.meshes import MeshLike, mesh_of, recorded_target

BANDS = ((0.05, 1.0), (1.0, 5.0))
"""Metres. Distances from the surface that count as near and far."""
CURVATURE_LEVELS = (0.1, 0.3, 1.0)
"""Metres. Distances from the surface at which the Hessian is measured."""


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
        model = field if isinstance(field, FieldModel) else field_named(field)
        mesh = load_target(recorded_target(model.target_name, model)) if mesh is None else mesh
        model.require_target(mesh, where="field")
    return measured(model, mesh, None if out is None else Path(out), seed=seed, progress=progress)


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
