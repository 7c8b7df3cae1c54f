"""The guard's field of a target in numbers: what is proved of it, and what a search finds.

Run: python benchmarks/guard_field.py --out benchmarks/results/guard_field.json

Names of built-in targets choose some. Each field is built anew, for a chaser of 0.5 m, so the cache is neither read nor
written.
"""

import time
from pathlib import Path

import numpy as np
from kept_rows import command, keep, tell

from keepout.core.fields.field import values, values_and_gradients
from keepout.core.fields.grid import BLOCK
from keepout.core.fields.grid_build import build_grid
from keepout.core.geometry.level_set import surface_points
from keepout.core.geometry.offset_solid import OffsetSolid
from keepout.core.geometry.target import Target
from keepout.core.guard.field import grid_numbers
from keepout.core.proof.grid import certify_grid, joined_spline, slopes_by_differences

RADIUS, POINTS, ROUNDS = 0.5, 1_000_000, (0.3, 0.1, 0.03, 0.01, 0.003, 0.001)


def steepest(field, distance, generator):
    """Largest ‖∇f̃‖ found from a million points, near the surface, in the domain and beyond it, and by ascent."""
    continuation = field.continuation
    direction = generator.normal(size=(POINTS, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    half = POINTS // 2
    near = surface_points(distance, half, generator, by_area=0.3)
    near += generator.exponential(0.3, (half, 1)) * direction[:half]
    radius = float(continuation.outer_radius) * generator.uniform(0.2, 2.0, (POINTS - half, 1))
    points = np.concatenate([near, np.asarray(continuation.centre) + radius * direction[half:]])
    slope = np.linalg.norm(values_and_gradients(field, points)[1], axis=1)
    for step in ROUNDS:
        best = np.argsort(-slope)[:500]
        moved = (points[best, None] + step * generator.normal(size=(500, 20, 3))).reshape(-1, 3)
        points = np.concatenate([points[best], moved])
        slope = np.concatenate([slope[best], np.linalg.norm(values_and_gradients(field, moved)[1], axis=1)])
    return slope.max()


def largest_jump(field, generator):
    """Largest step of f̃ found across the faces of the finest blocks, less what a slope of 1 makes."""
    side = BLOCK * float(field.spacing)
    reach = float(field.continuation.domain_radius) / 3.0**0.5
    points = np.asarray(field.continuation.centre) + generator.uniform(-reach, reach, (POINTS, 3))
    axis, rows = generator.integers(3, size=POINTS), np.arange(POINTS)
    origin = np.asarray(field.origin)[axis]
    points[rows, axis] = origin + side * np.round((points[rows, axis] - origin) / side)
    aside = np.zeros_like(points)
    aside[rows, axis] = 1e-10
    return np.abs(values(field, points + aside) - values(field, points - aside)).max() - 2e-10


def main():
    """Print the numbers of each target, and keep them."""
    parser = command(__doc__)
    parser.add_argument("targets", nargs="*", default=["intelsat30", "tiangong", "iss"], help="built-in targets")
    parser.add_argument("--out", type=Path, help="also keep the rows in this file")
    given, rows = parser.parse_args(), []
    for name in given.targets:
        target, generator = Target.load(name), np.random.default_rng(0)
        times = [time.perf_counter()]
        solid = OffsetSolid.build(target.distance)
        times.append(time.perf_counter())
        spacing, band = grid_numbers(target, RADIUS)
        model = build_grid(target, spacing=spacing, band=band, solid=solid)
        times.append(time.perf_counter())
        model = certify_grid(model, target, chaser_radius=RADIUS)
        times.append(time.perf_counter())
        proof, field = model.certificate(RADIUS), model.field
        spline = joined_spline(field)
        rough = float(slopes_by_differences(spline.coefficients, spline.spacing).max())
        row = {
            "target": name,
            "spacing_m": spacing,
            "gradient_bound": proof.gradient_bound,
            "largest_slope_found": float(steepest(field, target.distance, generator)),
            "of_differences_alone": rough,
            "error_bound_m": proof.error_bound,
            "found_m": proof.sampled_maximum,
            "threshold_m": RADIUS + proof.error_bound,
            "evaluation_error_m": proof.evaluation_error,
            "largest_jump_found_m": float(largest_jump(field, generator)),
            "allowance_m": float(field.continuation.allowance),
        }
        rows.append(row | dict(zip(("solid_s", "grid_s", "certify_s"), np.diff(times).tolist())))
    tell(rows, given)
    keep(rows, given.out)


if __name__ == "__main__":
    main()
