"""The fields that Section VI.B is repeated with: the paper's own network, and the default one with as thin a skin."""

import dataclasses
import functools
from pathlib import Path
from typing import Any, Literal

import numpy as np

from keepout.apps.reproduction.work import Work
from keepout.core.fields import load_shipped
from keepout.core.fields.field import Field, values_and_gradients
from keepout.core.fields.model import Certificate, FieldModel
from keepout.core.geometry.offset_solid import OffsetSolid
from keepout.core.geometry.target import Target
from keepout.core.learning.losses import PROFILES, TrainingProfile
from keepout.core.learning.training import fit
from keepout.core.measures.quality import exterior_band
from keepout.core.proof.certificate import certify, sample_certificate
from keepout.flights.surface import default_spacing

TARGETS = {"iss": "ISS", "tiangong": "CSS", "intelsat30": "Intersat-30"}
"""Built-in targets, and what the paper calls them, in its order."""
OFFSET = 0.001
"""δ, metres. The built-ins are closed, so the sign needs no skin: any δ above the rounding of a point in float32 (4 µm
around the ISS) would do. A millimetre is below what the paper's table resolves, and far above that."""
GRADIENT_BAND = (1e-3, 3.0)
"""Metres from the surface within which ∇f̃ is compared with ∇d."""
CHASER_RADII = (0.0, 0.5)
"""Metres. Every field gets a certificate for these."""
BATCH = 2048
PRINTED_STEPS = 1500
"""Enough to see where the printed loss goes."""


@dataclasses.dataclass(frozen=True)
class Recipe:
    """How a field is made.

    Attributes:
        label: what tables and figures call it.
        ending: of its file's name, after the target's.
        profile: numbers of the fit.
        bound: what its certificates are: "proved", "sampled" (nothing is proved), or None: it gets none.

    """

    label: str
    ending: str
    profile: TrainingProfile
    bound: Literal["proved", "sampled"] | None

    def path(self, folder: Path, target: str) -> Path:
        """Where a folder keeps the field of a target."""
        return folder / f"{target}{self.ending}.keepout"


SHIPPED = "shipped, δ = 30 mm"
"""Label of the fields that come with the package."""
DEFAULT = Recipe("default, δ = 1 mm", "-default", PROFILES["default"], "proved")
PAPER_NETWORK = Recipe("10 x 512, δ = 1 mm", "", dataclasses.replace(PROFILES["paper"], batch=BATCH), "sampled")
PRINTED = Recipe(
    "10 x 512, L_P as printed",
    "-printed",
    dataclasses.replace(PROFILES["paper_printed"], batch=BATCH, steps=PRINTED_STEPS),
    None,
)

DEVIATIONS = (
    f"a batch of {BATCH} points a step, where the paper states none (its 50,000 points at once want a GPU); the points "
    "are log-uniform in their distance from the surface, where it states no distribution; distances are normalised by "
    "the learned ball's radius, so that η = 0.1 weighs the eikonal term against errors in shares of that radius, not "
    "in metres; the labels are those of a solid with a skin δ = 1 mm on every surface; the activation is a softplus "
    "with β = 100, where it states none; Adam's β₁ = 0.9 and β₂ = 0.999 are the published ones, where it states none."
)


@functools.lru_cache(maxsize=8)
def target_of(name: str) -> Target:
    """Load a built-in target once a process: its distance is compiled and built once, before flights share it."""
    target = Target.load(name)
    target.distance.distance(np.zeros((1, 3)))
    return target


@functools.lru_cache(maxsize=8)
def solid_of(name: str, *, quick: bool) -> OffsetSolid:
    """Build the solid of a built-in target with a skin of `OFFSET` once a process; with coarser leaves if quick."""
    distance = target_of(name).distance
    return OffsetSolid.build(distance, offset=OFFSET, leaf=2.0 * default_spacing(distance) if quick else None)


def field_of(work: Work, recipe: Recipe, target: Target, *, fitting: bool, certified: bool = True) -> FieldModel | None:
    """Give a target's field by a recipe: from the folder that was named, else from an earlier run, else by a fit.

    A fit goes into `fields` in the part's folder, with a checkpoint beside it from which a stopped one goes on.

    Args:
        work: of the part; `work.fields` comes first.
        recipe: how it is made.
        target: the target, a built-in.
        fitting: whether to fit where there is none.
        certified: whether a full run adds the certificates that the field lacks.

    Raises:
        FieldError: the file is damaged, or belongs to another target.

    """
    own = work.folder / "fields"
    # What `table1` has fitted serves the other parts as well.
    folders = [folder for folder in (work.fields, own, work.folder.parent / "table1" / "fields") if folder is not None]
    path = next((place for folder in folders if (place := recipe.path(folder, target.name)).exists()), None)
    if path is not None:
        model = FieldModel.load(path, target=target)
    elif fitting:
        path = recipe.path(own, target.name)
        path.parent.mkdir(parents=True, exist_ok=True)
        model = fit(
            target,
            profile=recipe.profile,
            seed=work.seed,
            solid=OffsetSolid.build(target.distance, offset=OFFSET),
            checkpoint=path.with_suffix(".checkpoint"),
            progress=work.within(0.0, 0.8).progress,
        )
        model.save(path)
        work = work.within(0.8, 1.0)
    else:
        return None
    if work.quick or not certified or recipe.bound is None:
        return model
    have = {certificate.chaser_radius for certificate in model.certificates}
    lacking = [radius for radius in CHASER_RADII if radius not in have]
    for stretch, radius in work.stretches(lacking):
        model = model.with_certificate(_certificate(stretch, recipe.bound, model, target, radius))
        if path.parent == own:
            model.save(path)
    return model


def largest_gradient_error(model: FieldModel, solid: OffsetSolid, seed: int) -> float:
    """Give the largest ‖∇d − ∇f̃‖ sampled outside a target's solid, to 3 m from its surface, to 0.01 upwards."""
    nearest, farthest = GRADIENT_BAND
    found = gradient_errors(model.field, solid, nearest=nearest, farthest=farthest, seed=seed)
    return float(np.ceil(100.0 * found.maximum) / 100.0)


def paper_network(work: Work, target: Target) -> FieldModel | None:
    """Give a target's field of the paper's network, where there is one, and time for it; see `field_of`."""
    return None if work.quick else field_of(work.within(0.0, 0.1), PAPER_NETWORK, target, fitting=False)


def _certificate(work: Work, bound: str, model: FieldModel, target: Target, radius: float) -> Certificate:
    def make() -> dict[str, Any]:
        prove_or_sample = certify if bound == "proved" else sample_certificate
        done = prove_or_sample(model, target, chaser_radius=radius, seed=work.seed, progress=work.progress)
        return dataclasses.asdict(done.certificate(radius))

    # Minutes for the paper's network: whichever part is first leaves it where the others look.
    shared = dataclasses.replace(work, folder=work.folder.parent / "table1")
    return Certificate(**shared.numbers(f"certificate-{target.name}", [bound, model.sha256, radius, work.seed], make))


def shown_fields(work: Work, target: Target, *, certified: bool) -> dict[str, FieldModel]:
    """Give the fields that there are of a target, by label: the shipped one, then those of the recipes, none fitted.

    The paper's network is left out of a quick run: to cut its surface takes minutes. See `field_of` for `certified`.
    """
    fields = {SHIPPED: load_shipped(target.name, target=target)}
    for stretch, recipe in work.stretches((DEFAULT,) if work.quick else (DEFAULT, PAPER_NETWORK)):
        model = field_of(stretch, recipe, target, fitting=False, certified=certified)
        if model is not None:
            fields[recipe.label] = model
    return fields


@dataclasses.dataclass(frozen=True)
class GradientErrors:
    """‖∇d - ∇f̃‖ on exterior points in one band of d, where ∇d is defined: the paper's e_∇h bounds it.

    Attributes:
        mean: over the points.
        percentile_95: likewise.
        maximum: the largest sampled, which is no bound.
        count: number of points.

    """

    mean: float
    percentile_95: float
    maximum: float
    count: int


def gradient_errors(
    field: Field, solid: OffsetSolid, *, nearest: float, farthest: float, count: int = 50_000, seed: int = 0
) -> GradientErrors:
    """Measure ‖∇d - ∇f̃‖ on exterior points whose distance d from the surface is between the two limits, metres.

    Points whose nearest obstacle is a sealed mouth are left out: there the field learns another distance than d. Where
    two surfaces are equally near ∇d jumps, and next to that a smooth field must differ from it by up to about 1.
    """
    points, d, true_gradient = exterior_band(solid, nearest, farthest, count, np.random.default_rng(seed))
    decided = solid.signed_distance(points) >= d - solid.envelope
    error = np.linalg.norm(values_and_gradients(field, points[decided])[1] - true_gradient[decided], axis=1)
    return GradientErrors(float(error.mean()), float(np.quantile(error, 0.95)), float(error.max()), len(error))
