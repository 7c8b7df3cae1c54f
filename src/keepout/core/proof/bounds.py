"""Sound upper bounds of a softplus network over triangles and boxes, in float64, with every rounding accounted for.

Each element is carried through the network as an affine form z ∈ A(x) + [-r, r]: A exact in x, r what the relaxations
of the softplus lost. The intervals so found feed one backward pass of linear bound propagation (CROWN: Zhang et al.
2018), which bounds the output by a linear function of x, largest at a vertex. Alongside runs a bound of what
evaluating the same network in float32 can add: every rounding times the largest slope of the output with respect to
the number that was rounded. What only bounds an error (r, and all of float32's) is itself carried in float32 and
enlarged by its own rounding: half the work. The argument is in docs/certificate.md.

A softplus is relaxed neuron by neuron in compiled loops. Most neurons are far from their kink all over a small element.
There σ is its limit, and the exponential is not asked.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Float32
from threadpoolctl import threadpool_limits

from keepout.core.cores import kernel, share_among_cores
from keepout.core.fields.neural import Layers

CHUNK = 128
"""Elements carried together by one core: what they leave for the backward pass stays in its cache."""
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


class Network(NamedTuple):
    """A scalar softplus network in float64 (its float32 numbers, exactly).

    Attributes:
        weights, biases: see `Layers`.
        beta: sharpness of the softplus.
        single: whether it is evaluated in float32.
        rounded, absolute: W and |W| of each layer in float32, to its rounding.
        spread: Σ |W| of each neuron.

    """

    weights: tuple[Float[np.ndarray, "_ _"], ...]
    biases: tuple[Float[np.ndarray, "_"], ...]
    beta: float
    single: bool
    rounded: tuple[Float32[np.ndarray, "_ _"], ...]
    absolute: tuple[Float32[np.ndarray, "_ _"], ...]
    spread: tuple[Float[np.ndarray, "_"], ...]

    @classmethod
    def of(cls, layers: Layers, beta: float) -> "Network":
        """Return the network of a neural field."""
        weights = tuple(np.asarray(W, np.float64) for W in layers.weights)
        return cls(
            weights,
            tuple(np.array(b, np.float64) for b in layers.biases),  # writable: else the kernels are compiled twice
            beta,
            layers.weights[0].dtype == np.float32,
            tuple(W.astype(np.float32) for W in weights),
            tuple(np.abs(W).astype(np.float32) for W in weights),
            tuple(np.abs(W).sum(axis=1) for W in weights),
        )


Elements = Float[np.ndarray, "k m 3"]
"""In normalised coordinates: the corners of m triangles (3, m, 3); or of m boxes the centre, then the halves of three
edges, which may be slanted (4, m, 3)."""


def triangles(corners: Float[np.ndarray, "m 3 3"]) -> Elements:
    """Triangles from (m, corner, coordinate)."""
    return np.ascontiguousarray(corners.transpose(1, 0, 2))


def boxes(centres: Float[np.ndarray, "m 3"], half_widths: Float[np.ndarray, "m 3"]) -> Elements:
    """Boxes along the axes from centres and half widths."""
    generators = np.eye(3)[:, None, :] * half_widths[None]
    return np.concatenate([centres[None], generators])


class Bounds(NamedTuple):
    """Per element, for the exact network N, in normalised units.

    Attributes:
        upper: N(x) ≤ upper.
        slope, constant: N(x) ≤ slope·x + constant, for the elements' own points only.
        evaluation_error: float32 evaluation differs from N(x) by no more.

    """

    upper: Float[np.ndarray, "m"]
    slope: Float[np.ndarray, "m 3"]
    constant: Float[np.ndarray, "m"]
    evaluation_error: Float[np.ndarray, "m"]


def upper_bounds(network: Network, elements: Elements) -> Bounds:
    """Bounds of the network over each element, on all cores."""
    m = elements.shape[1]
    answer = Bounds(np.empty(m), np.empty((m, 3)), np.empty(m), np.empty(m))

    def work(part: slice) -> None:
        room = _Room.of(network, len(elements))
        for start in range(part.start, part.stop, CHUNK):
            piece = elements[:, start : min(start + CHUNK, part.stop)]
            count = piece.shape[1]
            padded = np.concatenate([piece, np.repeat(piece[:, -1:], CHUNK - count, axis=1)], axis=1)
            with np.errstate(over="ignore", invalid="ignore"):  # what overflows is bounded by infinity
                some = _bounds(network, len(elements) == 4, padded, room)
            for whole, part_of_it in zip(answer, some):
                whole[start : start + count] = part_of_it[:count]

    # Every core has its own elements; products that are shared out among the cores as well only wait for each other.
    with threadpool_limits(1, "blas"):
        share_among_cores(work, m, chunk=8 * CHUNK)
    return answer


class _Layer(NamedTuple):
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
    def empty(cls, m: int, n: int) -> "_Layer":
        """Return room for a layer."""
        return cls(*(np.empty((m, n)) for _ in range(4)), *(np.empty((m, n), np.float32) for _ in range(4)))


class _Arithmetic(NamedTuple):
    """How a network is evaluated, and how its bounds are carried.

    Attributes:
        beta: sharpness of the softplus.
        unit: of the rounding of the evaluation.
        excess: share of what is carried in float32 that its own rounding may have taken.
        box: whether the elements are boxes.

    """

    beta: float
    unit: float
    excess: float
    box: bool


class _Sums(NamedTuple):
    """What a layer's arguments z are sums of.

    Attributes:
        bias: b.
        spread: Σ |W| of each neuron.
        rounding: of z in float64.
        terms: inputs.

    """

    bias: Float[np.ndarray, "n"]
    spread: Float[np.ndarray, "n"]
    rounding: Float[np.ndarray, "n"]
    terms: int


class _Room(NamedTuple):
    """Arrays of one core, used again for each chunk: asking the system for memory takes as long as the arithmetic.

    Attributes:
        columns, carried: of each layer's z, then of its activations; see `_relaxed`.
        layers: the relaxations of the hidden layers.
        rows, slopes: of the backward pass, with respect to each layer's input and to the last one's output.

    """

    columns: list[Float[np.ndarray, "k m _"]]
    carried: list[Float32[np.ndarray, "3 m _"]]
    layers: list[_Layer]
    rows: list[Float[np.ndarray, "m _"]]
    slopes: list[Float32[np.ndarray, "2 m _"]]

    @classmethod
    def of(cls, network: Network, k: int) -> "_Room":
        outputs = [len(b) for b in network.biases]
        inputs = [W.shape[1] for W in network.weights]
        return cls(
            [np.empty((k, CHUNK, n)) for n in outputs],
            [np.empty((3, CHUNK, n), np.float32) for n in outputs],
            [_Layer.empty(CHUNK, n) for n in outputs[:-1]],
            [np.empty((CHUNK, n)) for n in inputs],
            [np.empty((2, CHUNK, n), np.float32) for n in inputs],
        )


def _rounding(
    W: Float[np.ndarray, "p n"], b: Float[np.ndarray, "p"], magnitude: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "p"]:
    """Float64 rounding of a layer's sums: no partial sum exceeds |W| a + |b|."""
    return 8.0 * (W.shape[1] + 4) * UNIT64 * (np.abs(W) @ magnitude + np.abs(b))


def _times(a: Float[np.ndarray, "*m n"], b: Float[np.ndarray, "n p"], out: Float[np.ndarray, "*m p"]) -> None:
    np.matmul(a.reshape(-1, len(b)), b, out=out.reshape(-1, b.shape[1]))


def _bounds(network: Network, box: bool, given: Float[np.ndarray, "k m 3"], room: _Room) -> Bounds:
    weights, biases, m = network.weights, network.biases, CHUNK
    unit = UNIT32 if network.single else UNIT64
    # Share that a float32 sum of products of rounded numbers may lack of the sum of their sizes, doubled.
    excess = 4.0 * (max(max(W.shape) for W in weights) + 16) * UNIT32
    arithmetic = _Arithmetic(network.beta, unit, excess, box)
    if box:
        reach = np.abs(given[1:]).sum(axis=0)
        low, high = given[0] - reach, given[0] + reach
    else:
        low, high = given.min(axis=0), given.max(axis=0)
    size = np.maximum(np.abs(low), np.abs(high))
    # Casting x to float32; the float64 normalisation before it is far below that.
    input_error = (1.01 * UNIT32 if network.single else 8.0 * UNIT64) * size
    columns, carried = given, np.stack([np.zeros_like(size), input_error, size + input_error]).astype(np.float32)
    magnitude, extremes, active = size.max(axis=0), [], np.full(m, 3.0)
    for depth, (W, b, absolute) in enumerate(zip(weights, biases, network.absolute)):
        _times(columns, W.T, room.columns[depth])
        _times(carried, absolute.T, room.carried[depth])
        columns, carried = room.columns[depth], room.carried[depth]
        if depth < len(weights) - 1:
            sums = _Sums(b, network.spread[depth], _rounding(W, b, magnitude), W.shape[1])
            extreme, magnitude = _relaxed(room.layers[depth], columns, carried, active, sums, arithmetic)
            extremes.append(extreme + magnitude + np.abs(b))

    last, (left, error, total) = columns[:, :, 0], carried[:, :, 0].astype(np.float64) * (1.0 + excess)
    left += _rounding(weights[-1], biases[-1], magnitude)
    reach = np.abs(last[1:]).sum(axis=0)
    low, high = (last[0] - reach, last[0] + reach) if box else (last.min(axis=0), last.max(axis=0))
    low, high = low - left + biases[-1], high + left + biases[-1]
    size, largest = total + np.abs(biases[-1]), np.maximum(-low, high) + error
    evaluation = sum_rounding(active, weights[-1].shape[1], size, largest, network.spread[-1][0], arithmetic)
    forward_error = error + evaluation

    row, slopes = room.rows[-1], room.slopes[-1]
    row[:], slopes[0] = weights[-1][0], network.rounded[-1][0]
    slopes[1] = 2.0 * UNIT32 * np.abs(slopes[0])  # the output's own weights, rounded
    constant = np.full(m, biases[-1][0])
    size_of_row, rounding_back = np.abs(weights[-1][0]), 0.0  # |row| of every element is at most this
    for depth in range(len(weights) - 2, -1, -1):
        W, b = weights[depth], biases[depth]
        rounding_back += 32.0 * (len(b) + 8) * UNIT64 * float(size_of_row @ extremes[depth])
        _pulled_back(room.layers[depth], b, row, slopes, excess, constant, evaluation)
        _times(row, W, room.rows[depth])
        _times(slopes[0], network.rounded[depth], room.slopes[depth][0])
        _times(slopes[1], network.absolute[depth], room.slopes[depth][1])
        row, slopes = room.rows[depth], room.slopes[depth]
        size_of_row = size_of_row @ np.abs(W)
    slopes = np.abs(slopes[0]) + slopes[1] * (1.0 + excess)
    evaluation = (evaluation + (slopes * input_error).sum(axis=1)) * (1.0 + 1e-5)
    linear = np.einsum("kmi,mi->km", given, row)
    constant += rounding_back + 32.0 * 16 * UNIT64 * float(size_of_row @ np.abs(given).sum(axis=0).max(axis=0))
    largest = linear[0] + np.abs(linear[1:]).sum(axis=0) if box else linear.max(axis=0)
    upper = np.minimum(largest + constant, high + 1e-12)
    error = np.minimum(evaluation, forward_error)
    return Bounds(*(np.where(np.isnan(part), np.inf, part) for part in (upper, row, constant, error)))


@kernel(error_model="numpy")
def softplus(t) -> Any:
    """Return log(1 + exp(t)) and the logistic function of t."""
    e = np.exp(-abs(t))
    return max(t, 0.0) + np.log1p(e), (1.0 if t > 0.0 else e) / (1.0 + e)


@kernel(error_model="numpy")
def sum_rounding(active, terms, size, largest, spread, arithmetic) -> Any:
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
        arithmetic: of the evaluation.

    """
    plain = (terms + 2) * size
    sharp = 0.5 * (active + 1) * (size + largest) + size
    return 1.01 * np.minimum(arithmetic.unit * plain, arithmetic.unit * sharp + TAIL / arithmetic.beta * spread)


@kernel(error_model="numpy")
def _logistic_range(low, high, low_slope, high_slope, error):
    """Bounds of the logistic function from low - error to high + error, from its values at low and high."""
    if error < 0.05:
        return low_slope * (1.0 - error), min(high_slope * (1.0 + 1.1 * error), 1.0)
    return softplus(low - error)[1] * (1.0 - 1e-12), min(softplus(high + error)[1] * (1.0 + 1e-12), 1.0)


@kernel(error_model="numpy", inline="always")
def _saturated(low, high, slack, beta):
    """Relax a neuron that is far from its kink from low to high: σ is z or 0, and σ' 1 or 0, to less than `TAIL`."""
    on = 1.0 if low > 0.0 else 0.0
    lines = (on, TAIL / beta + slack, on, -slack)
    return lines, -slack, TAIL / beta + slack, max(on - TAIL, 0.0), min(on + TAIL, 1.0), on * high + TAIL / beta


@kernel(error_model="numpy", inline="always")
def _curved(low, high, error, slack, beta):
    """Relax a neuron from low to high: σ lies below its chord, and above the tangent of the same slope s.

    That tangent is s z plus the entropy of s over β. Any slope is sound; that of a short chord is rounding.
    """
    low_value, low_slope = softplus(beta * low)
    high_value, high_slope = softplus(beta * high)
    middle, width = 0.5 * (low + high), beta * (high - low)
    middle_value, middle_slope = softplus(beta * middle)
    s = middle_slope if width < 1e-6 else min(max((high_value - low_value) / width, 0.0), 1.0)
    upper = max(low_value - s * beta * low, high_value - s * beta * high) / beta + slack
    inner = min(max(s, 1e-12), 1.0 - 1e-12)
    entropy = -(inner * np.log(inner) + (1.0 - inner) * np.log1p(-inner)) / beta
    lower = entropy - abs(s - inner) * (abs(low) + abs(high)) - slack
    lines = (s, upper, middle_slope, middle_value / beta - middle_slope * middle - slack)
    flattest, steepest = _logistic_range(beta * low, beta * high, low_slope, high_slope, beta * error)
    return lines, lower, upper, flattest, steepest, high_value / beta


@kernel(error_model="numpy")
def _relaxed(layer, columns, carried, active, sums, arithmetic):
    """Take each element through one layer's softplus: `columns`, `carried`, `active` go in before, and come out after.

    Args:
        layer: a `_Layer`, filled in.
        columns: (k, m, n) the affine part of z less the bias, by corners or by centre and generators; after it that of
            σ(z).
        carried: (3, m, n) of z less the bias: what is not affine, the float32 error so far, and the sum of sizes that
            float32 rounded; after it the same of σ(z), the last as size and error.
        active: (m,) of the inputs of each element, how many are not saturated at 0; after it, of the layer's neurons.
        sums: what z is a sum of.
        arithmetic: of the evaluation and of these bounds.

    Returns:
        Over the whole batch, the largest |z| + 1/β and the largest activation of each neuron.

    """
    beta, unit, excess, box = arithmetic
    _, m, n = columns.shape
    extreme, magnitude, whole = np.zeros(n), np.zeros(n), 1.0 + excess
    for i in range(m):
        off = 0
        for j in range(n):
            bias = sums.bias[j]
            a, b, c = columns[0, i, j] + bias, columns[1, i, j], columns[2, i, j]
            if box:
                reach = abs(b) + abs(c) + abs(columns[3, i, j])
                low, high = a - reach, a + reach
            else:
                b, c = b + bias, c + bias
                low, high = min(a, b, c), max(a, b, c)
            left = carried[0, i, j] * whole + sums.rounding[j]
            low, high = low - left, high + left
            error = carried[1, i, j] * whole
            size, largest = carried[2, i, j] * whole + abs(bias), max(-low, high) + error
            own = sum_rounding(active[i], sums.terms, size, largest, sums.spread[j], arithmetic)
            error += own
            layer.sum_rounding[i, j] = own
            extreme[j] = max(extreme[j], -low, high)

            slack = _SLACK * (abs(low) + abs(high) + 1.0 / beta)
            if beta * (low - error) > SATURATED or beta * (high + error) < -SATURATED:
                lines, lower, upper, flattest, steepest, largest = _saturated(low, high, slack, beta)
                off += low < 0.0
            else:
                lines, lower, upper, flattest, steepest, largest = _curved(low, high, error, slack, beta)
            layer.chord[i, j], layer.above[i, j], layer.tangent[i, j], layer.below[i, j] = lines
            layer.slope[i, j] = 0.5 * (steepest + flattest)
            layer.slope_radius[i, j] = 0.5 * (steepest - flattest) + _STORED

            s, shift = lines[0], 0.5 * (upper + lower)
            columns[0, i, j] = s * a + shift
            if box:
                columns[1, i, j], columns[2, i, j], columns[3, i, j] = s * b, s * c, s * columns[3, i, j]
            else:
                columns[1, i, j], columns[2, i, j] = s * b + shift, s * c + shift
            own = ELEMENTARY * unit * (largest + error + 2.0 / beta)
            if largest == TAIL / beta:  # what is computed, and what is exact, is between 0 and this
                own = min(own, largest)
            layer.activation_rounding[i, j] = own
            error = steepest * error * (1.0 + 1e-9) + own
            carried[0, i, j] = s * left + 0.5 * (upper - lower)
            carried[1, i, j], carried[2, i, j] = error, largest + error
            magnitude[j] = max(magnitude[j], largest + slack)
        active[i] = n - off
    return extreme + 1.0 / beta, magnitude


@kernel(error_model="numpy")
def _pulled_back(layer, bias, row, slopes, excess, constant, evaluation):
    """Take the linear bound of the output, and the range of its slope, from a layer's activations to their arguments.

    Args:
        layer: the `_Layer`.
        bias: b, which goes into the constant.
        row: (m, n) the output is at most row·σ + constant; in place, row·z + constant.
        slopes: (2, m, n) the output's slope with respect to σ, and how far it may be from it; in place, with respect to
            z.
        excess: share of the slope that the coming sum may add to its radius.
        constant: (m,) of the linear bound; in place.
        evaluation: (m,) float32 error of the output; in place.

    """
    m, n = row.shape
    for i in range(m):
        total, error = 0.0, 0.0
        for j in range(n):
            v = row[i, j]
            if v >= 0.0:
                row[i, j] = v * layer.chord[i, j]
                total += v * layer.above[i, j]
            else:
                row[i, j] = v * layer.tangent[i, j]
                total += v * layer.below[i, j]
            total += row[i, j] * bias[j]
            middle, radius = np.float64(slopes[0, i, j]), slopes[1, i, j] * (1.0 + excess)
            error += (abs(middle) + radius) * layer.activation_rounding[i, j]
            radius = abs(middle) * layer.slope_radius[i, j] + radius * (layer.slope[i, j] + layer.slope_radius[i, j])
            middle *= layer.slope[i, j]
            error += (abs(middle) + radius) * layer.sum_rounding[i, j]
            slopes[0, i, j], slopes[1, i, j] = middle, radius + excess * abs(middle)
        constant[i] += total
        evaluation[i] += error
