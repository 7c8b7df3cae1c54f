"""A certificate that proves nothing: the largest values that a search found, where a proof takes too long."""

import time

import numpy as np

from keepout.core.errors import FieldError
from keepout.core.fields.model import Certificate, FieldModel
from keepout.core.geometry.target import Target
from keepout.core.progress import Progress, silent
from keepout.core.proof.certificate import GRADIENT_ALLOWANCE, largest_found, require_network_and_mesh, steepest_found


def sample_certificate(
    model: FieldModel,
    target: Target,
    *,
    chaser_radius: float = 0.0,
    allowance: float = 0.0,
    seed: int = 0,
    progress: Progress = silent,
) -> FieldModel:
    """Return the same model with a sampled certificate for one chaser radius, in place of any it had for that radius.

    It proves nothing: f̃ may exceed R + e_h where nobody looked. The search is the one that `certify` begins with:
    samples of {d = R}, denser along edges and at corners, then random ascent around the best. For networks whose
    bounds are too loose or take too long to prove, such as the source paper's 10 x 512.

    Args:
        model: its field must be a `NeuralField`.
        target: the mesh it was made for.
        chaser_radius: R, metres.
        allowance: metres added to the largest value found; 0 is what the source paper does.
        seed: of the search.
        progress: fraction done, and the largest value found.

    Raises:
        FieldError: another target's model, a field that is no network, a point cloud, a negative or infinite radius or
            allowance.

    """
    start = time.perf_counter()
    field, distance = require_network_and_mesh(model, target, where="sampled certificate")
    for name, value in (("chaser radius", chaser_radius), ("allowance", allowance)):
        if not 0.0 <= value < np.inf:
            raise FieldError(f"sampled certificate: {name} {value:g} m; it must be 0 or more, and finite")
    found = largest_found(field, distance, chaser_radius, np.random.default_rng(seed)) - chaser_radius
    progress(0.4, f"largest value found {found:+.4f} m")
    steepest = steepest_found(field, distance, chaser_radius, np.random.default_rng(seed + 1))
    certificate = Certificate(
        kind="sampled",
        chaser_radius=float(chaser_radius),
        error_bound=float(found + allowance),
        allowance=float(allowance),
        sampled_maximum=float(found),
        gradient_bound=(1.0 + GRADIENT_ALLOWANCE) * steepest,
        gradient_kind="sampled",
        evaluation_error=0.0,
        seconds=time.perf_counter() - start,
        target_sha256=model.target_sha256,
        field_sha256=model.sha256,
        gradient_found=steepest,
    )
    progress(1.0, f"largest value found {found:+.4f} m: nothing is proved")
    return model.with_certificate(certificate)
