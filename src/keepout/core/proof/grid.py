"""The proved bounds of a grid field: from its coefficients, without search."""

import time

import numpy as np
from jaxtyping import Float, Int

from keepout.core.errors import FieldError
from keepout.core.fields.evaluate import values
from keepout.core.fields.grid import BLOCK, STORED, GridField
from keepout.core.fields.model import Certificate, FieldModel
from keepout.core.geometry.distance import ExactDistance
from keepout.core.geometry.level_set import level_points
from keepout.core.geometry.octree import straddling_cells
from keepout.core.geometry.target import Target
from keepout.core.proof.grid_slope import grid_slope
from keepout.core.proof.grid_spline import joined_spline

_WINDOW = np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
ROUNDING = 1e-9
"""Metres. Float64 evaluation of 64 products of coefficients below 1e4 m is far more exact than this."""


def certify_grid(model: FieldModel, target: Target, *, chaser_radius: float = 0.0, seed: int = 0) -> FieldModel:
    """Prove an error bound and a gradient bound of a grid field.

    The weights w_i of the 64 coefficients at p sum to 1, have mean p and variance h²/3 an axis. Let n be the target's
    point nearest to p: d(x_i) ≤ ‖x_i - n‖, and Σ w_i ‖x_i - n‖ ≤ √(Σ w_i ‖x_i - n‖²) = √(‖p - n‖² + h²). So where
    c_i ≤ d(x_i) + ε on p's cell, f̃(p) ≤ √(d(p)² + h²) + ε; every cell that can meet {d = R} counts. For nodes that
    hold the signed distance, ε = -δ. Lowering only lowers f̃. The gradient bound is that of a function within
    `evaluation_error` of f̃, everywhere (`grid_spline`, `grid_slope`).

    Raises:
        FieldError: not a grid field, another target's, blocks that do not nest or leave out part of the
            domain, or a radius too large for it.

    """
    start = time.perf_counter()
    field, distance = model.field, target.distance
    if not isinstance(field, GridField) or not isinstance(distance, ExactDistance):
        raise FieldError("certify_grid: needs a grid field of a mesh; `certify` is for neural fields")
    model.require_target(target, where="certify_grid")
    room = float(field.continuation.domain_radius - field.continuation.target_radius)
    if not 0.0 <= chaser_radius < room:
        raise FieldError(f"chaser radius {chaser_radius:g} m: for this field it must be 0 to {room:.3g} m")
    _require_cover(field)
    h = float(field.spacing)
    pad = chaser_radius + h
    centres, half = straddling_cells(
        distance, chaser_radius, leaf=h, lower=distance.lower - pad, upper=distance.upper + pad
    )
    bound = _largest_excess(field, distance, float(chaser_radius), centres, half)
    spline = joined_spline(field)
    slope = grid_slope(field, spline)
    generator = np.random.default_rng(seed)
    points = level_points(distance, chaser_radius, 100_000, generator)
    sampled = float(values(field, points).max()) - chaser_radius
    certificate = Certificate(
        kind="certified",
        chaser_radius=float(chaser_radius),
        error_bound=bound + ROUNDING,
        allowance=0.0,
        sampled_maximum=sampled,
        gradient_bound=slope.proved,
        gradient_kind="certified",
        evaluation_error=spline.difference + ROUNDING,
        seconds=time.perf_counter() - start,
        target_sha256=model.target_sha256,
        field_sha256=model.sha256,
        gradient_found=slope.found,
    )
    return model.with_certificate(certificate)


def _require_cover(field: GridField) -> None:
    """Refuse a grid that does not hold the ball from which the continuation asks."""
    c = field.continuation
    reach = 0.5 * float(c.domain_radius + c.outer_radius)
    sides = BLOCK * float(field.spacing) * 2.0 ** (len(field.tables) - 1) * np.array(field.tables[-1].shape)
    low = np.asarray(field.origin) - (np.asarray(c.centre) - reach)
    if (low > 0.0).any() or (low + sides < 2.0 * reach).any():
        raise FieldError(
            f"grid field: its grid of {sides.tolist()} m from {np.asarray(field.origin).tolist()} does not hold the "
            f"ball of {reach:g} m in which it is asked"
        )


def _largest_excess(
    field: GridField,
    distance: ExactDistance,
    radius: float,
    centres: Float[np.ndarray, "n 3"],
    half: Float[np.ndarray, "n"],
) -> float:
    """Largest √(R² + h²) - R + max (c_i - d(x_i)) over the cells that the cubes, no wider than a cell, can touch."""
    number, level, node = _touched(field, centres, half)
    coefficients = np.asarray(field.coefficients).reshape(-1, STORED, STORED, STORED)
    origin, worst = np.asarray(field.origin), -np.inf
    for first in range(0, len(number), 4096):
        part = slice(first, first + 4096)
        at = (node[part] % BLOCK)[:, None, :] + _WINDOW
        c = coefficients[number[part, None], at[..., 0], at[..., 1], at[..., 2]].astype(np.float64)
        h = float(field.spacing) * 2.0 ** level[part]
        x = origin + h[:, None, None] * (node[part, None, :] + _WINDOW - 1)
        d = distance.distance(x.reshape(-1, 3)).reshape(c.shape)
        worst = max(worst, float((np.hypot(radius, h) - radius + (c - d).max(axis=1)).max()))
    return worst


def _touched(
    field: GridField, centres: Float[np.ndarray, "n 3"], half: Float[np.ndarray, "n"]
) -> tuple[Int[np.ndarray, "m"], Int[np.ndarray, "m"], Int[np.ndarray, "m 3"]]:
    """Block number, level and lower node of every cell, of those that the field is made of, that a cube touches.

    Each cube is made a little wider, so that a cell that it only shares a face with counts.
    """
    reach = (half * (1.0 + 1e-9) + 1e-9)[:, None]
    lower, upper = ((centres + side * reach - np.asarray(field.origin)) / float(field.spacing) for side in (-1, 1))
    found = []
    for level, table in enumerate(map(np.asarray, field.tables)):
        last = BLOCK * np.array(table.shape) - 1
        low = np.clip(np.floor(lower / 2**level).astype(np.int64), 0, last)
        high = np.clip(np.floor(upper / 2**level).astype(np.int64), 0, last)
        widest = int((high - low).max(initial=0)) + 1
        for step in np.stack(np.meshgrid(*[np.arange(widest)] * 3, indexing="ij"), axis=-1).reshape(-1, 3):
            node = low + step
            node = node[(node <= high).all(axis=1)]
            number = table[tuple((node // BLOCK).T)]
            used = number >= 0
            if level > 0:
                # Where a finer block lies, the field is that block's spline.
                used &= np.asarray(field.tables[level - 1])[tuple((2 * node // BLOCK).T)] < 0
            rows = np.column_stack([number, np.full(len(node), level), node])[used]
            found.append(np.unique(rows, axis=0))
    cells = np.unique(np.concatenate(found), axis=0)
    return cells[:, 0], cells[:, 1], cells[:, 2:]
