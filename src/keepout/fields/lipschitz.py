"""A proved bound of ‖∇f̃‖ of a neural field wherever a chaser's centre can be, by branch and bound over cubes."""

import numpy as np
from jaxtyping import Float

from keepout.fields.bounds import UNIT64, Network
from keepout.fields.neural import NeuralField
from keepout.fields.slope_bounds import Prepared, slope_bounds
from keepout.geometry.bvh import share_among_cores
from keepout.geometry.distance import Distance
from keepout.geometry.octree import SQRT3
from keepout.progress import Progress, silent

MOST_CUBES = 4_000_000
"""The search gives up after so many cubes: some 3 minutes a core for 4 × 96 on a laptop."""
FIRST_CUBES = 20
"""Cubes to the radius of the learned ball at the start."""
_CHUNK = 256
_CORNERS = np.array([(i, j, k) for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)], dtype=np.float64)


def prove_lipschitz(
    field: NeuralField,
    distance: Distance,
    *,
    goal: float,
    clearance: float = 0.0,
    most: int = MOST_CUBES,
    progress: Progress = silent,
) -> float | None:
    """Prove a bound of ‖∇f̃‖ at every point whose distance d from the target is at least `clearance`.

    Cubes over the learned ball are split until each is bounded by the goal; the continuation beyond the ball, and the
    allowance it subtracts, are covered by closed forms. The bound is of the network in exact arithmetic: two values as
    evaluated in float32 differ by at most the bound times the points' distance plus twice the certificate's
    `evaluation_error`.

    Args:
        field: the field.
        distance: of the target, exact.
        goal: a cube is split while its bound exceeds this; smaller costs more, steeply below three times the largest
            slope.
        clearance: metres; the chaser's radius.
        most: cubes to bound before giving up.
        progress: the share of the ball's volume that is settled.

    Returns:
        The bound, at most about the goal, or None where `most` cubes were not enough.

    """
    prepared = Prepared.of(Network.of(field.layers, field.beta))
    continuation = field.continuation
    centre, scale = np.asarray(continuation.centre), float(field.scale)
    learned = 0.5 * float(continuation.domain_radius + continuation.outer_radius)
    # The normalisation in float64 moves a point by a few units in the last place of the domain's size.
    moved = 64.0 * UNIT64 * (scale + float(np.abs(centre).max()))
    steps = np.arange(-FIRST_CUBES, FIRST_CUBES) + 0.5
    half = 0.5 * learned / FIRST_CUBES
    cubes = 2.0 * half * np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    whole, done = (2.0 * learned) ** 3, 0.0
    seen, largest = 0, 0.0
    while len(cubes):
        reach = SQRT3 * half * (1.0 + 1e-9) + 1e-9
        radius = np.linalg.norm(cubes, axis=1)
        inside = radius - reach <= learned
        inside[inside] = distance.distance(cubes[inside] + centre) + reach >= clearance
        done += float((~inside).sum()) * (2.0 * half) ** 3
        cubes, radius = cubes[inside], radius[inside]
        seen += len(cubes)
        if seen > most:
            return None
        bound = _with_continuation(field, _bounds(prepared, cubes / scale, (half + moved) / scale), radius + reach)
        open_ = bound > goal
        largest = max(largest, float(bound[~open_].max(initial=0.0)))
        done += float((~open_).sum()) * (2.0 * half) ** 3
        progress(min(1.0, done / whole), f"‖∇f̃‖: {seen} cubes, {int(open_.sum())} of {2.0 * half:.2g} m open")
        half *= 0.5
        cubes = (cubes[open_][:, None, :] + half * _CORNERS).reshape(-1, 3)
    return largest


def _bounds(prepared: Prepared, centres: Float[np.ndarray, "m 3"], half_width: float) -> Float[np.ndarray, "m"]:
    answer = np.empty(len(centres))

    def work(part: slice) -> None:
        stop = min(part.stop, len(centres))
        for start in range(part.start, stop, _CHUNK):
            piece = slice(start, min(start + _CHUNK, stop))
            rows = centres[piece]
            answer[piece] = slope_bounds(prepared, rows, np.full(len(rows), half_width))

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
