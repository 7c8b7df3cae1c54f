"""What training minimises: Keepout's loss, and the paper's in both readings."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float32

from keepout.core.fields import mlp
from keepout.core.learning import second_sweep
from keepout.core.learning.profile import TrainingProfile


class Batch(NamedTuple):
    """Labelled points in normalised coordinates; see `sampling.Samples` for the labels."""

    x: Float32[Array, "n 3"]
    distance: Float32[Array, "n"]
    gradient: Float32[Array, "n 3"]
    smooth: Bool[Array, "n"]
    hidden: Bool[Array, "n"]
    weight: Float32[Array, "n"]
    """How much the distance error of the point counts (Keepout's loss)."""


class Parted(NamedTuple):
    """Labelled points by what is learned from them: value and gradient, or the value only, at half the work."""

    sloped: Batch
    plain: Batch

    @classmethod
    def by(cls, profile: TrainingProfile, data: Batch) -> "Parted":
        """Part points as the profile's loss takes them: the paper's asks every point for a gradient."""
        sloped = np.asarray(data.smooth) | (profile.loss != "keepout")
        return cls(Batch(*(column[sloped] for column in data)), Batch(*(column[~sloped] for column in data)))


def keepout_terms(
    layers: mlp.Layers, profile: TrainingProfile, scale: float, batch: Batch, sloped: int
) -> tuple[Float32[Array, "n"], Float32[Array, "{sloped}"]]:
    """For each point: the weighted pinball of the distance error; for the first ones, the squared gradient error.

    Where the point is hidden, only over-statement counts.
    """
    y, gradient = second_sweep.value_and_gradient(layers, profile.beta, batch.x[:sloped])
    y = jnp.concatenate([y, mlp.value(layers, profile.beta, batch.x[sloped:])])
    e = y * jnp.float32(scale) - batch.distance
    over, under = jnp.maximum(e, 0.0), jnp.where(batch.hidden, 0.0, jnp.maximum(-e, 0.0))
    near = batch.distance < profile.near_field
    tau = jnp.where(near, jnp.float32(profile.over_weight), jnp.float32(profile.far_over_weight))
    value_term = batch.weight * (tau * over + (1 - tau) * under)
    first = Batch(*(column[:sloped] for column in batch))
    difference = jnp.sum((gradient - first.gradient) ** 2, axis=-1)
    slope_term = jnp.float32(profile.gradient_weight) * first.smooth * difference / (1 + jnp.abs(first.distance))
    return value_term, slope_term


def paper_terms(
    layers: mlp.Layers, profile: TrainingProfile, scale: float, batch: Batch
) -> tuple[Float32[Array, "n"], Float32[Array, "n"]]:
    """For each point: L_P and η L_E, after Zhou et al. Section IV, in normalised units.

    L_E = (‖∇f̃‖ - 1)². The printed L_P = (κ-1) max(e, 0) leaves f̃ → -∞ free; the pinball reading is
    ((κ-1)/2) e + ((κ+1)/2)|e| = κ max(e, 0) + max(-e, 0).
    """
    y, gradient = second_sweep.value_and_gradient(layers, profile.beta, batch.x)
    e = y - batch.distance / jnp.float32(scale)
    kappa = jnp.float32(profile.kappa)
    if profile.loss == "paper_printed":
        value_term = (kappa - 1) * jnp.maximum(e, 0.0)
    else:
        value_term = kappa * jnp.maximum(e, 0.0) + jnp.maximum(-e, 0.0)
    norm = jnp.sqrt(jnp.sum(gradient * gradient, axis=-1) + jnp.float32(1e-12))
    return value_term, jnp.float32(profile.gradient_weight) * (norm - 1) ** 2


def terms(
    layers: mlp.Layers, profile: TrainingProfile, scale: float, batch: Batch, sloped: int
) -> tuple[Float32[Array, "n"], Float32[Array, "{sloped}"]]:
    """Return the two terms of the profile's loss: at each point, and at the first ones, which have a gradient term."""
    if profile.loss == "keepout":
        return keepout_terms(layers, profile, scale, batch, sloped)
    return paper_terms(layers, profile, scale, batch)
