"""The proved bounds of a grid field: from its coefficients, without search."""

import time

import numpy as np
from jaxtyping import Float, Int

from keepout.errors import FieldError
from keepout.fields.evaluate import values
from keepout.fields.grid import BLOCK, STORED, GridField
from keepout.fields.model import Certificate, FieldModel
from keepout.geometry.distance import ExactDistance
from keepout.geometry.level_points import level_points
from keepout.geometry.octree import CORNERS, straddling_cells
from keepout.geometry.target import Target

_WINDOW = np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
ROUNDING = 1e-9
"""Metres. Float64 evaluation of 64 products of coefficients below 1e4 m is far more exact than this."""
REFINEMENTS = 2


def certify_grid(model: FieldModel, target: Target, *, chaser_radius: float = 0.0, seed: int = 0) -> FieldModel:
    """Prove an error bound and a gradient bound of a grid field.

    The weights w_i of the 64 coefficients at p sum to 1, have mean p and variance h²/3 an axis, so Σ w_i ‖p - x_i‖ ≤ h
    by Jensen. With c_i ≤ d(x_i) + ε on p's cell and d 1-Lipschitz, f̃(p) ≤ d(p) + ε + h; every cell that can meet
    {d = R} counts. For nodes that hold the signed distance, ε = -δ.

    Raises:
        FieldError: not a grid field, another target's, or a radius too large for the domain.

    """
    start = time.perf_counter()
    field, distance = model.field, target.distance
    if not isinstance(field, GridField) or not isinstance(distance, ExactDistance):
        raise FieldError("certify_grid: needs a grid field of a mesh; `certify` is for neural fields")
    model.require_target(target, where="certify_grid")
    room = float(field.continuation.domain_radius - field.continuation.target_radius)
    if not 0.0 <= chaser_radius < room:
        raise FieldError(f"chaser radius {chaser_radius:g} m: for this field it must be 0 to {room:.3g} m")
    h = float(field.spacing)
    pad = chaser_radius + h
    centres, half = straddling_cells(
        distance, chaser_radius, leaf=h, lower=distance.lower - pad, upper=distance.upper + pad
    )
    bound = _largest_excess(field, distance, centres, half)
    generator = np.random.default_rng(seed)
    points = level_points(distance, chaser_radius, 100_000, generator)
    sampled = float(values(field, points).max()) - chaser_radius
    certificate = Certificate(
        kind="certified",
        chaser_radius=float(chaser_radius),
        error_bound=bound + ROUNDING,
        allowance=0.0,
        sampled_maximum=sampled,
        gradient_bound=_gradient_bound(field),
        gradient_kind="certified",
        evaluation_error=ROUNDING,
        seconds=time.perf_counter() - start,
        target_sha256=model.target_sha256,
        field_sha256=model.sha256,
    )
    return model.with_certificate(certificate)


def _largest_excess(
    field: GridField, distance: ExactDistance, centres: Float[np.ndarray, "n 3"], half: Float[np.ndarray, "n"]
) -> float:
    """Largest h + max (c_i - d(x_i)) over the cells that the cubes, no wider than a cell, can touch."""
    rows = []
    for corner in CORNERS:
        points = centres + corner * (half * (1.0 + 1e-9) + 1e-9)[:, None]
        number, level, cell, node = _locate(field, points)
        rows.append(np.unique(np.column_stack([number, level, cell, node]), axis=0))
    cells = np.unique(np.concatenate(rows), axis=0)
    coefficients = np.asarray(field.coefficients).reshape(-1, STORED, STORED, STORED)
    origin, worst = np.asarray(field.origin), -np.inf
    for first in range(0, len(cells), 4096):
        number, level = cells[first : first + 4096, 0], cells[first : first + 4096, 1]
        cell, node = cells[first : first + 4096, 2:5], cells[first : first + 4096, 5:8]
        at = cell[:, None, :] + _WINDOW
        c = coefficients[number[:, None], at[..., 0], at[..., 1], at[..., 2]].astype(np.float64)
        h = float(field.spacing) * 2.0**level
        x = origin + h[:, None, None] * (node[:, None, :] + _WINDOW - 1)
        d = distance.distance(x.reshape(-1, 3)).reshape(c.shape)
        worst = max(worst, float((h + (c - d).max(axis=1)).max()))
    return worst


def _locate(
    field: GridField, points: Float[np.ndarray, "n 3"]
) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"], Int[np.ndarray, "n 3"], Int[np.ndarray, "n 3"]]:
    """Block number, level, cell within the block, and the cell's lower node on its level, of the finest block there."""
    u = (points - np.asarray(field.origin)) / float(field.spacing)
    number, levels = np.full(len(points), -1), np.zeros(len(points), dtype=np.int64)
    node = np.zeros((len(points), 3), dtype=np.int64)
    for level in range(len(field.tables) - 1, -1, -1):
        table = np.asarray(field.tables[level])
        here = np.clip(np.floor(u / 2**level).astype(np.int64), 0, BLOCK * np.array(table.shape) - 1)
        found = table[tuple((here // BLOCK).T)]
        number, levels = np.where(found >= 0, found, number), np.where(found >= 0, level, levels)
        node = np.where((found >= 0)[:, None], here, node)
    return number, levels, node % BLOCK, node


def _subdivided(c: Float[np.ndarray, "m a b c"]) -> Float[np.ndarray, "m d e f"]:
    """Coefficients of the same cubic splines on half the spacing."""
    for axis in (1, 2, 3):
        c = np.moveaxis(c, axis, -1)
        finer = np.empty((*c.shape[:-1], 2 * c.shape[-1] - 3))
        finer[..., 0::2] = 0.5 * (c[..., :-1] + c[..., 1:])
        finer[..., 1::2] = (c[..., :-2] + 6.0 * c[..., 1:-1] + c[..., 2:]) / 8.0
        c = np.moveaxis(finer, -1, axis)
    return c


def _cell_bounds(c: Float[np.ndarray, "m a b c"], spacing: Float[np.ndarray, "m"]) -> Float[np.ndarray, "m"]:
    """For each block, a bound of the gradient: a derivative is a mean of the coefficient differences about a cell."""
    total = np.zeros(1)
    for axis in (1, 2, 3):
        difference = np.abs(np.diff(c, axis=axis))
        for along in (1, 2, 3):
            size = 3 if along == axis else 4
            count = difference.shape[along] - size + 1
            parts = [np.take(difference, np.arange(k, k + count), axis=along) for k in range(size)]
            difference = np.maximum.reduce(parts)
        total = total + (difference / spacing[:, None, None, None]) ** 2
    return np.sqrt(total.reshape(len(c), -1).max(axis=1))


def _gradient_bound(field: GridField) -> float:
    """Return a bound of ‖∇f̃‖ in the domain; blocks that decide it are refined by subdivision, which tightens it."""
    c = np.asarray(field.coefficients, dtype=np.float64).reshape(-1, STORED, STORED, STORED)
    spacing = np.zeros(len(c))
    for level, table in enumerate(field.tables):
        numbers = np.asarray(table)
        spacing[numbers[numbers >= 0]] = float(field.spacing) * 2**level
    bound = _cell_bounds(c, spacing)
    for refinement in range(1, REFINEMENTS + 1):
        order = np.argsort(-bound)
        # Only the blocks above the refined bound of the worst one can still matter.
        floor = 0.0
        for first in range(0, len(order), 16):
            chosen = order[first : first + 16]
            if bound[chosen].max() <= floor:
                break
            finer = c[chosen]
            for _ in range(refinement):
                finer = _subdivided(finer)
            bound[chosen] = np.minimum(bound[chosen], _cell_bounds(finer, spacing[chosen] / 2**refinement))
            floor = max(floor, float(bound[chosen].max()))
    return float(bound.max()) * (1.0 + 1e-9)
