"""A smooth field of axis-aligned boxes: a lower bound of the signed distance to their union, in closed form."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from keepout.core.fields.own import FunctionField


def box_union(lower, upper, smoothing) -> FunctionField:
    """Give the field of boxes between corners (boxes, 3) m, with the smoothing τ (m); its gradient is at most 1."""
    return FunctionField(_Boxes(jnp.asarray(lower), jnp.asarray(upper), jnp.asarray(smoothing)), 1.0, "stated")


class _Boxes(eqx.Module):
    """A C^∞ lower bound of the signed distance to a union of axis-aligned boxes.

    The exact distance is not C² (edges, corners, medial axis). Each box's distance is the largest of its six face
    distances, which never exceeds the exact one outside, and maxima and minima are replaced by log-sum-exp with
    temperature τ: within a box the soft maximum lowered by τ log 6, over the boxes the soft minimum, which is low by
    at most τ log(number of boxes). So the value never over-states the distance, and is exact to those two terms beside
    a face.
    """

    lower: Float[Array, "boxes 3"]
    upper: Float[Array, "boxes 3"]
    smoothing: Float[Array, ""]

    def __call__(self, point: Float[Array, "3"]) -> Float[Array, ""]:
        tau = self.smoothing
        faces = jnp.concatenate([self.lower - point, point - self.upper], axis=-1)
        boxes = tau * (jax.nn.logsumexp(faces / tau, axis=-1) - jnp.log(6.0))
        return -tau * jax.nn.logsumexp(-boxes / tau)
