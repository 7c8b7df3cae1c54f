"""What the default profile reaches: certified bounds, distance of the certified level, sizes and times, per target.

Run: python benchmarks/fits.py intelsat30 satellite.glb --fields FOLDER [--json FILE]
     python benchmarks/fits.py --seeds 3 --profile quick intelsat30 --fields FOLDER [--json FILE]
     python benchmarks/fits.py --second intelsat30 --fields FOLDER [--json FILE]

A mesh file is taken in metres. A field found in the folder is measured again, not fitted again; its times are those of
its fit. Beside each network stands the grid field whose certified level is as far from the surface. A fit's time is
given too as a multiple of what its matrix products alone take at the sgemm rate measured just before and after it.

With `--seeds` each target is fitted from so many, each a row: the parts of its time, its bound, and over {d = R} the
margin e_h - (f̃ - d), which a flight loses, and the mean error; no grids. With `--second` the wings of a built-in target
are turned by 0.05 and by 0.2 rad, and each mesh is fitted twice: anew, and beginning with the first field.
"""

import argparse
import itertools
import json
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from fields import sgemm_rate
from kept_rows import on_one_line

from keepout.core.fields.field import values
from keepout.core.fields.grid_build import build_grid
from keepout.core.fields.model import FieldModel
from keepout.core.fields.neural import NeuralField
from keepout.core.geometry.level_set import level_points
from keepout.core.geometry.offset_solid import OffsetSolid
from keepout.core.geometry.target import Target
from keepout.core.learning.training import HARD_SHARES, fit
from keepout.core.measures.quality import curvature, distance_errors, margin_cost
from keepout.core.proof.certificate import certify
from keepout.core.proof.grid import certify_grid
from keepout.core.whole_file import write_whole

RADII = (0.0, 0.5)
COLUMNS = (
    ("target", "{}"),
    ("field", "{}"),
    ("megabytes", "{:.2f}"),
    ("error_bound_point_m", "{:+.4f}"),
    ("found_point_m", "{:+.4f}"),
    ("error_bound_half_metre_m", "{:+.4f}"),
    ("found_half_metre_m", "{:+.4f}"),
    ("p95_point_m", "{:.3f}"),
    ("p95_half_metre_m", "{:.3f}"),
    ("hessian_p99_at_0.3_m", "{:.1f}"),
    ("fit_s", "{:.0f}"),
    ("certify_s", "{:.0f}"),
    ("fit_over_sgemm", "{:.1f}"),
)


SEED_COLUMNS = (
    ("target", "{}"),
    ("profile", "{}"),
    ("seed", "{}"),
    ("device", "{}"),
    ("error_bound_half_metre_m", "{:+.4f}"),
    ("margin_mean_m", "{:.4f}"),
    ("margin_p95_m", "{:.4f}"),
    ("mean_error_on_level_m", "{:.4f}"),
    ("mean_error_near_m", "{:.4f}"),
    ("solid_s", "{:.1f}"),
    ("labels_s", "{:.1f}"),
    ("steps_s", "{:.1f}"),
    ("hunts_s", "{:.1f}"),
    ("certify_s", "{:.1f}"),
    ("all_s", "{:.1f}"),
    ("fit_over_sgemm", "{:.1f}"),
)


def megabytes(model: FieldModel, folder: Path) -> float:
    """Return the size of the model's file."""
    path = folder / "size.keepout"
    model.save(path)
    size = path.stat().st_size / 1e6
    path.unlink()
    return size


def product_flops(model: FieldModel) -> float:
    """Flops of the fit's matrix products.

    Value and gradient take 2 sweeps, and their reverse twice as much; a value only, all that is learned of
    counter-examples, takes half of both.
    """
    numbers, field = model.training["numbers"], model.field
    assert isinstance(field, NeuralField)
    weights = sum(W.size for W in field.layers.weights)
    sloped = model.training["sloped_share"]
    steps = [numbers[name] for name in ("steps", "tuning_steps", "polish_steps")]
    hard = float(np.dot(HARD_SHARES, steps))
    points = numbers["batch"] * (0.5 * sum(steps) + 0.5 * sloped * (sum(steps) - hard))
    return points * 2.0 * weights * 2 * 3


def row(model: FieldModel, label: str, solid: OffsetSolid, name: str, folder: Path, sgemm: float | None = None) -> dict:
    """Measure one certified field; `sgemm` is the machine's rate while it was fitted, if that was in this run."""
    at = [model.certificate(radius) for radius in RADII]
    cost = [
        margin_cost(model.field, solid, error_bound=c.error_bound, chaser_radius=radius) for c, radius in zip(at, RADII)
    ]
    seconds = model.training["seconds"]
    return {
        "target": label,
        "field": name,
        "megabytes": megabytes(model, folder),
        "error_bound_point_m": at[0].error_bound,
        "found_point_m": at[0].sampled_maximum,
        "error_bound_half_metre_m": at[1].error_bound,
        "found_half_metre_m": at[1].sampled_maximum,
        "p95_point_m": cost[0].percentile_95,
        "p95_half_metre_m": cost[1].percentile_95,
        "hessian_p99_at_0.3_m": curvature(model.field, solid, 0.3).percentile_99,
        "fit_s": seconds,
        "certify_s": sum(c.seconds for c in at),
        "fit_over_sgemm": None if sgemm is None else seconds / (product_flops(model) / sgemm),
    }


def loaded(source: str) -> Target:
    """Load a built-in target, or a mesh file in metres."""
    return Target.load(source, units="m") if Path(source).suffix else Target.load(source)


def measure(source: str, folder: Path) -> list[dict]:
    """Fit, certify and measure one target, and the grid field beside it."""
    target = loaded(source)
    solid = OffsetSolid.build(target.distance)
    path = folder / f"{Path(source).name}.keepout"
    sgemm = None
    if path.exists():
        model = FieldModel.load(path, target=target)
    else:
        before = sgemm_rate()
        model = fit(target, checkpoint=path.with_suffix(".checkpoint"), solid=solid, progress=on_one_line)
        sgemm = 0.5 * (before + sgemm_rate())
        model.save(path)
    for radius in RADII:
        if all(abs(c.chaser_radius - radius) > 1e-9 for c in model.certificates):
            model = certify(model, target, chaser_radius=radius, progress=on_one_line)
            model.save(path)
    field = model.field
    assert isinstance(field, NeuralField)
    shape = f"neural {len(field.layers.weights) - 1} x {field.layers.weights[0].shape[0]}"
    rows = [row(model, Path(source).name, solid, shape, folder, sgemm)]
    spacing = float(np.round(rows[0]["p95_point_m"], 2))
    grid = build_grid(target, spacing=spacing, solid=solid, progress=on_one_line)
    for radius in RADII:
        grid = certify_grid(grid, target, chaser_radius=radius)
    rows.append(row(grid, Path(source).name, solid, f"grid h = {spacing:.2f} m", folder))
    return rows


def seed_row(
    target: Target, profile: str, seed: int, path: Path, *, label: str, first: FieldModel | None = None
) -> dict:
    """Fit from one seed, for a chaser of half a metre, and certify, as a stranger would who has nothing but the mesh.

    The first row of a profile compiles; the others have its programs.
    """
    radius, sgemm = RADII[1], None
    if path.exists():
        model = FieldModel.load(path, target=target)
    else:
        before = sgemm_rate()  # of the processor: of a fit on a GPU its ratio is no measure
        how = {"profile": profile, "seed": seed, "chaser_radius": radius, "first": first}
        model = fit(target, **how, progress=on_one_line)
        sgemm = 0.5 * (before + sgemm_rate())
        model = certify(model, target, chaser_radius=radius, progress=on_one_line)
        model.save(path)
    solid = OffsetSolid.build(target.distance)
    certificate = model.certificate(radius)
    bound, seconds = certificate.error_bound, model.training["seconds"]
    points = level_points(target.distance, radius, 40_000, np.random.default_rng(0), uniform=True)
    over = values(model.field, points[solid.is_exterior(points)][:20_000]) - radius
    measured = sgemm is not None and model.training["device"] == "cpu"  # else the processor's rate says nothing
    near = distance_errors(model.field, solid, nearest=0.05, farthest=1.0)
    return {
        "target": label,
        "profile": profile,
        "seed": seed,
        "device": model.training["device"],
        "error_bound_half_metre_m": bound,
        "margin_mean_m": float((bound - over).mean()),
        "margin_p95_m": float(np.quantile(bound - over, 0.95)),
        "mean_error_on_level_m": float(np.abs(over).mean()),
        "mean_error_near_m": near.mean_absolute,
        **{f"{part}_s": spent for part, spent in model.training["seconds_of"].items()},
        "certify_s": certificate.seconds,
        "all_s": seconds + certificate.seconds,
        "fit_over_sgemm": seconds * sgemm / product_flops(model) if measured else None,
    }


def seed_rows(sources: list[str], profile: str, seeds: int, folder: Path) -> Iterator[dict]:
    """Fit each target from so many seeds."""
    for source, seed in itertools.product(sources, range(seeds)):
        name = Path(source).name
        yield seed_row(loaded(source), profile, seed, folder / f"{name}-{profile}-{seed}.keepout", label=name)


TURNED = (0.05, 0.2)
"""Radians by which the wings are turned that a second fit is about: a little, and much."""


def second_rows(sources: list[str], profile: str, folder: Path) -> Iterator[dict]:
    """Fit each target, and with its wings turned: anew, and beginning with the first field."""
    for source in sources:
        first = folder / f"{source}-{profile}-0.keepout"
        yield seed_row(loaded(source), profile, 0, first, label=source)
        ways = (("anew", None), ("from the first field", FieldModel.load(first)))
        for angle, (how, given) in itertools.product(TURNED, ways):
            turned = Target.load(source, parameters={"wing_angle": angle})
            path = folder / f"{source}-turned-{angle:g}-{profile}-{how.split()[0]}.keepout"
            yield seed_row(turned, profile, 1, path, label=f"{source}, wings turned {angle:g}, {how}", first=given)


def main() -> None:
    """Measure the targets named on the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("targets", nargs="+", help="built-in names or mesh files in metres")
    parser.add_argument("--fields", type=Path, default=Path("out/fits"), help="folder of the fitted fields")
    parser.add_argument("--json", type=Path, help="write the rows here")
    parser.add_argument("--seeds", type=int, help="fit each target from so many seeds, and print a row for each")
    parser.add_argument("--second", action="store_true", help="fit each target and one whose wings are turned")
    parser.add_argument("--profile", default="default", help="of the fits of --seeds and --second")
    arguments = parser.parse_args()
    arguments.fields.mkdir(parents=True, exist_ok=True)
    found: Iterable[dict]
    if arguments.second:
        columns, found = SEED_COLUMNS, second_rows(arguments.targets, arguments.profile, arguments.fields)
    elif arguments.seeds:
        columns = SEED_COLUMNS
        found = seed_rows(arguments.targets, arguments.profile, arguments.seeds, arguments.fields)
    else:
        columns = COLUMNS
        found = (entry for source in arguments.targets for entry in measure(source, arguments.fields))
    print("| " + " | ".join(name for name, _ in columns) + " |")
    print("|" + " --- |" * len(columns))
    rows = []
    for entry in found:
        rows.append(entry)
        cells = ("-" if entry[name] is None else form.format(entry[name]) for name, form in columns)
        print("\r| " + " | ".join(cells) + " |", flush=True)
        if arguments.json:
            write_whole(arguments.json, json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
