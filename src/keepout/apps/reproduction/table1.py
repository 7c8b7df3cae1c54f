"""The paper's Table I: how far learned fields lie from zero on the surface, sampled as the paper does, and proved."""

import dataclasses
import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from keepout.apps.reproduction import fitted
from keepout.apps.reproduction.figures import draw_sinking, draw_training
from keepout.apps.reproduction.fitted import (
    DEFAULT,
    DEVIATIONS,
    GRADIENT_BAND,
    OFFSET,
    PAPER_NETWORK,
    PRINTED,
    SHIPPED,
    TARGETS,
    gradient_errors,
)
from keepout.apps.reproduction.work import Part, Table, Work
from keepout.core.fields import load_shipped
from keepout.core.fields.field import values
from keepout.core.fields.model import FieldModel
from keepout.core.fields.neural import NeuralField
from keepout.core.geometry.distance import ExactDistance
from keepout.core.geometry.level_set import surface_points
from keepout.core.geometry.target import Target
from keepout.core.measures.quality import summarised
from keepout.core.proof import bounds

PRINTED_TABLE = {
    "iss": (0.0011, 0.0011, 0.019),
    "tiangong": (0.002, 0.0013, 0.012),
    "intelsat30": (0.0015, 0.0014, 0.031),
}
"""ε, ε₊ and e_h as printed; without units."""
POINTS, QUICK_POINTS = 100_000, 20_000
"""On the surface, uniform by area: the paper's number, and what the quick run takes."""
GRADIENT_POINTS, QUICK_GRADIENT_POINTS = 50_000, 4_000
THIN_SKIN = 0.005
"""Metres. Where a field's skin δ is thicker, it decides ε; the numbers with δ added back have a row of their own."""
PIECE_SIZES = (0.1, 0.03, 0.01)
"""Metres: about the longest edges of the triangles over which the paper's network is bounded, to see what a proof would
take."""
PIECES = 128
KINDS = ("sampled", "found", "proved")
"""Of e_h: the largest on the samples, the largest that a search met, and what is proved."""
TARGET_OF_PRINTED = "intelsat30"


_READINGS = (
    "Table I read twice: the paper's network in metres, and divided by the radius of the target's ball, which is the "
    "unit it was trained in; over printed: the latter over what is printed"
)
_PROOF_ATTEMPT = (
    "Bounding the paper's network over small triangles of the mesh: the median of bound less value, what float32 may "
    "add, the time a triangle takes, and the time to cover the mesh"
)


def table1(work: Work) -> Part:
    """Measure every field of the three targets on the surface and off it, and show how the paper's network trains."""
    errors: list[dict[str, Any]] = []
    slopes: list[dict[str, Any]] = []
    proofs: list[dict[str, Any]] = []
    networks: dict[str, FieldModel] = {}
    reachable: dict[str, float] = {}
    for stretch, name in work.within(0.0, 0.9).stretches(TARGETS):
        stretch.progress(0.0, name)
        target = fitted.target_of(name)
        models = _models(stretch.within(0.0, 0.9), target)
        if PAPER_NETWORK.label in models:
            networks[name] = models[PAPER_NETWORK.label]
        epsilon, epsilon_plus, bound = PRINTED_TABLE[name]
        printed = (epsilon, epsilon_plus, bound, None, None)
        errors.append(_row(name, "paper, no units", "all", printed))
        for label, model in models.items():
            surface, gradient = _measured(stretch, target, model)
            errors += _error_rows(name, label, model, surface)
            reachable[name] = surface["share reachable"]
            slopes.append({"target": name, "field": label, **gradient})
            if label == PAPER_NETWORK.label:
                proofs += [{"target": name, **row} for row in _proof_attempt(stretch, target, model)]
    drawings = _drawings(work.within(0.9, 1.0), networks)
    rows = [{"table": "errors", **row} for row in errors] + [{"table": "gradient_error", **row} for row in slopes]
    readings = _readings(errors, {name: _radius(model) for name, model in networks.items()})
    tables = [
        Table(
            "errors",
            f"f̃ in metres on {_count(work):,} points of the surface, where the exact distance is zero",
            [_shown(row) for row in errors],
        ),
        Table(
            "gradient_error",
            f"‖∇d − ∇f̃‖ outside, up to {GRADIENT_BAND[1]:g} m from the surface, where ∇d is defined",
            slopes,
        ),
        Table("readings", _READINGS, readings),
        Table("proof_attempt", _PROOF_ATTEMPT, proofs),
    ]
    return Part(
        name="table1",
        title="Table I: errors on the surface",
        paper=(
            "ε, ε₊ and e_h, ε and ε₊ on 100,000 points uniform over the surface: "
            + "; ".join(f"{printed} {', '.join(map(str, PRINTED_TABLE[name]))}" for name, printed in TARGETS.items())
            + ". It gives no units, neither the scale of its meshes nor how e_h was found; e_h is read as the largest "
            "over-statement that was sampled."
        ),
        ours=_found(errors, slopes, proofs, reachable, readings),
        rows=rows,
        tables=[table for table in tables if table.rows],
        drawings=drawings,
    )


def _count(work: Work) -> int:
    return QUICK_POINTS if work.quick else POINTS


def _models(work: Work, target: Target) -> dict[str, FieldModel]:
    """Give the fields of a target by label; a full run fits those that there are not."""
    models = {SHIPPED: load_shipped(target.name, target=target)}
    for stretch, (recipe, fitting) in work.stretches(((DEFAULT, True), (PAPER_NETWORK, work.fields is None))):
        model = fitted.field_of(stretch, recipe, target, fitting=fitting and not work.quick)
        if model is not None:
            models[recipe.label] = model
    return models


def _measured(work: Work, target: Target, model: FieldModel) -> tuple[dict[str, Any], dict[str, Any]]:
    """Summarise f̃ on all surface points and on those that can be reached, with and without δ added back; and ∇f̃.

    Returns:
        The former by points and what was added, with the share of points that can be reached; and the latter.

    """
    count = _count(work)
    gradient_count = QUICK_GRADIENT_POINTS if work.quick else GRADIENT_POINTS

    def make() -> dict[str, Any]:
        work.progress(0.95, f"{target.name}: {count} points")
        solid = fitted.solid_of(target.name, quick=work.quick)
        points = surface_points(target.distance, count, np.random.default_rng(work.seed))
        value, reachable = values(model.field, points), _reachable(work, target, count)
        return {
            **{
                f"{points}, {added:g} m added": dataclasses.asdict(summarised(chosen + added))
                for points, chosen in (("all", value), ("visible", value[reachable]))
                for added in (0.0, model.offset)
            },
            "share reachable": float(reachable.mean()),
            "gradient": dataclasses.asdict(
                gradient_errors(
                    model.field,
                    solid,
                    nearest=GRADIENT_BAND[0],
                    farthest=GRADIENT_BAND[1],
                    count=gradient_count,
                    seed=work.seed,
                )
            ),
        }

    made_of = [model.sha256, count, gradient_count, GRADIENT_BAND, work.seed, work.quick, OFFSET]
    found = work.numbers(f"errors-{target.name}", made_of, make)
    gradient = found.pop("gradient")
    return found, gradient


def _reachable(work: Work, target: Target, count: int) -> np.ndarray:
    """Say of the surface points which a chaser could come to: not those inside parts that are sealed off."""

    def make() -> dict[str, np.ndarray]:
        points = surface_points(target.distance, count, np.random.default_rng(work.seed))
        return {"reachable": fitted.solid_of(target.name, quick=work.quick).is_reachable(points)}

    made_of = [target.sha256, count, work.seed, work.quick, OFFSET]
    return work.arrays(f"reachable-{target.name}", made_of, make)["reachable"]


def _row(target: str, field: str, points: str, numbers: tuple[float | None, ...]) -> dict[str, Any]:
    names = ("epsilon", "epsilon_plus", *(f"e_h_{kind}" for kind in KINDS))
    return {"target": target, "field": field, "points": points, **dict(zip(names, numbers, strict=True))}


def _shown(row: dict[str, Any]) -> dict[str, Any]:
    """Give a row of errors under the headings of the table, which must fit a terminal; to 0.01 mm."""
    field = row["field"] if row["points"] == "all" else f"{row['field']}, {row['points']}"
    headings = {"ε": "epsilon", "ε₊": "epsilon_plus"} | {f"e_h {kind}": f"e_h_{kind}" for kind in KINDS}
    rounded = {heading: None if row[key] is None else round(row[key], 5) for heading, key in headings.items()}
    return {"target": row["target"], "field": field, **rounded}


def _error_rows(target: str, label: str, model: FieldModel, surface: dict[str, Any]) -> list[dict[str, Any]]:
    certificate = next((c for c in model.certificates if c.chaser_radius == 0.0), None)
    rows = []
    for added, field in ((0.0, label), (model.offset, f"{label}, added back")):
        if added and model.offset <= THIN_SKIN:
            continue
        for points in ("all", "visible"):
            found = surface[f"{points}, {added:g} m added"]
            searched = proved = None
            # Search and proof see the whole surface.
            if certificate is not None and points == "all":
                searched = certificate.sampled_maximum + added
                proved = certificate.error_bound + added if certificate.kind == "certified" else None
            numbers = (found["epsilon"], found["epsilon_plus"], found["maximum"], searched, proved)
            rows.append(_row(target, field, points, numbers))
    return rows


def _radius(model: FieldModel) -> float:
    """Give the radius of the ball in which a network was trained, m."""
    assert isinstance(model.field, NeuralField)
    return float(model.field.scale)


def _readings(errors: list[dict[str, Any]], radii: Mapping[str, float]) -> list[dict[str, Any]]:
    """Give each cell of the paper's table beside the paper's network's, in metres and in radii of the target's ball."""
    rows = []
    for row in errors:
        if row["field"] != PAPER_NETWORK.label or row["points"] != "all":
            continue
        radius = radii[row["target"]]
        measured = (row["epsilon"], row["epsilon_plus"], row["e_h_sampled"])
        for name, printed, value in zip(("ε", "ε₊", "e_h"), PRINTED_TABLE[row["target"]], measured, strict=True):
            rows.append(
                {
                    "target": row["target"],
                    "of": name,
                    "printed": printed,
                    "m": round(value, 4),
                    "radius m": round(radius, 2),
                    "radii": round(value / radius, 5),
                    "printed m": round(printed * radius, 3),
                    "over printed": round(value / radius / printed, 2),
                    "worse in m": round(value / printed, 1),
                }
            )
    return rows


def _proof_attempt(work: Work, target: Target, model: FieldModel) -> list[dict[str, Any]]:
    """Bound a network over triangles of three sizes, cut from random places of the surface.

    Returns:
        For each size: the median of bound less value, what the bound of the rounding in float32 comes to, the time an
        element takes on one core, and the core hours for as many such elements as cover the surface.

    """
    field, distance = model.field, target.distance
    assert isinstance(field, NeuralField)
    assert isinstance(distance, ExactDistance)

    def make() -> list[dict[str, Any]]:
        generator = np.random.default_rng(work.seed)
        network = bounds.Network.of(field.layers, field.beta)
        middles = surface_points(distance, PIECES, generator)
        _, _, face = distance.closest(middles)
        corners = distance.vertices[distance.faces[face]]
        edges = corners - corners.mean(axis=1, keepdims=True)
        edges /= np.linalg.norm(edges[:, [1, 2, 0]] - edges, axis=2).max(axis=1)[:, None, None]
        scale, centre, rows = float(field.scale), np.asarray(field.continuation.centre), []
        value = values(field, middles)
        for size in PIECE_SIZES:
            pieces = middles[:, None] + size * edges
            area = np.linalg.norm(np.cross(pieces[:, 1] - pieces[:, 0], pieces[:, 2] - pieces[:, 0]), axis=1) / 2.0
            start = time.perf_counter()
            found = bounds.upper_bounds(network, bounds.triangles((pieces - centre) / scale))
            seconds = (time.perf_counter() - start) / PIECES
            needed = distance.area / float(area.mean())
            rows.append(
                {
                    "triangle m": size,
                    "above value m": float(np.median(scale * found.upper - value)),
                    "float32 m": float(np.median(scale * found.evaluation_error)),
                    "ms each": 1e3 * seconds,
                    "core hours": needed * seconds / 3600.0,
                }
            )
        return rows

    return work.numbers(f"proof-{target.name}", [model.sha256, PIECE_SIZES, PIECES, work.seed], make)


def _drawings(work: Work, networks: dict[str, FieldModel]) -> dict[str, str]:
    """Draw the training curves of what was fitted."""
    drawings = {}
    curves = {name: model.training["curve"] for name, model in networks.items() if "curve" in model.training}
    if curves:
        draw_training(work.folder / "training.png", curves)
        drawings["training"] = "Training of the paper's network: both terms of the loss, and the mean of f̃ − d"
    target = fitted.target_of(TARGET_OF_PRINTED)
    printed = fitted.field_of(work, PRINTED, target, fitting=not work.quick and work.fields is None)
    if printed is not None and TARGET_OF_PRINTED in curves:
        readings = {"L_P as printed": printed.training["curve"], "pinball reading": curves[TARGET_OF_PRINTED]}
        draw_sinking(work.folder / "sinking.png", readings)
        drawings["sinking"] = (
            f"{TARGET_OF_PRINTED}: the mean of f̃ − d under the printed L_P and under its pinball reading"
        )
    return drawings


def _found(
    errors: list[dict[str, Any]],
    slopes: list[dict[str, Any]],
    proofs: list[dict[str, Any]],
    reachable: Mapping[str, float],
    readings: list[dict[str, Any]],
) -> list[str]:
    """Say in plain sentences what the tables hold."""

    def figures(field: str, key: str) -> str:
        chosen = [row for row in errors if row["field"] == field and row["points"] == "all" and row[key] is not None]
        return ", ".join(f"{row['target']} {row[key]:.4f} m" for row in chosen)

    lines = [
        f"The shipped fields stand off by their skin δ = 0.03 m, so their ε cannot be less: "
        f"{figures(SHIPPED, 'epsilon')}; with δ added back {figures(f'{SHIPPED}, added back', 'epsilon')}, and the "
        f"bounds that are proved, likewise: {figures(f'{SHIPPED}, added back', 'e_h_proved')}."
    ]
    if figures(DEFAULT.label, "epsilon"):
        lines.append(
            f"The default network with a skin of {1e3 * OFFSET:g} mm: ε {figures(DEFAULT.label, 'epsilon')}; largest "
            f"sampled {figures(DEFAULT.label, 'e_h_sampled')}; proved {figures(DEFAULT.label, 'e_h_proved')}. Its loss "
            "weighs over-statement more than under-statement, so it lies low, which ε counts and safety does not. A "
            "thinner skin would change little: ε is many times the skin."
        )
    if figures(PAPER_NETWORK.label, "epsilon"):
        lines += [
            f"The paper's network, 10 x 512, pinball reading of L_P, η = 0.1, a skin of {1e3 * OFFSET:g} mm: ε "
            f"{figures(PAPER_NETWORK.label, 'epsilon')}; largest sampled "
            f"{figures(PAPER_NETWORK.label, 'e_h_sampled')}.",
            f"Where its training departs from the paper or the paper is silent: {DEVIATIONS}",
            _of_readings(readings),
        ]
    else:
        lines.append(
            "No field of the paper's network is there: --fields names a folder of them, and a full run without it fits "
            "them, an hour or two a target."
        )
    lines += _of_proofs(proofs)
    shares = ", ".join(f"{name} {100.0 * share:.1f} %" for name, share in reachable.items())
    lines += [
        "The paper counts every point of the mesh, and so does every row that does not say visible. A chaser can come "
        f"to {shares} of them; the rest lies in gaps and parts that are sealed off: there a field need only stay low.",
        "e_∇h is not printed. It bounds ‖∇d − ∇f̃‖; found within "
        + f"{GRADIENT_BAND[1]:g} m: "
        + "; ".join(
            f"{row['target']}, {row['field']}: 95 % below {row['percentile_95']:.2f}, largest {row['maximum']:.2f}"
            for row in slopes
        )
        + ". ∇d jumps where two surfaces are equally near, so no smooth field comes much below 1 at the largest.",
    ]
    return lines


def _of_readings(readings: list[dict[str, Any]]) -> str:
    """Say which reading of the paper's table agrees, and what the other would do to a barrier."""
    factors, worse = ([row[key] for row in readings] for key in ("over printed", "worse in m"))
    bound = next(row for row in readings if (row["target"], row["of"]) == (TARGET_OF_PRINTED, "e_h"))
    return (
        f"Read in radii of the target's ball, the unit in which fields are trained, the {len(readings)} cells of the "
        f"paper's table and this network's agree within factors of {min(factors):.2g} to {max(factors):.2g}. Read as "
        f"metres, this network is {min(worse):.0f} to {max(worse):.0f} times worse. So radii are what agrees, and it "
        f"matters: e_h of {TARGETS[TARGET_OF_PRINTED]} is {bound['printed m']:.2f} m then. A barrier that takes "
        f"{bound['printed']:g} for metres is not safe."
    )


def _of_proofs(proofs: list[dict[str, Any]]) -> list[str]:
    finest = [row for row in proofs if row["triangle m"] == min(PIECE_SIZES)]
    if not finest:
        return []
    each = "; ".join(
        f"{row['target']}: {row['above value m']:.2g} m above the value, {row['core hours']:.2g} core hours to cover "
        f"the mesh, {row['float32 m']:.2g} m for rounding"
        for row in finest
    )
    return [
        f"A proof was tried for the paper's network, over triangles of {1e3 * min(PIECE_SIZES):g} mm: {each}. What "
        "float32 may add in ten layers of 512 is bounded by so much however small the triangles are, so no e_h worth "
        "having can be proved this way: the one shown is sampled, and proves nothing."
    ]
