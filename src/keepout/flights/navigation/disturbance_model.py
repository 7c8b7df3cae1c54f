"""What the filter takes the disturbance for: a constant, or a constant plus sinusoids of known frequencies, an axis."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from keepout.core.errors import ScenarioError
from keepout.core.motion.arrays import as_float64


class DisturbanceModel(eqx.Module):
    """ξ̇ = A ξ, d = C ξ from one control period to the next, alike in every axis; build with `disturbance_model`.

    ξ is the constant, then for each frequency ω the sinusoid and its quarter period ahead, so that d is the sum of the
    constant and the sinusoids. All of it is in newtons and none of it grows: A turns each pair by ωT a period.

    Attributes:
        cosine: cos ωT of each frequency.
        sine: sin ωT.
        mean_output: C̄ = (1/T) ∫₀ᵀ C exp(A t) dt, the weights of ξ in the mean over the period that begins.

    """

    cosine: Float[Array, " k"]
    sine: Float[Array, " k"]
    mean_output: Float[Array, " q"]

    @property
    def size(self) -> int:
        """The number q of states an axis."""
        return self.mean_output.shape[0]

    def moved(self, state: Float[Array, "q *rest"]) -> Float[Array, "q *rest"]:
        """Give exp(A T) ξ."""
        rows = [state[0]]
        for k in range(self.cosine.shape[0]):
            a, b = state[1 + 2 * k], state[2 + 2 * k]
            rows += [self.cosine[k] * a + self.sine[k] * b, self.cosine[k] * b - self.sine[k] * a]
        return jnp.stack(rows)

    def mean(self, state: Float[Array, "q *rest"]) -> Float[Array, "*rest"]:
        """Give C̄ ξ, the mean over the period that begins, N."""
        return sum((self.mean_output[i] * state[i] for i in range(1, self.size)), self.mean_output[0] * state[0])


def disturbance_model(frequencies: Sequence[float], period: float) -> DisturbanceModel:
    """Build the model of a constant plus sinusoids of `frequencies` (rad/s; none: the constant alone) each axis.

    Raises:
        ScenarioError: a frequency that is not in (0, π/period) or that repeats.

    """
    omegas = np.asarray([float(w) for w in frequencies])
    if len(set(omegas.tolist())) != len(omegas) or not np.all((omegas > 0.0) & (omegas < np.pi / period)):
        raise ScenarioError(
            f"filter frequencies: {omegas.tolist()} rad/s; distinct values in (0, {np.pi / period:.3g}) are needed"
        )
    angle = omegas * period
    # 1 − cos without its cancellation at slow frequencies
    pairs = np.stack([np.sin(angle), 2.0 * np.sin(angle / 2.0) ** 2], axis=1) / angle[:, None]
    mean_output = np.concatenate([[1.0], pairs.reshape(-1)])
    return DisturbanceModel(as_float64(np.cos(angle)), as_float64(np.sin(angle)), as_float64(mean_output))
