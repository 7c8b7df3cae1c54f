"""What training minimises: Keepout's loss, and the paper's in both readings."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float32

from keepout.fields import mlp, second_sweep
from keepout.fields.profile import Profile


class Batch(NamedTuple):
    """Labelled points in normalised coordinates; see `sampling.Samples` for the labels."""

    x: Float32[Array, "n 3"]
    distance: Float32[Array, "n"]
    gradient: Float32[Array, "n 3"]
    smooth: Bool[Array, "n"]
    hidden: Bool[Array, "n"]
    weight: Float32[Array, "n"]
    """How much the distance error of the point counts (Keepout's loss)."""


def keepout_terms(
    layers: mlp.Layers, profile: Profile, scale: float, batch: Batch
) -> tuple[Float32[Array, "n"], Float32[Array, "n"]]:
    """For each point: the weighted pinball of the distance error, and the squared gradient error.

    Where the point is hidden, only over-statement counts.
    """
    y, gradient = second_sweep.value_and_gradient(layers, profile.beta, batch.x)
    e = y * jnp.float32(scale) - batch.distance
    over, under = jnp.maximum(e, 0.0), jnp.where(batch.hidden, 0.0, jnp.maximum(-e, 0.0))
    tau = jnp.float32(profile.over_weight)
    value_term = batch.weight * (tau * over + (1 - tau) * under)
    difference = jnp.sum((gradient - batch.gradient) ** 2, axis=-1)
    slope_term = jnp.float32(profile.gradient_weight) * batch.smooth * difference / (1 + jnp.abs(batch.distance))
    return value_term, slope_term


def paper_terms(
    layers: mlp.Layers, profile: Profile, scale: float, batch: Batch
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
    layers: mlp.Layers, profile: Profile, scale: float, batch: Batch
) -> tuple[Float32[Array, "n"], Float32[Array, "n"]]:
    """Return the two terms of the profile's loss at each point."""
    chosen = keepout_terms if profile.loss == "keepout" else paper_terms
    return chosen(layers, profile, scale, batch)
