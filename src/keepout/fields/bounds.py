"""Sound upper bounds of a softplus network over triangles and boxes, in float64, with every rounding accounted for.

Each element is carried through the network as an affine form z ∈ A(x) + [-r, r]: A exact in x, r what the relaxations
of the softplus lost. The intervals so found feed one backward pass of linear bound propagation (CROWN: Zhang et al.
2018), which bounds the output by a linear function of x, largest at a vertex. Alongside runs a bound of what
evaluating the same network in float32 can add: every rounding times the largest slope of the output with respect to
the number that was rounded. The argument is in docs/certificate.md.
"""

import functools
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from keepout.fields import mlp

UNIT64, UNIT32 = 2.0**-53, 2.0**-24
ELEMENTARY = 8.0
"""Units in the last place by which exp and log1p may be wrong, in float32 and in float64; a test sweeps them."""

Vector = Float[Array, "m n"]


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
    """Bounds of the network over each element."""
    answer = _bounds(
        elements.kind, network.single, network.beta, network.weights, network.biases, jnp.asarray(elements.columns)
    )
    return Bounds(*(np.asarray(part) for part in answer))


def _range(kind: str, columns: Float[Array, "k m n"]) -> tuple[Vector, Vector]:
    if kind == "triangle":
        return columns.min(axis=0), columns.max(axis=0)
    reach = jnp.abs(columns[1:]).sum(axis=0)
    return columns[0] - reach, columns[0] + reach


def _plus(kind: str, columns: Float[Array, "k m n"], constant: Array) -> Float[Array, "k m n"]:
    """Add a constant to an affine form."""
    return columns + constant if kind == "triangle" else columns.at[0].add(constant)


def _softplus(z: Array, beta: float) -> tuple[Array, Array]:
    """σ and σ'."""
    t = beta * z
    e = jnp.exp(-jnp.abs(t))
    slope = jnp.where(t > 0.0, 1.0, e) / (1.0 + e)
    return (jnp.maximum(t, 0.0) + jnp.log1p(e)) / beta, slope


class _Layer(NamedTuple):
    """What the forward pass leaves for the backward pass, per element and neuron of one hidden layer."""

    low: Vector
    high: Vector
    chord: Vector
    """Slope of the chord of σ over [low, high]."""
    above: Vector
    """σ(z) ≤ chord z + above."""
    magnitude: Float[Array, "n"]
    """max |σ| over the batch."""
    slope_low: Vector
    slope_high: Vector
    """σ' lies between these wherever exact and float32 evaluation may be."""
    sum_rounding: Vector
    """What float32 adds to z itself."""
    activation_rounding: Vector
    """What float32 adds to σ(z) itself."""


def _forward(
    kind: str, single: bool, beta: float, weights: tuple[Array, ...], biases: tuple[Array, ...], columns: Array
) -> tuple[list[_Layer], Array, Array, Array, Array]:
    """Return hidden layers, an upper bound of the output, its own rounding, its error, and the error of the input."""
    low, high = _range(kind, columns)
    size = jnp.maximum(jnp.abs(low), jnp.abs(high))
    remainder = jnp.zeros_like(size)
    # Casting x to float32; the float64 normalisation before it is far below that.
    input_error = error = (1.01 * UNIT32 if single else 8.0 * UNIT64) * size
    unit = UNIT32 if single else UNIT64
    magnitude = size.max(axis=0)
    layers: list[_Layer] = []
    last = len(weights) - 1
    for depth, (W, b) in enumerate(zip(weights, biases)):
        n = W.shape[1]
        absolute = jnp.abs(W)
        reach = absolute @ magnitude + jnp.abs(b)  # no partial sum of this layer exceeds it
        rounding = 8.0 * (n + 4) * UNIT64 * reach
        columns = _plus(kind, columns @ W.T, b)
        remainder, carried, total = jnp.stack([remainder, error, size + error]) @ absolute.T
        remainder = remainder + rounding
        low, high = _range(kind, columns)
        low, high = low - remainder, high + remainder
        sum_rounding = 1.01 * (n + 2) * unit * (total + jnp.abs(b))
        error = carried * (1.0 + 1e-9) + sum_rounding
        if depth == last:
            return layers, high[:, 0], sum_rounding[:, 0], error[:, 0], input_error
        at_low, _ = _softplus(low, beta)
        at_high, _ = _softplus(high, beta)
        width = high - low
        chord = jnp.clip((at_high - at_low) / jnp.maximum(width, 1e-300), 0.0, 1.0)
        above = jnp.maximum(at_low - chord * low, at_high - chord * high)
        # σ - chord z is convex; its minimum lies where σ' = chord. A tangent at an approximate place, lowered by what
        # its slope is off, is a lower bound whatever the rounding of that place.
        inner = jnp.clip(chord, 1e-12, 1.0 - 1e-12)
        place = jnp.clip(jnp.log(inner / (1.0 - inner)) / beta, low, high)
        at_place, slope = _softplus(place, beta)
        tilt = slope - chord
        below = at_place - chord * place + jnp.minimum(tilt * (low - place), tilt * (high - place))
        slack = 64.0 * UNIT64 * (jnp.abs(low) + jnp.abs(high) + 1.0 / beta)
        above, below = above + slack, below - slack
        magnitude = at_high.max(axis=0) + slack.max(axis=0)
        _, steepest = _softplus(high + error, beta)
        _, flattest = _softplus(low - error, beta)
        activation_rounding = ELEMENTARY * unit * (at_high + error + 2.0 / beta)
        layers.append(
            _Layer(
                low,
                high,
                chord,
                above,
                magnitude,
                flattest * (1.0 - 1e-12),
                steepest * (1.0 + 1e-12),
                sum_rounding,
                activation_rounding,
            )
        )
        columns = _plus(kind, columns * chord, 0.5 * (above + below))
        remainder = chord * remainder + 0.5 * (above - below)
        size = at_high
        error = steepest * error * (1.0 + 1e-9) + activation_rounding
    raise AssertionError("a network ends in its output layer")


@functools.partial(jax.jit, static_argnums=(0, 1, 2))
def _bounds(
    kind: str, single: bool, beta: float, weights: tuple[Array, ...], biases: tuple[Array, ...], columns: Array
) -> tuple[Array, Array, Array, Array]:
    layers, forward_upper, evaluation, forward_error, input_error = _forward(
        kind, single, beta, weights, biases, columns
    )
    m = columns.shape[1]
    v = jnp.broadcast_to(weights[-1][0], (m, weights[-1].shape[1]))
    constant = jnp.full(m, biases[-1][0])
    absolute_v = jnp.abs(weights[-1][0])  # bounds |v| of every element, for the rounding
    rounding = 0.0
    # The output's slope with respect to an activation lies within `radius` of `centre`.
    centre, radius = v, jnp.zeros_like(v)
    for W, b, layer in zip(weights[-2::-1], biases[-2::-1], reversed(layers)):
        absolute = jnp.abs(W)
        evaluation = evaluation + ((jnp.abs(centre) + radius) * layer.activation_rounding).sum(axis=1)
        slope_middle = 0.5 * (layer.slope_high + layer.slope_low)
        slope_radius = 0.5 * (layer.slope_high - layer.slope_low)
        centre, radius = centre * slope_middle, jnp.abs(centre) * slope_radius + radius * layer.slope_high
        evaluation = evaluation + ((jnp.abs(centre) + radius) * layer.sum_rounding).sum(axis=1)
        radius = (radius + 1e-12 * jnp.abs(centre)) @ absolute

        middle = 0.5 * (layer.low + layer.high)
        at_middle, tangent = _softplus(middle, beta)
        below = at_middle - tangent * middle
        slack = 64.0 * UNIT64 * (jnp.abs(layer.low) + jnp.abs(layer.high) + 1.0 / beta)
        positive = v >= 0.0
        slope = jnp.where(positive, layer.chord, tangent)
        shift = jnp.where(positive, layer.above, below - slack)
        n = W.shape[0]
        size = jnp.maximum(jnp.abs(layer.low), jnp.abs(layer.high)).max(axis=0) + 1.0 / beta
        rounding = rounding + 32.0 * (n + 8) * UNIT64 * (absolute_v @ (size + layer.magnitude + jnp.abs(b)))
        scaled = v * slope
        constant = constant + (v * shift).sum(axis=1) + scaled @ b
        centre, v = jnp.stack([centre, scaled]) @ W
        absolute_v = absolute_v @ absolute
    evaluation = (evaluation + ((jnp.abs(centre) + radius) * input_error).sum(axis=1)) * (1.0 + 1e-9)
    linear = jnp.einsum("kmi,mi->km", columns, v)
    x_size = jnp.abs(columns).sum(axis=0).max(axis=0)
    constant = constant + rounding + 32.0 * 16 * UNIT64 * (absolute_v @ x_size)
    largest = linear.max(axis=0) if kind == "triangle" else linear[0] + jnp.abs(linear[1:]).sum(axis=0)
    upper = jnp.minimum(largest + constant, forward_upper + 1e-12)
    return upper, v, constant, jnp.minimum(evaluation, forward_error)
