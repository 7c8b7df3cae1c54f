"""The learned surfaces of the three targets by marching cubes, beside the mesh and the smallest ellipsoid."""

import dataclasses
from typing import Any

import numpy as np

from keepout.apps.reproduction import figures, fitted
from keepout.apps.reproduction.figures import Triangles
from keepout.apps.reproduction.fitted import OFFSET, SHIPPED, TARGETS
from keepout.apps.reproduction.work import Drawing, Part, Table, Work
from keepout.core.fields.model import FieldModel
from keepout.core.geometry.target import Target
from keepout.core.measures.surface import (
    Surface,
    default_spacing,
    extract_surface,
    smallest_ellipsoid,
    steepest_slope,
    surface_distance,
)

SAMPLES, QUICK_SAMPLES = 200_000, 10_000
"""On either surface, for the distances between them."""
QUICK_COARSENING = 2.0
"""Cells of the quick run are this many times as long."""


def surfaces(work: Work) -> Part:
    """Cut the zero level of every field there is, measure how far it lies from the mesh, and draw them."""
    rows: list[dict[str, Any]] = []
    drawings: list[Drawing] = []
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
        drawings.append(
            Drawing(f"surfaces-{name}", f"{name}: the mesh, and the zero level of the fields by marching cubes")
        )
        enclosed[name] = (best, smallest_ellipsoid(target.vertices, 1e-5))
    figures.draw_ellipsoids(work.folder / "ellipsoids.png", enclosed)
    drawings.append(Drawing("ellipsoids", "The zero level of the last of the fields in the smallest ellipsoid"))
    return Part(
        name="surfaces",
        title="Estimated surfaces",
        paper=(
            "Marching cubes of the three learned fields show the three spacecraft, and one of them beside its "
            "ellipsoid; no number is given but the two volumes."
        ),
        ours=_found(rows),
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


def _surface(work: Work, target: Target, model: FieldModel) -> Surface:
    spacing = _spacing(work, target)

    def make() -> dict[str, np.ndarray]:
        field, distance = model.field, target.distance
        steepest = steepest_slope(field, distance, count=2_000 if work.quick else 20_000, seed=work.seed)
        surface = extract_surface(field, distance, 0.0, steepest=steepest, spacing=spacing, progress=work.progress)
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


def _found(rows: list[dict[str, Any]]) -> list[str]:
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
