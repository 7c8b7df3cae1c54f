"""One softplus layer over triangles and boxes, forward and backward, neuron by neuron; see `bounds`.

Most neurons are far from their kink all over a small element. There σ is its limit, and the exponential is not asked.
"""

from typing import Any, NamedTuple, no_type_check

import numba
import numpy as np
from jaxtyping import Float, Float32

UNIT64, UNIT32 = 2.0**-53, 2.0**-24
ELEMENTARY = 8.0
"""Units of rounding by which exp and log may be wrong in float32, and exp and log1p in float64, relative to what they
return; and those by which a float32 softplus may be, relative to |σ| + 2/β. A test sweeps them."""
SATURATED = 16.0
"""Where |β z| exceeds it, σ and σ' differ from their limits by less than `TAIL`, relative to 1/β and to 1."""
TAIL = 1.2e-7
_SLACK = 64.0 * UNIT64
_STORED = 1.2e-7
"""What storing a number between 0 and 1 in float32 may take from it, doubled."""


class Layer(NamedTuple):
    """What the forward pass leaves for the backward pass, per element and neuron of one hidden layer.

    Attributes:
        chord, above: σ(z) ≤ chord z + above.
        tangent, below: σ(z) ≥ tangent z + below.
        slope, slope_radius: σ' is within the radius of the slope wherever exact and float32 evaluation may be.
        sum_rounding: what float32 adds to z itself.
        activation_rounding: what float32 adds to σ(z) itself.

    """

    chord: Float[np.ndarray, "m n"]
    above: Float[np.ndarray, "m n"]
    tangent: Float[np.ndarray, "m n"]
    below: Float[np.ndarray, "m n"]
    slope: Float32[np.ndarray, "m n"]
    slope_radius: Float32[np.ndarray, "m n"]
    sum_rounding: Float32[np.ndarray, "m n"]
    activation_rounding: Float32[np.ndarray, "m n"]

    @classmethod
    def empty(cls, m: int, n: int) -> "Layer":
        """Return room for a layer."""
        return cls(*(np.empty((m, n)) for _ in range(4)), *(np.empty((m, n), np.float32) for _ in range(4)))


def relax(
    layer: Layer,
    columns: Float[np.ndarray, "k m n"],
    carried: Float32[np.ndarray, "3 m n"],
    active: Float[np.ndarray, "m"],
    rounding: Float[np.ndarray, "n"],
    bias: Float[np.ndarray, "n"],
    spread: Float[np.ndarray, "n"],
    terms: int,
    excess: float,
    box: bool,
    beta: float,
    unit: float,
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Take each element through one layer's softplus: `columns`, `carried`, `active` go in before, and come out after.

    Args:
        layer: filled in.
        columns: the affine part of z less the bias, by corners or by centre and generators; after it that of σ(z).
        carried: of z less the bias: what is not affine, the float32 error so far, and the sum of sizes that float32
            rounded; after it the same of σ(z), the last as size and error.
        active: of the inputs of each element, how many are not saturated at 0; after it, of the layer's neurons.
        rounding: of z in float64.
        bias: b.
        spread: Σ |W| of each neuron.
        terms: inputs.
        excess: share of `carried` that its own rounding may have taken.
        box: whether the elements are boxes.
        beta: sharpness of the softplus.
        unit: of the rounding of the evaluation.

    Returns:
        Over the whole batch, the largest |z| + 1/β and the largest activation of each neuron.

    """
    return _relaxed(*layer, columns, carried, active, rounding, bias, spread, terms, excess, box, beta, unit)


def pull_back(
    layer: Layer,
    bias: Float[np.ndarray, "n"],
    row: Float[np.ndarray, "m n"],
    slopes: Float32[np.ndarray, "2 m n"],
    excess: float,
    constant: Float[np.ndarray, "m"],
    evaluation: Float[np.ndarray, "m"],
) -> None:
    """Take the linear bound of the output, and the range of its slope, from a layer's activations to their arguments.

    Args:
        layer: the relaxation.
        bias: b, which goes into the constant.
        row: the output is at most row·σ + constant; in place, row·z + constant.
        slopes: the output's slope with respect to σ, and how far it may be from it; in place, with respect to z.
        excess: share of the slope that the coming sum may add to its radius.
        constant: of the linear bound; in place.
        evaluation: float32 error of the output; in place.

    """
    _pulled_back(*layer, bias, row, slopes, excess, constant, evaluation)


@no_type_check  # run-time shape checks would wrap what numba compiles
@numba.njit(cache=True, nogil=True, error_model="numpy")
def softplus(t) -> Any:
    """Return log(1 + exp(t)) and the logistic function of t."""
    e = np.exp(-abs(t))
    return max(t, 0.0) + np.log1p(e), (1.0 if t > 0.0 else e) / (1.0 + e)


@no_type_check
@numba.njit(cache=True, nogil=True, error_model="numpy")
def sum_rounding(active, terms, size, largest, spread, unit, beta) -> Any:
    """Bound what rounding adds to a sum of products and a bias, in any order, with fused multiply-add or without.

    An addition rounds by a unit of its result at most, and every partial sum lies between the sum of the negative terms
    and that of the positive ones, so it is no larger than (size + largest)/2. It rounds by no more than either of its
    terms, too: what is saturated at 0 adds no more than itself.

    Args:
        active: terms that are not saturated at 0.
        terms: all.
        size: of the terms, with the bias, in sum.
        largest: of the result.
        spread: sum of the sizes of the weights.
        unit: of the rounding.
        beta: sharpness of the softplus.

    """
    plain = (terms + 2) * size
    sharp = 0.5 * (active + 1) * (size + largest) + size
    return 1.01 * np.minimum(unit * plain, unit * sharp + TAIL / beta * spread)


@no_type_check
@numba.njit(cache=True, nogil=True, error_model="numpy")
def _logistic_range(low, high, low_slope, high_slope, error):
    """Bounds of the logistic function from low - error to high + error, from its values at low and high."""
    if error < 0.05:
        return low_slope * (1.0 - error), min(high_slope * (1.0 + 1.1 * error), 1.0)
    return softplus(low - error)[1] * (1.0 - 1e-12), min(softplus(high + error)[1] * (1.0 + 1e-12), 1.0)


@no_type_check
@numba.njit(cache=True, nogil=True, error_model="numpy")
def _relaxed(
    chord,
    above,
    tangent,
    below,
    slope,
    slope_radius,
    sums,
    activations,
    columns,
    carried,
    active,
    rounding,
    bias,
    spread,
    terms,
    excess,
    box,
    beta,
    unit,
):
    _, m, n = columns.shape
    extreme, magnitude, whole = np.zeros(n), np.zeros(n), 1.0 + excess
    for i in range(m):
        off = 0
        for j in range(n):
            a, b, c = columns[0, i, j] + bias[j], columns[1, i, j], columns[2, i, j]
            if not box:
                b, c = b + bias[j], c + bias[j]
            if box:
                reach = abs(b) + abs(c) + abs(columns[3, i, j])
                low, high = a - reach, a + reach
            else:
                low, high = min(a, b, c), max(a, b, c)
            left = carried[0, i, j] * whole + rounding[j]
            low, high = low - left, high + left
            error = carried[1, i, j] * whole
            size, largest = carried[2, i, j] * whole + abs(bias[j]), max(-low, high) + error
            own = sum_rounding(active[i], terms, size, largest, spread[j], unit, beta)
            error += own
            sums[i, j] = own
            extreme[j] = max(extreme[j], -low, high)
            slack = _SLACK * (abs(low) + abs(high) + 1.0 / beta)

            if beta * (low - error) > SATURATED or beta * (high + error) < -SATURATED:
                on = 1.0 if low > 0.0 else 0.0
                chord[i, j], above[i, j] = on, TAIL / beta + slack
                tangent[i, j], below[i, j] = on, -slack
                lower, upper = -slack, TAIL / beta + slack
                steepest, flattest = min(on + TAIL, 1.0), max(on - TAIL, 0.0)
                largest = on * high + TAIL / beta
                off += low < 0.0
            else:
                low_value, low_slope = softplus(beta * low)
                high_value, high_slope = softplus(beta * high)
                middle, width = 0.5 * (low + high), beta * (high - low)
                middle_value, middle_slope = softplus(beta * middle)
                # Any slope is sound; that of a chord shorter than this is rounding.
                s = middle_slope if width < 1e-6 else min(max((high_value - low_value) / width, 0.0), 1.0)
                # σ lies below its chord, and above the tangent of the same slope s: s z plus the entropy of s over β.
                upper = max(low_value - s * beta * low, high_value - s * beta * high) / beta + slack
                inner = min(max(s, 1e-12), 1.0 - 1e-12)
                entropy = -(inner * np.log(inner) + (1.0 - inner) * np.log1p(-inner)) / beta
                lower = entropy - abs(s - inner) * (abs(low) + abs(high)) - slack
                chord[i, j], above[i, j] = s, upper
                tangent[i, j], below[i, j] = middle_slope, middle_value / beta - middle_slope * middle - slack
                flattest, steepest = _logistic_range(beta * low, beta * high, low_slope, high_slope, beta * error)
                largest = high_value / beta

            s = chord[i, j]
            columns[0, i, j] = s * a + 0.5 * (upper + lower)
            if box:
                columns[1, i, j], columns[2, i, j] = s * b, s * c
                columns[3, i, j] = s * columns[3, i, j]
            else:
                columns[1, i, j] = s * b + 0.5 * (upper + lower)
                columns[2, i, j] = s * c + 0.5 * (upper + lower)
            own = ELEMENTARY * unit * (largest + error + 2.0 / beta)
            if largest == TAIL / beta:  # what is computed, and what is exact, is between 0 and this
                own = min(own, largest)
            activations[i, j] = own
            error = steepest * error * (1.0 + 1e-9) + own
            carried[0, i, j] = s * left + 0.5 * (upper - lower)
            carried[1, i, j] = error
            carried[2, i, j] = largest + error
            slope[i, j] = 0.5 * (steepest + flattest)
            slope_radius[i, j] = 0.5 * (steepest - flattest) + _STORED
            magnitude[j] = max(magnitude[j], largest + slack)
        active[i] = n - off
    return extreme + 1.0 / beta, magnitude


@no_type_check
@numba.njit(cache=True, nogil=True, error_model="numpy")
def _pulled_back(
    chord,
    above,
    tangent,
    below,
    slope,
    slope_radius,
    sums,
    activations,
    bias,
    row,
    slopes,
    excess,
    constant,
    evaluation,
):
    m, n = row.shape
    for i in range(m):
        total, error = 0.0, 0.0
        for j in range(n):
            v = row[i, j]
            if v >= 0.0:
                row[i, j] = v * chord[i, j]
                total += v * above[i, j]
            else:
                row[i, j] = v * tangent[i, j]
                total += v * below[i, j]
            total += row[i, j] * bias[j]
            middle, radius = np.float64(slopes[0, i, j]), slopes[1, i, j] * (1.0 + excess)
            error += (abs(middle) + radius) * activations[i, j]
            radius = abs(middle) * slope_radius[i, j] + radius * (slope[i, j] + slope_radius[i, j])
            middle *= slope[i, j]
            error += (abs(middle) + radius) * sums[i, j]
            slopes[0, i, j], slopes[1, i, j] = middle, radius + excess * abs(middle)
        constant[i] += total
        evaluation[i] += error
