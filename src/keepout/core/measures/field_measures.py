"""Everything that is measured of a field in one record: errors, curvature, surface, and what certificates cost."""

from dataclasses import asdict
from typing import Any

from keepout.core.compiled.kept_programs import keep_programs
from keepout.core.fields.model import FieldModel
from keepout.core.geometry.offset_solid import OffsetSolid
from keepout.core.geometry.target import Target
from keepout.core.measures.quality import curvature, distance_errors, margin_cost, surface_errors
from keepout.core.measures.surface import Surface, extract_surface, steepest_slope, surface_distance
from keepout.core.measures.volume import measure_volumes
from keepout.core.progress import Progress, part_of, silent

BANDS = ((0.05, 1.0), (1.0, 5.0))
"""Metres. Distances from the surface that count as near and far."""
CURVATURE_LEVELS = (0.1, 0.3, 1.0)
"""Metres. Distances from the surface at which the Hessian is measured."""


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
        "near": {"from_m": BANDS[0][0], "to_m": BANDS[0][1], **asdict(near)},
        "far": {"from_m": BANDS[1][0], "to_m": BANDS[1][1], **asdict(far)},
        "curvature": [asdict(entry) for entry in curvatures],
        "surface": asdict(apart),
        "volumes": [asdict(entry) for entry in volumes],
        "certificates": [
            asdict(certificate)
            | {
                "margin": asdict(
                    margin_cost(
                        field,
                        solid,
                        error_bound=certificate.error_bound,
                        chaser_radius=certificate.chaser_radius,
                        seed=seed,
                    )
                )
            }
            for certificate in certificates
        ],
    }
    progress(1.0, "")
    return summary, surface
