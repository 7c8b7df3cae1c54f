"""The network in mid-training, in metres: what the hunt for counter-examples asks."""

import dataclasses
import functools

import jax
import numpy as np
from jaxtyping import Array, Float, Float32

from keepout.core.compiled.xla import WIDE
from keepout.core.fields import mlp
from keepout.core.fields.domain import Domain
from keepout.core.fields.evaluate import in_pieces
from keepout.core.geometry.level_set import Points

ROWS = 2048
"""Points evaluated together, float32."""


@dataclasses.dataclass(frozen=True)
class Learned:
    """A network in normalised coordinates, asked in metres, without continuation.

    Attributes:
        layers: its weights.
        beta: sharpness of the softplus.
        domain: of the field.

    """

    layers: mlp.Layers
    beta: float
    domain: Domain

    def value(self, points: Points) -> Float[np.ndarray, "n"]:
        """Return f̃ in metres at (n, 3) points in metres."""
        y = in_pieces(lambda x: _value(self.layers, self.beta, x), self._normalised(points))
        return y.astype(np.float64) * self.domain.learned_radius

    def gradient(self, points: Points) -> Float[np.ndarray, "n 3"]:
        """Return ∇f̃, (n, 3), at points in metres."""
        return in_pieces(lambda x: _gradient(self.layers, self.beta, x), self._normalised(points)).astype(np.float64)

    def _normalised(self, points: Points) -> Float32[np.ndarray, "n 3"]:
        return ((points - self.domain.centre) / self.domain.learned_radius).astype(np.float32)


@functools.partial(jax.jit, static_argnums=(1,), compiler_options=WIDE)
def _value(layers: mlp.Layers, beta: float, x: Float32[Array, "n 3"]) -> Float32[Array, "n"]:
    return mlp.in_chunks(lambda rows: mlp.value(layers, beta, rows), x, ROWS)


@functools.partial(jax.jit, static_argnums=(1,), compiler_options=WIDE)
def _gradient(layers: mlp.Layers, beta: float, x: Float32[Array, "n 3"]) -> Float32[Array, "n 3"]:
    return mlp.in_chunks(lambda rows: mlp.value_and_gradient(layers, beta, rows)[1], x, ROWS)
