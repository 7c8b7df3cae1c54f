"""A proved bound of ‖∇f̃‖ of a neural field wherever a chaser's centre can be, by branch and bound over cubes.

The bound of one cube is exact to first order in its size, in float64. With D_l = diag(σ'(z_l)), the gradient of the
softplus network N is the row w D_L W_L ⋯ D_1 W_1. Let S_l be a D_l near the cube's centre, ā_l and U_l what multiplies
S_l from the left and from the right when every D is S, and Δ_l = D_l - S_l. Then, exactly, the gradient is
ā_1 S_1 W_1 + Σ_l a_l Δ_l U_l, with a_l the row ā_l with the true D above l. Over a cube σ'(z) = s + q (z - z_c) ± r and
z = z_c + A dx ± ρ, so the part with ā_l diag(q_l A_l dx) U_l is linear in dx, with all its cancellations; its norm is
largest at a corner. The rest is of second order, and is bounded neuron by neuron. The argument, and what covers the
rounding, are in docs/certificate.md.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from threadpoolctl import threadpool_limits

from keepout.core.cores import kernel, share_among_cores
from keepout.core.fields.field import values_and_gradients
from keepout.core.fields.neural import NeuralField
from keepout.core.geometry.distance import Distance
from keepout.core.geometry.octree import CORNERS, SQRT3
from keepout.core.progress import Progress, silent
from keepout.core.proof.bounds import UNIT64, Network, softplus

MOST_CUBES = 12_000_000
"""The search ends with so many cubes: some ten minutes a core for 4 × 96."""
GAP, LOOSEST = 0.5, 2.0
"""Cubes are split while their bound exceeds the largest slope found by more than this share of it; where there are too
many, only the worst, and a bound beyond the second share counts as none."""
FIRST_CUBES = 20
"""Cubes to the radius of the learned ball at the start."""
_CHUNK = 128
_LOOKED_AT = 8192
"""Open cubes, of each size, at whose centres the slope is evaluated, to find a larger one."""
SATURATED = 40.0
"""Where |β z| exceeds it, σ and σ' differ from their limits by less than 5e-18, relative to 1/β and to 1."""


class Lipschitz(NamedTuple):
    """The largest ‖∇f̃‖ found, and a proved upper bound of all; None where it would be too loose."""

    found: float
    proved: float | None


def prove_lipschitz(
    field: NeuralField, distance: Distance, *, found: float, clearance: float = 0.0, progress: Progress = silent
) -> Lipschitz:
    """Prove a bound of ‖∇f̃‖ at every point whose distance d from the target is at least `clearance`.

    Cubes over the learned ball are split until each is bounded by 1 + `GAP` times the largest slope found, or by what
    `MOST_CUBES` of them suffice for; the continuation beyond the ball, and the allowance it subtracts, are covered by
    closed forms. The bound is of the network in exact arithmetic: two values as evaluated in float32 differ by at most
    the bound times the points' distance, plus twice the certificate's `evaluation_error`.

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
        bound = _with_continuation(field, _bounds(prepared, cubes / scale, (half + moved) / scale), farthest)
        order = np.argsort(-bound)
        worst = cubes[order[:_LOOKED_AT]] + centre
        worst = worst[distance.distance(worst) >= clearance]
        slopes = np.linalg.norm(values_and_gradients(field, worst)[1], axis=1)
        found = max(found, float(slopes.max(initial=0.0)))
        open_ = bound > max((1.0 + GAP) * found, largest)
        # The children of these, eight each, take at most half of the room that is left.
        open_[order[max(MOST_CUBES - seen, 0) // 16 :]] = False
        largest = float(bound[~open_].max(initial=largest))  # and not a number, which proves nothing, where one is not
        done += float((~open_).sum()) * (2.0 * half) ** 3
        progress(min(1.0, done / whole), f"‖∇f̃‖: {seen} cubes, {int(open_.sum())} of {2.0 * half:.2g} m open")
        half *= 0.5
        cubes = (cubes[open_][:, None, :] + half * CORNERS).reshape(-1, 3)
    return Lipschitz(found, largest if largest <= (1.0 + LOOSEST) * found else None)


def _bounds(prepared: "Prepared", centres: Float[np.ndarray, "m 3"], half_width: float) -> Float[np.ndarray, "m"]:
    answer = np.empty(len(centres))

    def work(part: slice) -> None:
        for start in range(part.start, part.stop, _CHUNK):
            piece = slice(start, min(start + _CHUNK, part.stop))
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


class _Layer(NamedTuple):
    """One hidden layer over each box: (boxes, neurons), or (3, boxes, neurons).

    Attributes:
        slope: s, the diagonal of S.
        bend: q.
        wobble: r + q ρ.
        deviation: bound of |σ' - s|.
        steepest: bound of σ'.
        generators: A times the three half widths.
        tangents: U, one coordinate of x after the other.

    """

    slope: Float[np.ndarray, "m n"]
    bend: Float[np.ndarray, "m n"]
    wobble: Float[np.ndarray, "m n"]
    deviation: Float[np.ndarray, "m n"]
    steepest: Float[np.ndarray, "m n"]
    generators: Float[np.ndarray, "3 m n"]
    tangents: Float[np.ndarray, "3 m n"]


class Prepared(NamedTuple):
    """A network with what its bounds need of its matrices.

    Attributes:
        network: in float64.
        absolute: |W| of each layer.
        spectral: ‖W‖₂ of each layer, rounded up.
        rounding: bounds what the float64 sums of rows and tangents add to a gradient. As |s| < 2 and |q A dx| ≤ 1/2, no
            part of such a sum exceeds Π 2‖W‖_F.

    """

    network: Network
    absolute: tuple[Float[np.ndarray, "_ _"], ...]
    spectral: tuple[float, ...]
    rounding: float

    @classmethod
    def of(cls, network: Network) -> "Prepared":
        """Prepare a network."""
        widest = max(W.shape[1] for W in network.weights)
        size = float(np.prod([2.0 * np.linalg.norm(W) * (1.0 + 1e-9) for W in network.weights]))
        return cls(
            network,
            tuple(np.abs(W) for W in network.weights),
            tuple(float(np.linalg.norm(W, 2)) * (1.0 + 1e-9) for W in network.weights),
            64.0 * (widest + 8) * len(network.weights) * UNIT64 * size,
        )


def slope_bounds(
    prepared: Prepared, centres: Float[np.ndarray, "m 3"], half_widths: Float[np.ndarray, "m"]
) -> Float[np.ndarray, "m"]:
    """Upper bounds of the network's gradient norm over cubes, in the network's own coordinates."""
    layers = _forward(prepared, centres, half_widths)
    output = prepared.network.weights[-1][0]
    row = np.broadcast_to(output, (len(centres), len(output))).copy()
    stray = np.zeros_like(row)  # |a_l - ā_l| is at most this, neuron by neuron
    strayed = np.zeros(len(row))  # and its Euclidean norm at most this
    linear, rest = np.zeros((len(row), 3, 3)), np.zeros((len(row), 3))
    for depth in range(len(layers) - 1, -1, -1):
        scaled, reach, moved, largest = _backward(row, stray, strayed, *layers[depth], linear, rest)
        strayed = prepared.spectral[depth] * (moved + largest * strayed)
        row, stray = scaled @ prepared.network.weights[depth], reach @ prepared.absolute[depth]
    corners = row + np.einsum("cj,mjk->cmk", CORNERS, linear)
    return np.linalg.norm(np.abs(corners) + rest, axis=2).max(axis=0) * (1.0 + 1e-9) + prepared.rounding


def _forward(
    prepared: Prepared, centres: Float[np.ndarray, "m 3"], half_widths: Float[np.ndarray, "m"]
) -> list[_Layer]:
    network, m = prepared.network, len(centres)
    columns = np.concatenate([centres[None], np.eye(3)[:, None, :] * half_widths[None, :, None]])
    tangents = np.broadcast_to(np.eye(3)[:, None, :], (3, m, 3))
    remainder = np.zeros((m, 3))
    magnitude = (np.abs(centres) + half_widths[:, None]).max(axis=0)
    layers = []
    for W, b, absolute in zip(network.weights[:-1], network.biases[:-1], prepared.absolute):
        n = W.shape[1]
        largest = absolute @ magnitude + np.abs(b)  # no partial sum of this layer exceeds it
        columns = (columns.reshape(-1, n) @ W.T).reshape(4, m, -1)
        columns[0] += b
        tangents = (tangents.reshape(-1, n) @ W.T).reshape(3, m, -1)
        remainder = remainder @ absolute.T + 8.0 * (n + 4) * UNIT64 * largest
        layer, columns, passed, remainder, magnitude = _relax(columns, tangents, remainder, network.beta)
        layers.append(_Layer._make((*layer, tangents)))
        tangents = passed
    return layers


@kernel(error_model="numpy", inline="always")
def _off_line(q, low, high, low_slope, high_slope, beta):
    """Give the largest and the least σ' - q z from low to high: at the ends, or where σ'' = β σ' (1 - σ') = q."""
    above = max(low_slope - q * low, high_slope - q * high)
    below = min(low_slope - q * low, high_slope - q * high)
    small = 2.0 * q / beta / (1.0 + np.sqrt(max(1.0 - 4.0 * q / beta, 0.0)))
    if small > 0.0:
        place = (np.log(small) - np.log1p(-small)) / beta
        if low <= place <= high:
            below = min(below, small - q * place)
            above = max(above, small - q * place)
        if low <= -place <= high:
            below = min(below, 1.0 - small + q * place)
            above = max(above, 1.0 - small + q * place)
    return above, below


@kernel(error_model="numpy")
def _relax(columns, tangents, remainder, beta):
    """Relax σ and σ' of every neuron over every box; see `_Layer` and `bounds`."""
    _, m, n = columns.shape
    slope, bend, wobble = np.empty((m, n)), np.empty((m, n)), np.empty((m, n))
    deviation, steepest = np.empty((m, n)), np.empty((m, n))
    after, passed, left = np.empty((4, m, n)), np.empty((3, m, n)), np.empty((m, n))
    magnitude = np.zeros(n)
    for i in range(m):
        for j in range(n):
            centre, rho = columns[0, i, j], remainder[i, j]
            reach = abs(columns[1, i, j]) + abs(columns[2, i, j]) + abs(columns[3, i, j])
            low, high = centre - reach - rho, centre + reach + rho
            width, size = max(high - low, 1e-300), abs(low) + abs(high)
            slack = 64.0 * UNIT64 * (1.0 + beta * size)
            if beta * low > SATURATED or beta * high < -SATURATED:
                # σ is z or 0, and σ' 1 or 0, to far less than the slack.
                on = 1.0 if low > 0.0 else 0.0
                slope[i, j], bend[i, j], steepest[i, j] = on, 0.0, on + slack
                wobble[i, j], deviation[i, j] = slack, slack
                for k in range(4):
                    after[k, i, j] = on * columns[k, i, j]
                for k in range(3):
                    passed[k, i, j] = on * tangents[k, i, j]
                left[i, j] = on * rho + slack / beta
                magnitude[j] = max(magnitude[j], on * high + slack / beta)
                continue

            low_value, low_slope = softplus(beta * low)
            high_value, high_slope = softplus(beta * high)
            low_value, high_value = low_value / beta, high_value / beta

            narrow = beta * width < 1e-6  # there differences are rounding; any q and any chord are sound
            q = beta * high_slope * (1.0 - high_slope) if narrow else (high_slope - low_slope) / width
            q = min(max(q, 0.0), 0.25 * beta)
            above, below = _off_line(q, low, high, low_slope, high_slope, beta)
            s = 0.5 * (above + below) + q * centre
            slope[i, j], bend[i, j], steepest[i, j] = s, q, high_slope + slack
            wobble[i, j] = 0.5 * (above - below) + q * rho + slack
            deviation[i, j] = min(q * reach + wobble[i, j], max(high_slope - s, s - low_slope) + slack)

            # σ lies below its chord, and above the tangent of the same slope c: c z plus the entropy of c over β.
            chord = high_slope if narrow else min(max((high_value - low_value) / width, 0.0), 1.0)
            upper = max(low_value - chord * low, high_value - chord * high)
            c = min(max(chord, 1e-12), 1.0 - 1e-12)
            lower = -(c * np.log(c) + (1.0 - c) * np.log1p(-c)) / beta - abs(chord - c) * size
            after[0, i, j] = chord * centre + 0.5 * (upper + lower)
            for k in range(3):
                after[1 + k, i, j] = chord * columns[1 + k, i, j]
                passed[k, i, j] = s * tangents[k, i, j]
            left[i, j] = chord * rho + 0.5 * (upper - lower) + slack / beta
            magnitude[j] = max(magnitude[j], high_value + slack / beta)
    return (slope, bend, wobble, deviation, steepest, columns[1:]), after, passed, left, magnitude


@kernel(error_model="numpy")
def _backward(row, stray, strayed, slope, bend, wobble, deviation, steepest, generators, tangents, linear, rest):
    """Add one layer's share to `linear` and `rest`, and prepare the step to the layer below.

    Returns ā S, a bound of |a D - ā S| neuron by neuron, the norm of |ā| δ, and the largest σ' of each box.
    """
    m, n = row.shape
    scaled, reach = np.empty((m, n)), np.empty((m, n))
    moved, largest = np.zeros(m), np.zeros(m)
    first, second, norm = np.zeros(3), np.zeros(3), np.zeros(3)
    for i in range(m):
        first[:], second[:], norm[:] = 0.0, 0.0, 0.0
        for j in range(n):
            a, size, delta = row[i, j], abs(row[i, j]), deviation[i, j]
            for k in range(3):
                u = tangents[k, i, j]
                first[k] += size * wobble[i, j] * abs(u)
                second[k] += stray[i, j] * delta * abs(u)
                norm[k] += (delta * u) ** 2
                weighted = a * bend[i, j] * u
                for g in range(3):
                    linear[i, g, k] += weighted * generators[g, i, j]
            scaled[i, j] = a * slope[i, j]
            reach[i, j] = size * delta + steepest[i, j] * stray[i, j]
            moved[i] += (size * delta) ** 2
            largest[i] = max(largest[i], steepest[i, j])
        moved[i] = np.sqrt(moved[i])
        for k in range(3):
            rest[i, k] += first[k] + min(second[k], strayed[i] * np.sqrt(norm[k]))
    return scaled, reach, moved, largest
