"""A proved bound of ‖∇f̃‖ of a neural field wherever a chaser's centre can be, by branch and bound over cubes."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from threadpoolctl import threadpool_limits

from keepout.core.cores import share_among_cores
from keepout.core.fields.evaluate import values_and_gradients
from keepout.core.fields.neural import NeuralField
from keepout.core.geometry.distance import Distance
from keepout.core.geometry.octree import CORNERS, SQRT3
from keepout.core.progress import Progress, silent
from keepout.core.proof.bounds import UNIT64, Network
from keepout.core.proof.slope_bounds import Prepared, slope_bounds

MOST_CUBES = 12_000_000
"""The search gives up after so many cubes: some ten minutes a core for 4 × 96."""
GAP = 0.5
"""Cubes are split while their bound exceeds the largest slope found by more than this share of it."""
FIRST_CUBES = 20
"""Cubes to the radius of the learned ball at the start."""
_CHUNK = 128
_LOOKED_AT = 8192
"""Open cubes, of each size, at whose centres the slope is evaluated, to find a larger one."""


class Lipschitz(NamedTuple):
    """The largest ‖∇f̃‖ found, and a proved upper bound of all; None where it took too many cubes."""

    found: float
    proved: float | None


def prove_lipschitz(
    field: NeuralField,
    distance: Distance,
    *,
    found: float,
    clearance: float = 0.0,
    progress: Progress = silent,
) -> Lipschitz:
    """Prove a bound of ‖∇f̃‖ at every point whose distance d from the target is at least `clearance`.

    Cubes over the learned ball are split until each is bounded by 1 + `GAP` times the largest slope found; the
    continuation beyond the ball, and the allowance it subtracts, are covered by closed forms. The bound is of the
    network in exact arithmetic: two values as evaluated in float32 differ by at most the bound times the points'
    distance, plus twice the certificate's `evaluation_error`.

    Args:
        field: the field.
        distance: of the target, exact.
        found: the largest slope that a search found; the search goes on at the centres of the worst cubes.
        clearance: metres; the chaser's radius.
        progress: the share of the ball's volume that is settled.

    """
    prepared = Prepared.of(Network.of(field.layers, field.beta))
    continuation = field.continuation
    centre, scale = np.asarray(continuation.centre), float(field.scale)
    domain = float(continuation.domain_radius)
    learned = 0.5 * float(domain + continuation.outer_radius)
    # The normalisation in float64 moves a point by a few units in the last place of the domain's size.
    moved = 64.0 * UNIT64 * (scale + float(np.abs(centre).max()))
    steps = np.arange(-FIRST_CUBES, FIRST_CUBES) + 0.5
    half = 0.5 * learned / FIRST_CUBES
    cubes = 2.0 * half * np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    whole, done = (2.0 * learned) ** 3, 0.0
    seen, largest = 0, found
    while len(cubes):
        reach = SQRT3 * half * (1.0 + 1e-9) + 1e-9
        farthest = np.linalg.norm(cubes, axis=1) + reach
        # Beyond ρ_0 a cube answers for points farther out too.
        kept = farthest - 2.0 * reach <= learned
        kept[kept] = (distance.distance(cubes[kept] + centre) + reach >= clearance) | (farthest[kept] >= domain)
        done += float((~kept).sum()) * (2.0 * half) ** 3
        cubes, farthest = cubes[kept], farthest[kept]
        seen += len(cubes)
        if seen > MOST_CUBES:
            return Lipschitz(found, None)
        bound = _with_continuation(field, _bounds(prepared, cubes / scale, (half + moved) / scale), farthest)
        worst = cubes[np.argsort(-bound)[:_LOOKED_AT]] + centre
        worst = worst[distance.distance(worst) >= clearance]
        slopes = np.linalg.norm(values_and_gradients(field, worst)[1], axis=1)
        found = max(found, float(slopes.max(initial=0.0)))
        open_ = bound > (1.0 + GAP) * found
        largest = max(largest, float(bound[~open_].max(initial=0.0)))
        done += float((~open_).sum()) * (2.0 * half) ** 3
        progress(min(1.0, done / whole), f"‖∇f̃‖: {seen} cubes, {int(open_.sum())} of {2.0 * half:.2g} m open")
        half *= 0.5
        cubes = (cubes[open_][:, None, :] + half * CORNERS).reshape(-1, 3)
    return Lipschitz(found, largest)


def _bounds(prepared: Prepared, centres: Float[np.ndarray, "m 3"], half_width: float) -> Float[np.ndarray, "m"]:
    answer = np.empty(len(centres))

    def work(part: slice) -> None:
        stop = min(part.stop, len(centres))
        for start in range(part.start, stop, _CHUNK):
            piece = slice(start, min(start + _CHUNK, stop))
            rows = centres[piece]
            answer[piece] = slope_bounds(prepared, rows, np.full(len(rows), half_width))

    # One core a share of the cubes: products shared among the cores once more would wait for each other.
    with threadpool_limits(1, "blas"):
        share_among_cores(work, len(centres))
    return answer


def _with_continuation(
    field: NeuralField, bound: Float[np.ndarray, "m"], farthest: Float[np.ndarray, "m"]
) -> Float[np.ndarray, "m"]:
    """Bound ‖∇f̃‖ where it comes from a cube, from the network's own bound and the cube's largest radius.

    With the allowance e, its smoothstep is steepest at the middle: 15/8 e/(ρ_0 - ρ_T). Beyond ρ_0 the radial part is
    at most the larger of 1 and the network's plus 1 - F'(ρ_0), and the tangential part at most the network's.
    """
    c = field.continuation
    target, domain = float(c.target_radius), float(c.domain_radius)
    lowering = 1.875 * abs(float(c.allowance)) / (domain - target)
    lack = 1.0 - np.sqrt(1.0 - (target / domain) ** 2)
    beyond = np.maximum(bound + lack, np.sqrt(bound**2 + 1.0))
    inside = np.where(farthest > target, bound + lowering, bound)
    return np.where(farthest >= domain, np.maximum(inside, beyond), inside) * (1.0 + 1e-9)
