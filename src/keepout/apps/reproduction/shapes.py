"""The shapes that were learned: surfaces by marching cubes beside the mesh, and what they keep a chaser out of.

Volumes stand beside those of the exact solid, the convex hull and the smallest ellipsoid.
"""

import dataclasses
from typing import Any

import numpy as np

from keepout.apps.reproduction import figures, fitted
from keepout.apps.reproduction.figures import Triangles
from keepout.apps.reproduction.fitted import CHASER_RADII, OFFSET, SHIPPED, TARGETS
from keepout.apps.reproduction.work import Part, Table, Work
from keepout.core.fields.model import FieldModel
from keepout.core.geometry.target import Target, enclosed_volume
from keepout.flights.surface import (
    Surface,
    convex_hull,
    default_spacing,
    extract_surface,
    measure_volumes,
    smallest_ellipsoid,
    steepest_slope,
    surface_distance,
)

SAMPLES, QUICK_SAMPLES = 200_000, 10_000
"""On either surface, for the distances between them."""
QUICK_COARSENING = 2.0
"""Cells and leaves of the quick run are this many times as long."""
PRINTED_LEARNED, PRINTED_ELLIPSOID = 91.4, 270.6
"""m³, of Intersat-30 and of its ellipsoid."""


def surfaces(work: Work) -> Part:
    """Cut the zero level of every field there is, measure how far it lies from the mesh, and draw them."""
    rows: list[dict[str, Any]] = []
    drawings: dict[str, str] = {}
    enclosed = {}
    for stretch, name in work.stretches(TARGETS):
        target = fitted.target_of(name)
        shown = {"mesh": Triangles(target.vertices, target.faces)}
        best = shown["mesh"]
        fields = fitted.shown_fields(stretch, target, certified=False)
        for own, (label, model) in stretch.within(0.0, 0.9).stretches(fields.items()):
            own.progress(0.0, f"{name}: {label}")
            surface = _surface(own.within(0.0, 0.8), target, model)
            rows.append({"target": name, "field": label, **_distances(own, target, model, surface)})
            best = shown[f"f̃ = 0, {label}"] = Triangles(surface.vertices, surface.faces)
        figures.draw_surfaces(work.folder / f"surfaces-{name}.png", shown)
        drawings[f"surfaces-{name}"] = f"{name}: the mesh, and the zero level of the fields by marching cubes"
        enclosed[name] = (best, smallest_ellipsoid(target.vertices, 1e-5))
    figures.draw_ellipsoids(work.folder / "ellipsoids.png", enclosed)
    drawings["ellipsoids"] = "The zero level of the last of the fields in the smallest ellipsoid"
    return Part(
        name="surfaces",
        title="Estimated surfaces",
        paper=(
            "Marching cubes of the three learned fields show the three spacecraft, and one of them beside its "
            "ellipsoid; no number is given but the two volumes."
        ),
        ours=_of_surfaces(rows),
        rows=rows,
        tables=[
            Table(
                "surfaces",
                "The zero level against the part of the mesh that can be seen from outside: the mean distance both "
                "ways (Chamfer), the 95th percentile from level to mesh, and the largest either way (Hausdorff)",
                rows,
            )
        ],
        drawings=drawings,
    )


def _spacing(work: Work, target: Target) -> float:
    return default_spacing(target.distance) * (QUICK_COARSENING if work.quick else 1.0)


def _steepest(work: Work, target: Target, model: FieldModel) -> float:
    return steepest_slope(model.field, target.distance, count=2_000 if work.quick else 20_000, seed=work.seed)


def _surface(work: Work, target: Target, model: FieldModel) -> Surface:
    spacing = _spacing(work, target)

    def make() -> dict[str, np.ndarray]:
        steepest, progress = _steepest(work, target, model), work.progress
        surface = extract_surface(
            model.field, target.distance, 0.0, steepest=steepest, spacing=spacing, progress=progress
        )
        # A micrometre is far below what the cells resolve, and half the room.
        return {"vertices": surface.vertices.astype(np.float32), "faces": surface.faces.astype(np.int32)}

    found = work.arrays(f"surface-{target.name}", [model.sha256, spacing, work.quick, work.seed], make)
    return Surface(found["vertices"].astype(np.float64), found["faces"].astype(np.int64), spacing)


def _distances(work: Work, target: Target, model: FieldModel, surface: Surface) -> dict[str, Any]:
    count = QUICK_SAMPLES if work.quick else SAMPLES

    def make() -> dict[str, Any]:
        solid = fitted.solid_of(target.name, quick=work.quick)
        return dataclasses.asdict(surface_distance(surface, solid, 0.0, count=count, seed=work.seed))

    found = work.numbers(
        f"distance-{target.name}", [model.sha256, surface.spacing, count, work.seed, OFFSET, work.quick], make
    )
    return {
        "cells m": surface.spacing,
        "triangles": len(surface.faces),
        "Chamfer m": found["chamfer"],
        "p95 m": found["learned_to_target_95"],
        "Hausdorff m": found["hausdorff"],
    }


def _of_surfaces(rows: list[dict[str, Any]]) -> list[str]:
    labels = list(dict.fromkeys(row["field"] for row in rows))
    lines = []
    for label in labels:
        chosen = [row for row in rows if row["field"] == label]
        chamfer = ", ".join(f"{row['target']} {row['Chamfer m']:.3f} m" for row in chosen)
        farthest = ", ".join(f"{row['target']} {row['Hausdorff m']:.2f} m" for row in chosen)
        lines.append(f"{label}: mean distance between zero level and mesh {chamfer}; largest {farthest}.")
    if any(label == SHIPPED for label in labels):
        lines.append("The zero level of a shipped field is meant to lie 0.03 m, its skin δ, outside the mesh.")
    if any(label != SHIPPED for label in labels):
        lines.append(
            "With a skin of a millimetre the zero level may have holes in thin panels, wherever f̃ > 0 on the surface, "
            "and no e_h shows in such a picture. Keepout flies by f̃ = R + e_h, which the certificate keeps whole."
        )
    return lines


def volumes(work: Work) -> Part:
    """Measure the volumes of every field there is, at its zero level and at its certified levels."""
    rows: list[dict[str, Any]] = []
    for stretch, name in work.within(0.0, 0.99).stretches(TARGETS):
        target = fitted.target_of(name)
        fields = fitted.shown_fields(stretch.within(0.0, 0.5), target, certified=True)
        for own, (label, model) in stretch.within(0.5, 1.0).stretches(fields.items()):
            own.progress(0.0, f"{name}: {label}")
            rows += [{"target": name, "field": label, **row} for row in _measured(own, target, model)]
    return Part(
        name="volumes",
        title="Volumes",
        paper=(
            f"The learned shape of Intersat-30 holds {PRINTED_LEARNED} m³, its ellipsoidal envelope "
            f"{PRINTED_ELLIPSOID} m³: {PRINTED_ELLIPSOID / PRINTED_LEARNED:.2f} times as much."
        ),
        ours=_of_volumes(rows),
        rows=rows,
        tables=[
            Table(
                "volumes",
                "Volumes in m³ that the centre of a chaser of radius R is kept out of: by the level of the field; by "
                "the exact solid (R = 0: what the closed mesh encloses; else all within R of it, or sealed off); by "
                "the convex hull and the smallest ellipsoid, both grown by R",
                [_shown(row) for row in rows],
            )
        ],
    )


def _measured(work: Work, target: Target, model: FieldModel) -> list[dict[str, Any]]:
    """Measure one field: at its zero level for a point, and at each certified level."""
    levels = [(0.0, 0.0)] + [
        (certificate.chaser_radius, certificate.chaser_radius + certificate.error_bound)
        for certificate in model.certificates
        if certificate.chaser_radius in CHASER_RADII
    ]
    leaf = 2.0 * _spacing(work, target)

    def make() -> list[dict[str, Any]]:
        solid, steepest = fitted.solid_of(target.name, quick=work.quick), _steepest(work, target, model)
        how = {"steepest": steepest, "leaf": leaf, "seed": work.seed, "progress": work.progress}
        return [dataclasses.asdict(entry) for entry in measure_volumes(model.field, solid, levels, **how)]

    found = work.numbers(f"volumes-{target.name}", [model.sha256, levels, leaf, work.quick, work.seed, OFFSET], make)
    rows = []
    for entry in found:
        point = entry["chaser_radius"] == 0.0
        exact = enclosed_volume(target.vertices, target.faces) if point else entry["contact"]
        rows.append(
            {
                "chaser_radius_m": entry["chaser_radius"],
                "level_m": entry["level"],
                "field_m3": entry["learned"],
                "exact_m3": exact,
                "hull_m3": entry["hull"],
                "ellipsoid_m3": entry["ellipsoid"],
                "ellipsoid_over_field": entry["ellipsoid"] / entry["learned"],
                "standard_error_m3": entry["standard_error"],
            }
        )
    return rows


def _shown(row: dict[str, Any]) -> dict[str, Any]:
    """Give a row under the headings of the table, which must fit a terminal."""
    shapes = ("field", "exact", "hull", "ellipsoid")
    return {
        "target": row["target"],
        "field": row["field"],
        "R m": row["chaser_radius_m"],
        "level": "0" if row["level_m"] == 0.0 else "R + e_h",
        **{f"{shape} m³": _rounded(row[f"{shape}_m3"]) for shape in shapes},
    }


def _rounded(volume: float) -> float | int:
    return round(volume) if volume >= 1000.0 else round(volume, 1)


def _of_volumes(rows: list[dict[str, Any]]) -> list[str]:
    at_zero = [row for row in rows if row["level_m"] == 0.0]
    ratios = "; ".join(
        f"{row['target']}, {row['field']}: {row['field_m3']:.1f} m³, ellipsoid {row['ellipsoid_over_field']:.1f} times"
        for row in at_zero
    )
    target = fitted.target_of("intelsat30")
    exact = enclosed_volume(target.vertices, target.faces)
    ratio = smallest_ellipsoid(target.vertices, 1e-5).volume / exact
    hull = convex_hull(target.vertices)[1] / exact
    return [
        f"At the zero level: {ratios}.",
        f"A scaling changes both volumes alike, so their ratio tells shapes apart: the paper's is "
        f"{PRINTED_ELLIPSOID / PRINTED_LEARNED:.2f}; of the built-in intelsat30 the ellipsoid has {ratio:.1f} times "
        f"and the convex hull {hull:.1f} times what its mesh encloses. No scaling of the built-in gives the paper's "
        "ratio: its model, its ellipsoid or its field was another, and none is published.",
    ]
