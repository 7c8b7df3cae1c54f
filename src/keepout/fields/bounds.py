"""Sound upper bounds of a softplus network over triangles and boxes, in float64, with every rounding accounted for.

Each element is carried through the network as an affine form z ∈ A(x) + [-r, r]: A exact in x, r what the relaxations
of the softplus lost. The intervals so found feed one backward pass of linear bound propagation (CROWN: Zhang et al.
2018), which bounds the output by a linear function of x, largest at a vertex. Alongside runs a bound of what
evaluating the same network in float32 can add. The argument is in docs/certificate.md.
"""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from keepout.fields import mlp

UNIT64, UNIT32 = 2.0**-53, 2.0**-24
ELEMENTARY = 8.0
"""Units in the last place by which float32 exp and log1p may be wrong; a test sweeps them."""

Vector = Float[np.ndarray, "m n"]


class Network(NamedTuple):
    """A scalar softplus network in float64 (its float32 numbers, exactly)."""

    weights: tuple[Float[np.ndarray, "_ _"], ...]
    biases: tuple[Float[np.ndarray, "_"], ...]
    beta: float
    single: bool
    """Whether it is evaluated in float32."""

    @classmethod
    def of(cls, layers: mlp.Layers, beta: float) -> "Network":
        """Return the network of a neural field."""
        return cls(
            tuple(np.asarray(W, np.float64) for W in layers.weights),
            tuple(np.asarray(b, np.float64) for b in layers.biases),
            beta,
            layers.weights[0].dtype == np.float32,
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


def _range(kind: str, columns: Float[np.ndarray, "k m n"]) -> tuple[Vector, Vector]:
    if kind == "triangle":
        return columns.min(axis=0), columns.max(axis=0)
    reach = np.abs(columns[1:]).sum(axis=0)
    return columns[0] - reach, columns[0] + reach


def _add(kind: str, columns: Float[np.ndarray, "k m n"], constant: np.ndarray) -> None:
    """Add a constant to an affine form, in place."""
    if kind == "triangle":
        columns += constant
    else:
        columns[0] += constant


def _softplus(z: np.ndarray, beta: float) -> tuple[np.ndarray, np.ndarray]:
    """σ and σ'."""
    t = beta * z
    e = np.exp(-np.abs(t))
    slope = np.where(t > 0.0, 1.0, e) / (1.0 + e)
    return (np.maximum(t, 0.0) + np.log1p(e)) / beta, slope


class _Layer(NamedTuple):
    """What the forward pass leaves for the backward pass, per element and neuron."""

    low: Vector
    high: Vector
    chord: Vector
    """Slope of the chord of σ over [low, high]."""
    above: Vector
    """σ(z) ≤ chord z + above."""
    magnitude: Float[np.ndarray, "n"]
    """max |σ| over the batch."""


class Bounds(NamedTuple):
    """Per element: an upper bound of the exact network, and of what float32 evaluation adds to or takes from it."""

    upper: Float[np.ndarray, "m"]
    evaluation_error: Float[np.ndarray, "m"]


def _forward(
    network: Network, elements: Elements
) -> tuple[list[_Layer], Float[np.ndarray, "m"], Float[np.ndarray, "m"]]:
    """Pre-activation intervals of every hidden layer, an upper bound of the output, and its float32 error."""
    kind, beta = elements.kind, network.beta
    columns = elements.columns
    low, high = _range(kind, columns)
    size = np.maximum(np.abs(low), np.abs(high))
    remainder = np.zeros_like(size)
    # Casting x to float32; the float64 normalisation before it is far below that.
    error = (1.01 * UNIT32 if network.single else 8.0 * UNIT64) * size
    magnitude = size.max(axis=0)
    layers: list[_Layer] = []
    last = len(network.weights) - 1
    for depth, (W, b) in enumerate(zip(network.weights, network.biases)):
        n = W.shape[1]
        absolute = np.abs(W)
        reach = absolute @ magnitude + np.abs(b)  # no partial sum of this layer exceeds it
        rounding = 8.0 * (n + 4) * UNIT64 * reach
        columns = columns @ W.T
        _add(kind, columns, b)
        remainder = remainder @ absolute.T + rounding
        low, high = _range(kind, columns)
        low, high = low - remainder, high + remainder
        unit = UNIT32 if network.single else UNIT64
        gamma = 1.01 * (n + 2) * unit
        error = error @ absolute.T * (1.0 + 1e-9) + gamma * (size @ absolute.T + error @ absolute.T + np.abs(b))
        if depth == last:
            return layers, high[:, 0], error[:, 0]
        at_low, _ = _softplus(low, beta)
        at_high, _ = _softplus(high, beta)
        width = high - low
        chord = np.clip((at_high - at_low) / np.maximum(width, 1e-300), 0.0, 1.0)
        above = np.maximum(at_low - chord * low, at_high - chord * high)
        # σ - chord z is convex; its minimum lies where σ' = chord. A tangent at an approximate place, lowered by what
        # its slope is off, is a lower bound whatever the rounding of that place.
        inner = np.clip(chord, 1e-12, 1.0 - 1e-12)
        place = np.clip(np.log(inner / (1.0 - inner)) / beta, low, high)
        at_place, slope = _softplus(place, beta)
        tilt = slope - chord
        below = at_place - chord * place + np.minimum(tilt * (low - place), tilt * (high - place))
        slack = 64.0 * UNIT64 * (np.abs(low) + np.abs(high) + 1.0 / beta)
        above, below = above + slack, below - slack
        magnitude = at_high.max(axis=0) + slack.max(axis=0)
        layers.append(_Layer(low, high, chord, above, magnitude))
        columns = columns * chord
        _add(kind, columns, 0.5 * (above + below))
        remainder = chord * remainder + 0.5 * (above - below)
        # σ' is largest at the upper end; σ in float32 adds its own rounding.
        _, steepest = _softplus(high + error, beta)
        size = at_high
        error = steepest * error * (1.0 + 1e-9) + ELEMENTARY * unit * (at_high + error + 2.0 / beta)
    raise AssertionError("a network ends in its output layer")


def upper_bounds(network: Network, elements: Elements) -> Bounds:
    """Upper bounds of the network over each element."""
    layers, forward_upper, error = _forward(network, elements)
    beta = network.beta
    m = elements.columns.shape[1]
    v = np.broadcast_to(network.weights[-1][0], (m, network.weights[-1].shape[1]))
    constant = np.full(m, network.biases[-1][0])
    absolute_v = np.abs(network.weights[-1][0])  # bounds |v| of every element, for the rounding
    rounding = 0.0
    for W, b, layer in zip(network.weights[-2::-1], network.biases[-2::-1], reversed(layers)):
        middle = 0.5 * (layer.low + layer.high)
        at_middle, tangent = _softplus(middle, beta)
        below = at_middle - tangent * middle
        slack = 64.0 * UNIT64 * (np.abs(layer.low) + np.abs(layer.high) + 1.0 / beta)
        positive = v >= 0.0
        slope = np.where(positive, layer.chord, tangent)
        shift = np.where(positive, layer.above, below - slack)
        n = W.shape[0]
        size = np.maximum(np.abs(layer.low), np.abs(layer.high)).max(axis=0) + 1.0 / beta
        rounding += 32.0 * (n + 8) * UNIT64 * float(absolute_v @ (size + layer.magnitude + np.abs(b)))
        scaled = v * slope
        constant = constant + (v * shift).sum(axis=1) + scaled @ b
        v = scaled @ W
        absolute_v = absolute_v @ np.abs(W)
    linear = np.einsum("kmi,mi->km", elements.columns, v)
    if elements.kind == "triangle":
        upper = linear.max(axis=0) + constant
    else:
        upper = linear[0] + np.abs(linear[1:]).sum(axis=0) + constant
    x_size = np.abs(elements.columns).sum(axis=0).max(axis=0)
    rounding += 32.0 * 16 * UNIT64 * float(absolute_v @ x_size)
    return Bounds(np.minimum(upper + rounding, forward_upper + 1e-12), error)
