"""Does the batch, or the start of the weights, explain where the paper's loss stays? Fits by it, all of as many steps.

Run: python benchmarks/training.py [--width 512 --depth 10 --steps 10000] [--out FILE]

The paper names 50,000 points and no batch, and no start of the weights; the method that it builds on starts as the
distance to a ball (Atzmon, Lipman 2020). Each row is one fit of one target by the paper's loss, rate and number of
halvings. Rows made before are read, and a fit that was stopped goes on. With the paper's own network a step of all
points takes half a minute on two cores, so that the defaults are a smaller one.
"""

import dataclasses
import functools
import itertools
from pathlib import Path

import numpy as np
from kept_rows import Rows, command, on_one_line, tell

from keepout.apps.reproduction.fitted import OFFSET
from keepout.core.geometry.offset_solid import OffsetSolid
from keepout.core.geometry.target import Target
from keepout.core.learning.losses import PROFILES
from keepout.core.learning.training import fit
from keepout.core.measures.quality import surface_errors

PLACE = ("target", "width", "depth", "steps", "batch", "start")
LAST = 0.1
"""Share of the steps, at the end, over which the terms of the loss are averaged."""


def fitted(target, solid, checkpoint, place):
    """Fit by the paper's loss, and give the row's figures; terms of the loss and errors in radii, as it was trained."""
    paper = PROFILES["paper"]
    numbers = {key: place[key] for key in PLACE[1:]}
    halving = place["steps"] * paper.halving // paper.steps
    profile = dataclasses.replace(paper, halving=halving, **numbers)
    model = fit(target, profile=profile, solid=solid, checkpoint=checkpoint, progress=on_one_line)
    curve = {name: np.asarray(column) for name, column in model.training["curve"].items()}
    last = curve.pop("steps") > (1.0 - LAST) * place["steps"]
    radius = float(model.field.scale)
    errors = surface_errors(model.field, target)
    return {
        "distance_term": float(curve["value_term"][last].mean()),
        "gradient_term": float(curve["gradient_term"][last].mean()),
        "mean_error_radii": float(curve["mean_error_m"][last].mean()) / radius,
        "surface_error_radii": errors.epsilon / radius,
        "worst_overstatement_radii": errors.maximum / radius,
        "fit_s": model.training["seconds"],
    }


def main():
    parser = command(__doc__)
    parser.add_argument("--target", default="intelsat30", help="a built-in target")
    parser.add_argument("--width", type=int, default=96)
    parser.add_argument("--depth", type=int, default=4)
    parser.add_argument("--steps", type=int, default=2000, help="a multiple of 250")
    parser.add_argument("--batch", nargs="+", type=int, default=[2048, 8192, 50_000])
    parser.add_argument("--start", nargs="+", default=["he", "geometric"], choices=["he", "geometric"])
    parser.add_argument("--out", type=Path, default=Path("out/training.json"), help="rows made so far")
    arguments = parser.parse_args()
    store, rows = Rows(arguments.out, PLACE, ()), []
    target = Target.load(arguments.target)
    solid = OffsetSolid.build(target.distance, offset=OFFSET)
    checkpoint = arguments.out.with_suffix(".checkpoint")
    for batch, start in itertools.product(sorted(arguments.batch), arguments.start):
        place = vars(arguments) | {"batch": batch, "start": start}
        place = {name: place[name] for name in PLACE}
        rows.append(store.made(place, functools.partial(fitted, target, solid, checkpoint, place)))
    tell(rows, arguments, tuple(rows[0]))


if __name__ == "__main__":
    main()
