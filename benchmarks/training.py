"""Does the batch, or the start of the weights, explain where the paper's loss stays? Fits by it, all of as many steps.

Run: python benchmarks/training.py [--width 512 --depth 10 --steps 10000] [--out FILE] [--fields FOLDER]

The paper names 50,000 points and no batch, and no start of the weights; the method that it builds on starts as the
distance to a ball (Atzmon, Lipman 2020). Each row is one fit of one target by the paper's loss, rate and number of
halvings. Rows made before are read, and a fit that was stopped goes on. With the paper's own network a step of all
points takes half a minute on two cores, so that the defaults are a smaller one. On a GPU `--products tf32` multiplies
with 10 bits of the fraction while training, as no CPU does; errors on the surface are measured in full precision.
"""

import contextlib
import dataclasses
import functools
import itertools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from kept_rows import Rows, command, on_one_line, tell

from keepout.apps.reproduction.fitted import OFFSET
from keepout.core.fields import neural
from keepout.core.geometry.offset_solid import OffsetSolid
from keepout.core.geometry.target import Target
from keepout.core.learning import losses
from keepout.core.learning.losses import PROFILES
from keepout.core.learning.training import fit
from keepout.core.measures.quality import surface_errors

PLACE = ("target", "width", "depth", "steps", "batch", "start", "device", "products")
SHAPE = PLACE[1:-2]
"""What of it a profile names."""
LAST = 0.1
"""Share of the steps, at the end, over which the terms of the loss are averaged."""


@contextlib.contextmanager
def multiplying(products):
    """Let what is traced in here multiply matrices as a device does fastest: TF32 on a GPU, float32 on a CPU."""
    full = neural.times
    try:
        if products == "tf32":
            neural.times = losses.times = jnp.matmul
        yield
    finally:
        neural.times = losses.times = full


def fitted(target, solid, arguments, place):
    """Fit by the paper's loss, and give the row's figures; terms of the loss and errors in radii, as it was trained."""
    paper = PROFILES["paper"]
    numbers = {key: place[key] for key in SHAPE}
    halving = place["steps"] * paper.halving // paper.steps
    profile = dataclasses.replace(paper, halving=halving, **numbers)
    with multiplying(place["products"]):
        checkpoint = arguments.out.with_suffix(".checkpoint")
        model = fit(target, profile=profile, solid=solid, checkpoint=checkpoint, progress=on_one_line)
    if arguments.fields:
        arguments.fields.mkdir(parents=True, exist_ok=True)
        model.save(arguments.fields / ("-".join(str(place[key]).replace(" ", "-") for key in PLACE) + ".keepout"))
    curve = {name: np.asarray(column) for name, column in model.training["curve"].items()}
    last = curve.pop("steps") > (1.0 - LAST) * place["steps"]
    radius = float(model.field.scale)
    errors = surface_errors(model.field, target)
    return {
        "distance_term": float(curve["value_term"][last].mean()),
        "gradient_term": float(curve["gradient_term"][last].mean()),
        "mean_error_radii": float(curve["mean_error_m"][last].mean()) / radius,
        "surface_error_radii": errors.epsilon / radius,
        "surface_overstatement_radii": errors.epsilon_plus / radius,
        "worst_overstatement_radii": errors.maximum / radius,
        "fit_s": model.training["seconds"],
    }


def main():
    parser = command(__doc__)
    parser.add_argument("--targets", nargs="+", default=["intelsat30"], help="built-in targets")
    parser.add_argument("--width", type=int, default=96)
    parser.add_argument("--depth", type=int, default=4)
    parser.add_argument("--steps", type=int, default=2000, help="a multiple of 250")
    parser.add_argument("--batch", nargs="+", type=int, default=[2048, 8192, 50_000])
    parser.add_argument("--start", nargs="+", default=["he", "geometric"], choices=["he", "geometric"])
    parser.add_argument("--products", default="float32", choices=["float32", "tf32"], help="while training")
    parser.add_argument("--out", type=Path, default=Path("out/training.json"), help="rows made so far")
    parser.add_argument("--fields", type=Path, help="keep what was fitted in this folder")
    arguments = parser.parse_args()
    store, rows = Rows(arguments.out, PLACE, ()), []
    for name in arguments.targets:
        target = Target.load(name)
        solid = OffsetSolid.build(target.distance, offset=OFFSET)
        for batch, start in itertools.product(sorted(arguments.batch), arguments.start):
            place = vars(arguments) | {"target": name, "batch": batch, "start": start}
            place |= {"device": jax.devices()[0].device_kind}
            place = {name: place[name] for name in PLACE}
            rows.append(store.made(place, functools.partial(fitted, target, solid, arguments, place)))
    tell(rows, arguments, tuple(rows[0]))


if __name__ == "__main__":
    main()
