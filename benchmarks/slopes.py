"""What is known of ‖∇f̃‖ of a field: the largest found by search, bounds over cubes of many sizes, and the proof.

Run: python benchmarks/slopes.py intelsat30 (a shipped field's name, or a .keepout file of a built-in target).
With --table only the cubes are shown, and --out keeps them; the proof takes minutes.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np
from kept_rows import keep

from keepout.core.fields import load_shipped
from keepout.core.fields.field import values_and_gradients
from keepout.core.fields.model import FieldModel
from keepout.core.geometry.level_set import surface_points
from keepout.core.geometry.target import Target
from keepout.core.proof.bounds import Network
from keepout.core.proof.certificate import GRADIENT_ALLOWANCE, steepest_found
from keepout.core.proof.slope import Prepared, prove_lipschitz, slope_bounds

SIDES = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5)
STAND_OFFS = (0.0, 0.5, 2.0, 5.0)


def cube_bounds(field, distance):
    """Print bounds of the slope over cubes, and give them: a row a distance and a side."""
    rows = []
    rng = np.random.default_rng(0)
    prepared = Prepared.of(Network.of(field.layers, field.beta))
    centre, scale = np.asarray(field.continuation.centre), float(field.scale)
    print("cubes at random places this far from the surface: median / p99 / largest bound")
    for stand_off in STAND_OFFS:
        points = surface_points(distance, 2048, rng)
        direction = rng.normal(size=points.shape)
        points += stand_off * direction / np.linalg.norm(direction, axis=1, keepdims=True)
        points = points[np.linalg.norm(points - centre, axis=1) < 0.9 * scale]
        slope = np.linalg.norm(values_and_gradients(field, points)[1], axis=1)
        print(f"  {stand_off:g} m: ‖∇f̃‖ at the centres at most {slope.max():.2f}")
        for side in SIDES:
            start = time.process_time()
            x, half = (points - centre) / scale, np.full(len(points), 0.5 * side / scale)
            pieces = range(0, len(x), 128)
            bound = np.concatenate([slope_bounds(prepared, x[i : i + 128], half[i : i + 128]) for i in pieces])
            micro = 1e6 * (time.process_time() - start) / len(x)
            rows.append({"stand_off_m": stand_off, "largest_slope": float(slope.max()), "side_m": side})
            rows[-1] |= {"median": float(np.median(bound)), "p99": float(np.quantile(bound, 0.99))}
            rows[-1] |= {"largest": float(bound.max())}
            print(
                f"    side {side:5g} m: {np.median(bound):8.2f} {np.quantile(bound, 0.99):8.2f} {bound.max():8.2f}"
                f"   ({micro:.0f} µs of processor time a cube)"
            )
    return rows


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("field")
    parser.add_argument("--clearance", type=float, default=0.0)
    parser.add_argument("--table", action="store_true")
    parser.add_argument("--out", type=Path, help="keep the bounds over cubes in this file")
    arguments = parser.parse_args()
    model = FieldModel.load(arguments.field) if arguments.field.endswith(".keepout") else load_shipped(arguments.field)
    distance = Target.load(model.target_name).distance
    keep(cube_bounds(model.field, distance), arguments.out)
    if arguments.table:
        return
    found = steepest_found(model.field, distance, arguments.clearance, np.random.default_rng(1))
    print(f"search: {found:.3f}; with the allowance {(1.0 + GRADIENT_ALLOWANCE) * found:.3f}")
    wall, processor = time.perf_counter(), time.process_time()
    answer = prove_lipschitz(
        model.field,
        distance,
        found=found,
        clearance=arguments.clearance,
        progress=lambda fraction, message: print(f"  {fraction:.1%} {message}", file=sys.stderr),
    )
    wall, processor = time.perf_counter() - wall, time.process_time() - processor
    proved = "not proved: too many cubes" if answer.proved is None else f"proved at most {answer.proved:.3f}"
    print(f"largest found {answer.found:.3f}, {proved}; {wall:.0f} s, {processor:.0f} s of processor time")


if __name__ == "__main__":
    main()
