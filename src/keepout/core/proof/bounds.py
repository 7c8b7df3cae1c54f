"""Sound upper bounds of a softplus network over triangles and boxes, in float64, with every rounding accounted for.

Each element is carried through the network as an affine form z ∈ A(x) + [-r, r]: A exact in x, r what the relaxations
of the softplus lost. The intervals so found feed one backward pass of linear bound propagation (CROWN: Zhang et al.
2018), which bounds the output by a linear function of x, largest at a vertex. Alongside runs a bound of what
evaluating the same network in float32 can add: every rounding times the largest slope of the output with respect to
the number that was rounded. What only bounds an error (r, and all of float32's) is itself carried in float32 and
enlarged by its own rounding: half the work. The argument is in docs/certificate.md.
"""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Float32
from threadpoolctl import threadpool_limits

from keepout.core.cores import share_among_cores
from keepout.core.fields import mlp
from keepout.core.proof import relaxation
from keepout.core.proof.relaxation import UNIT32, UNIT64

CHUNK = 128
"""Elements carried together by one core: what they leave for the backward pass stays in its cache."""


class Network(NamedTuple):
    """A scalar softplus network in float64 (its float32 numbers, exactly).

    Attributes:
        weights, biases: see `mlp.Layers`.
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
    def of(cls, layers: mlp.Layers, beta: float) -> "Network":
        """Return the network of a neural field."""
        weights = tuple(np.asarray(W, np.float64) for W in layers.weights)
        return cls(
            weights,
            tuple(np.asarray(b, np.float64) for b in layers.biases),
            beta,
            layers.weights[0].dtype == np.float32,
            tuple(W.astype(np.float32) for W in weights),
            tuple(np.abs(W).astype(np.float32) for W in weights),
            tuple(np.abs(W).sum(axis=1) for W in weights),
        )


class Elements(NamedTuple):
    """Triangles by their corners, or boxes by centre and half widths, in normalised coordinates.

    Attributes:
        kind: what the columns are.
        columns: (3, m, 3) corners; or (4, m, 3): centre, then the three half-width vectors along the axes.

    """

    kind: Literal["triangle", "box"]
    columns: Float[np.ndarray, "k m 3"]


def triangles(corners: Float[np.ndarray, "m 3 3"]) -> Elements:
    """Triangles from (m, corner, coordinate)."""
    return Elements("triangle", np.ascontiguousarray(corners.transpose(1, 0, 2)))


def boxes(centres: Float[np.ndarray, "m 3"], half_widths: Float[np.ndarray, "m 3"]) -> Elements:
    """Boxes from centres and half widths."""
    generators = np.eye(3)[:, None, :] * half_widths[None]
    return Elements("box", np.concatenate([centres[None], generators]))


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
    m = elements.columns.shape[1]
    answer = Bounds(np.empty(m), np.empty((m, 3)), np.empty(m), np.empty(m))

    def work(part: slice) -> None:
        room = _Room.of(network, len(elements.columns))
        for start in range(part.start, min(part.stop, m), CHUNK):
            piece = elements.columns[:, start : min(start + CHUNK, part.stop)]
            count = piece.shape[1]
            padded = np.concatenate([piece, np.repeat(piece[:, -1:], CHUNK - count, axis=1)], axis=1)
            with np.errstate(over="ignore", invalid="ignore"):  # what overflows is bounded by infinity
                some = _bounds(network, elements.kind == "box", padded, room)
            for whole, part_of_it in zip(answer, some):
                whole[start : start + count] = part_of_it[:count]

    # Every core has its own elements; products that are shared out among the cores as well only wait for each other.
    with threadpool_limits(1, "blas"):
        share_among_cores(work, m, chunk=8 * CHUNK)
    return answer


class _Room(NamedTuple):
    """Arrays of one core, used again for each chunk: asking the system for memory takes as long as the arithmetic.

    Attributes:
        columns, carried: of each layer's z, then of its activations; see `relaxation.relax`.
        layers: the relaxations of the hidden layers.
        rows, slopes: of the backward pass, with respect to each layer's input and to the last one's output.

    """

    columns: list[Float[np.ndarray, "k m _"]]
    carried: list[Float32[np.ndarray, "3 m _"]]
    layers: list[relaxation.Layer]
    rows: list[Float[np.ndarray, "m _"]]
    slopes: list[Float32[np.ndarray, "2 m _"]]

    @classmethod
    def of(cls, network: Network, k: int) -> "_Room":
        outputs = [len(b) for b in network.biases]
        inputs = [W.shape[1] for W in network.weights]
        return cls(
            [np.empty((k, CHUNK, n)) for n in outputs],
            [np.empty((3, CHUNK, n), np.float32) for n in outputs],
            [relaxation.Layer.empty(CHUNK, n) for n in outputs[:-1]],
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
            extreme, magnitude = relaxation.relax(
                room.layers[depth],
                columns,
                carried,
                active,
                _rounding(W, b, magnitude),
                b,
                network.spread[depth],
                W.shape[1],
                excess,
                box,
                network.beta,
                unit,
            )
            extremes.append(extreme + magnitude + np.abs(b))

    last, (left, error, total) = columns[:, :, 0], carried[:, :, 0].astype(np.float64) * (1.0 + excess)
    left += _rounding(weights[-1], biases[-1], magnitude)
    reach = np.abs(last[1:]).sum(axis=0)
    low, high = (last[0] - reach, last[0] + reach) if box else (last.min(axis=0), last.max(axis=0))
    low, high = low - left + biases[-1], high + left + biases[-1]
    evaluation = relaxation.sum_rounding(
        active,
        weights[-1].shape[1],
        total + np.abs(biases[-1]),
        np.maximum(-low, high) + error,
        network.spread[-1][0],
        unit,
        network.beta,
    )
    forward_error = error + evaluation

    row, slopes = room.rows[-1], room.slopes[-1]
    row[:], slopes[0] = weights[-1][0], network.rounded[-1][0]
    slopes[1] = 2.0 * UNIT32 * np.abs(slopes[0])  # the output's own weights, rounded
    constant = np.full(m, biases[-1][0])
    size_of_row, rounding_back = np.abs(weights[-1][0]), 0.0  # |row| of every element is at most this
    for depth in range(len(weights) - 2, -1, -1):
        W, b = weights[depth], biases[depth]
        rounding_back += 32.0 * (len(b) + 8) * UNIT64 * float(size_of_row @ extremes[depth])
        relaxation.pull_back(room.layers[depth], b, row, slopes, excess, constant, evaluation)
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
