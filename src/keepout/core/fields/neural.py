"""The learned field: a softplus network evaluated in float32, with a safe continuation outside its domain.

The network's value, gradient and Hessian come from one forward and one reverse sweep. Its functions take any float
type, so that the network can be flown in float32 and checked in float64.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from keepout.core.compiled.in_batches import in_chunks
from keepout.core.fields.continuation import Matrices, RadialContinuation, Rows, Vectors
from keepout.core.fields.field import Field, Hessians, Points, Values

CHUNK = 128
"""Points evaluated together: their activations stay in cache on a CPU."""


class Layers(NamedTuple):
    """Weights of a scalar network: hidden layers a_l = σ(W_l a_{l-1} + b_l), then one linear output w·a + c.

    `weights` are one (outputs, inputs) matrix a layer, the output layer (1, inputs) last.
    """

    weights: tuple[Float[Array, "_ _"], ...]
    biases: tuple[Float[Array, "_"], ...]


def times(a: Float[Array, "n k"], b: Float[Array, "k m"]) -> Float[Array, "n m"]:
    """Multiply in full precision on every device: a GPU's shorter products would break the certificate."""
    return jnp.matmul(a, b, precision=jax.lax.Precision.HIGHEST)


def softplus(z: Float[Array, "*n"], beta: float) -> Float[Array, "*n"]:
    """σ(z) = log(1 + exp(β z))/β, without overflow.

    The logarithm is not `log1p`, which is slower, and keeps digits of σ far below 1/β that no later sum keeps.
    """
    t = beta * z
    return (jnp.maximum(t, 0.0) + jnp.log(1.0 + jnp.exp(-jnp.abs(t)))) / beta


def softplus_and_slope(z: Float[Array, "*n"], beta: float) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """σ and σ' = s, the logistic function of β z, from one exponential; σ'' = β s (1 - s)."""
    t = beta * z
    e = jnp.exp(-jnp.abs(t))
    both = 1.0 + e
    value = (jnp.maximum(t, 0.0) + jnp.log(both)) / beta
    reciprocal = 1.0 / both
    return value, jnp.where(t > 0.0, reciprocal, e * reciprocal)


def value(layers: Layers, beta: float, x: Vectors) -> Rows:
    """Return the network's value at each row of x."""
    a = x
    for W, b in zip(layers.weights[:-1], layers.biases[:-1]):
        a = softplus(times(a, W.T) + b, beta)
    return times(a, layers.weights[-1].T)[:, 0] + layers.biases[-1][0]


def value_and_gradient(layers: Layers, beta: float, x: Vectors) -> tuple[Rows, Vectors]:
    """Value and gradient at each row of x: one forward and one reverse sweep."""
    return sweeps(layers, beta, x)[0]


class Kept(NamedTuple):
    """What the two sweeps meet on their way: a_l from x on, s_l = σ'(z_l), and ∂f/∂z_l, of each hidden layer."""

    activations: list[Float[Array, "n _"]]
    slopes: list[Float[Array, "n _"]]
    z_bars: list[Float[Array, "n _"]]


def sweeps(layers: Layers, beta: float, x: Vectors) -> tuple[tuple[Rows, Vectors], Kept]:
    """Value and gradient at each row of x, and what a further derivative needs of their sweeps."""
    activations, slopes = [x], []
    for W, b in zip(layers.weights[:-1], layers.biases[:-1]):
        a, slope = softplus_and_slope(times(activations[-1], W.T) + b, beta)
        activations.append(a)
        slopes.append(slope)
    out = times(activations[-1], layers.weights[-1].T)[:, 0] + layers.biases[-1][0]
    a_bar, z_bars = jnp.broadcast_to(layers.weights[-1][0], activations[-1].shape), []
    for W, slope in zip(layers.weights[-2::-1], reversed(slopes)):
        z_bars.append(a_bar * slope)
        a_bar = times(z_bars[-1], W)
    return (out, a_bar), Kept(activations, slopes, z_bars[::-1])


def value_gradient_hessian(layers: Layers, beta: float, x: Vectors) -> tuple[Rows, Vectors, Matrices]:
    """Value, gradient and Hessian at each row of x.

    One forward sweep carries the value and three tangents J_l = ∂z_l/∂x; one reverse sweep carries ā_l = ∂f/∂a_l and
    adds H = Σ_l J_lᵀ diag(σ''(z_l) ⊙ ā_l) J_l: five units of work, where nested differentiation needs eight or more.
    """
    n = x.shape[0]
    first = layers.weights[0]
    a, slope = softplus_and_slope(times(x, first.T) + layers.biases[0], beta)
    J = jnp.broadcast_to(first.T[:, None, :], (3, n, first.shape[0]))
    tape = [(slope, J)]
    for W, b in zip(layers.weights[1:-1], layers.biases[1:-1]):
        # Value and tangents go through one product: the weights are read once.
        Z = times(jnp.concatenate([a[None], slope * J]).reshape(4 * n, -1), W.T).reshape(4, n, -1)
        J = Z[1:]
        a, slope = softplus_and_slope(Z[0] + b, beta)
        tape.append((slope, J))
    out = times(a, layers.weights[-1].T)[:, 0] + layers.biases[-1][0]

    a_bar = jnp.broadcast_to(layers.weights[-1][0], a.shape)
    curvatures = []
    for W, (slope, J) in zip(layers.weights[-2::-1], reversed(tape)):
        z_bar = a_bar * slope
        curvatures.append((z_bar * (1.0 - slope), J))
        a_bar = times(z_bar, W)
    return out, a_bar, beta * _sum_of_curvatures(curvatures)


def _sum_of_curvatures(curvatures: list[tuple[Float[Array, "n _"], Float[Array, "3 n _"]]]) -> Matrices:
    """Return Σ_l J_lᵀ diag(c_l) J_l of each point.

    Layers of one width are added up before the neurons are: few large sums are faster than many small ones.
    """
    widths = sorted({c.shape[-1] for c, _ in curvatures})
    groups = [[(c, J) for c, J in curvatures if c.shape[-1] == width] for width in widths]
    if curvatures[0][0].shape[0] == 1:
        # For a single point the number of kernels counts, not that of products: all nine entries in one.
        full = sum(jnp.sum(sum((c * J)[:, None] * J[None] for c, J in group), axis=-1) for group in groups)
        return jnp.moveaxis(jnp.asarray(full), -1, 0)
    pairs = {
        (i, j): sum(jnp.sum(sum(c * J[i] * J[j] for c, J in group), axis=-1) for group in groups)
        for i in range(3)
        for j in range(i, 3)
    }
    rows = [jnp.stack([pairs[min(i, j), max(i, j)] for j in range(3)], axis=-1) for i in range(3)]
    return jnp.stack(rows, axis=-2)


class NeuralField(Field):
    """f̃(p) = s N((p - c)/s) with N a softplus network, p cast to the weights' float type after normalisation.

    The unit ball of the normalisation is the ball on which the network was trained; up to the continuation's domain
    radius the value is the network's own, beyond it the continuation's.

    Attributes:
        layers: the network, usually float32.
        scale: s, metres.
        continuation: centre c, domain, and what happens beyond it.
        beta: sharpness β of the softplus.

    """

    layers: Layers
    scale: Float[Array, ""]
    continuation: RadialContinuation
    beta: float = eqx.field(static=True)

    def _evaluate(self, function, points: Points) -> tuple[Any, Any, tuple[int, ...]]:
        batch = points.shape[:-1]
        flat = jnp.asarray(points, jnp.float64).reshape(-1, 3)

        def rows(p):
            q = self.continuation.into_domain(p)
            x = ((q - self.continuation.centre) / self.scale).astype(self.layers.weights[0].dtype)
            return function(self.layers, self.beta, x)

        return flat, in_chunks(rows, flat, CHUNK), batch

    def value(self, points: Points) -> Values:
        """Signed distance in metres."""
        flat, y, batch = self._evaluate(value, points)
        return self.continuation.value(flat, y.astype(jnp.float64) * self.scale).reshape(batch)

    def value_and_gradient(self, points: Points) -> tuple[Values, Points]:
        """Signed distance in metres and its gradient, by one forward and one reverse sweep."""
        flat, (y, g), batch = self._evaluate(value_and_gradient, points)
        value = self.continuation.value(flat, y.astype(jnp.float64) * self.scale)
        gradient = self.continuation.gradient(flat, g.astype(jnp.float64))
        return value.reshape(batch), gradient.reshape(*batch, 3)

    def value_gradient_hessian(self, points: Points) -> tuple[Values, Points, Hessians]:
        """Signed distance in metres, gradient, and Hessian in 1/m, by one forward and one reverse sweep."""
        flat, (y, g, H), batch = self._evaluate(value_gradient_hessian, points)
        g = g.astype(jnp.float64)
        value = self.continuation.value(flat, y.astype(jnp.float64) * self.scale)
        gradient = self.continuation.gradient(flat, g)
        hessian = self.continuation.hessian(flat, g, H.astype(jnp.float64) / self.scale)
        return value.reshape(batch), gradient.reshape(*batch, 3), hessian.reshape(*batch, 3, 3)
