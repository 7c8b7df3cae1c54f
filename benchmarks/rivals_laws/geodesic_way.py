"""Keepout's geodesic as points: a first guess for planners."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from keepout.core.control.geodesic import GeodesicGuidance
from rivals_laws.rival_case import Point, RivalCase


@eqx.filter_jit
def _steps_along(
    guidance: GeodesicGuidance, start: Float[Array, "3"], step: float, count: int
) -> Float[Array, "count 3"]:
    def advance(position, _):
        heading = guidance.desired_velocity(position)
        moved = position + step * heading / (jnp.sqrt(jnp.sum(heading**2)) + 1e-12)
        return moved, moved

    return jax.lax.scan(advance, start, length=count)[1]


def geodesic_way(case: RivalCase, start: Point, goal: Point) -> np.ndarray:
    """Give Keepout's geodesic from start to goal as points, m."""
    way = np.asarray(_steps_along(case.geodesic(start, goal), jnp.asarray(start), 0.1, 3000))
    near = np.linalg.norm(way - goal, axis=1)
    return np.vstack([start, way[: int(np.argmin(near)) + 1], goal])
