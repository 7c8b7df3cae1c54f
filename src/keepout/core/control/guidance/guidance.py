"""Guidance: the desired velocity v_c before safety, as a function of position."""

import abc
import functools
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int8, Int32

from keepout.core.compiled.joined_rows import joined_rows, rows_last

_EDGE = 32
"""Nodes; the edges of a grid's array are multiples of it."""


class Guidance(eqx.Module):
    """A desired velocity for each position; `goal` (3,) m is where it leads."""

    goal: eqx.AbstractVar[Float[Array, "3"]]

    @abc.abstractmethod
    def desired_velocity(self, position: Float[Array, "3"]) -> Float[Array, "3"]:
        """Return v_c in m/s at a position in m, both in the body frame."""


class ComponentwiseGuidance(Guidance):
    """The paper's v_c = −v_max tanh(r_e / k_p), component by component; up to √3 v_max in norm.

    `speed` v_max in m/s, `slowing_length` k_p in m.
    """

    goal: Float[Array, "3"]
    speed: Float[Array, ""]
    slowing_length: Float[Array, ""]

    def desired_velocity(self, position: Float[Array, "3"]) -> Float[Array, "3"]:
        """Return −v_max tanh(r_e / k_p)."""
        return -self.speed * jnp.tanh((position - self.goal) / self.slowing_length)


def _towards(goal: Float[Array, "3"], position: Float[Array, "3"], length: Float[Array, ""]) -> tuple[Array, Array]:
    """Return tanh(‖r_e‖/k_p) times the direction to the goal (smooth at the goal), and ‖r_e‖."""
    error = goal - position
    square = jnp.sum(error * error)
    away = square > 1e-24
    distance = jnp.sqrt(jnp.where(away, square, 1.0))
    factor = jnp.where(away, jnp.tanh(distance / length) / distance, 1.0 / length)
    return factor * error, jnp.where(away, distance, 0.0)


class StraightGuidance(Guidance):
    """Straight to the goal with speed v_max tanh(‖r_e‖ / k_p); never above v_max in norm."""

    goal: Float[Array, "3"]
    speed: Float[Array, ""]
    slowing_length: Float[Array, ""]

    def desired_velocity(self, position: Float[Array, "3"]) -> Float[Array, "3"]:
        """Return v_max tanh(‖r_e‖/k_p) times the direction to the goal."""
        return self.speed * _towards(self.goal, position, self.slowing_length)[0]


class GeodesicGuidance(Guidance):
    """Along the shortest free way to the goal, blended into the straight line near it (docs/control.md).

    `directions` holds at each node of a regular grid with corner `origin` (m) and `spacing` (m) the direction in which
    the travel time falls, in 127ths, its three components packed into one number (`packed`). The grid has `nodes` of
    them along each axis, and the array may have more: those mean nothing, and let grids of several sizes share a
    compiled program. The directions are blended by cubic B-splines, so that v_c is twice continuously differentiable.
    Directions and not times are blended, because times on two sides of a wall, or in it, may differ by any amount: in
    a gap of one node their spline has a minimum before the gap, and a chaser would wait there.
    Between `inner` and `outer` metres from the goal the direction turns from straight to geodesic. Outside the grid the
    way leads back to it. The speed is v_max tanh(‖r_e‖ / k_p). Build it with
    `keepout.core.control.guidance.geodesic.geodesic_guidance`.
    """

    goal: Float[Array, "3"]
    speed: Float[Array, ""]
    slowing_length: Float[Array, ""]
    directions: Int32[Array, "nx ny nz"]
    nodes: Float[Array, "3"]
    origin: Float[Array, "3"]
    spacing: Float[Array, ""]
    inner: Float[Array, ""]
    outer: Float[Array, ""]

    def desired_velocity(self, position: Float[Array, "3"]) -> Float[Array, "3"]:
        """Return the desired velocity, m/s."""
        straight, distance = _towards(self.goal, position, self.slowing_length)
        geodesic = self.direction(position) * jnp.tanh(distance / self.slowing_length)
        s = jnp.clip((distance - self.inner) / (self.outer - self.inner), 0.0, 1.0)
        weight = s * s * (3.0 - 2.0 * s)
        return self.speed * (weight * geodesic + (1.0 - weight) * straight)

    def direction(self, position: Float[Array, "3"]) -> Float[Array, "3"]:
        """Return the unit vector along the way to the goal, or zero where nothing leads there."""
        last = self.nodes - 2.0
        place = (position - self.origin) / self.spacing
        held = jnp.clip(place, 1.0, last - 1e-9)
        outside = place - held
        cell = jax.lax.stop_gradient(jnp.floor(held))
        start = cell.astype(jnp.int32) - 1
        blended = joined_rows(_blended, self.directions, (start[None], (held - cell)[None]))[0]
        # Where the position is beyond the grid along some axis, that axis leads back and the others keep their say.
        # Within the grid nothing is beyond. A unit vector of nothing is zero, but its derivative is immense, and taken
        # backwards it would swallow the digits of all that is added to it.
        beyond = jnp.any(outside != 0.0)
        back = jnp.where(beyond, _unit(jnp.where(beyond, outside, 1.0)), 0.0)
        along = jnp.where(outside == 0.0, _unit(blended), 0.0) - back
        return _unit(along)


def packed(directions: Int8[np.ndarray, "nx ny nz 3"]) -> Int32[np.ndarray, "mx my mz"]:
    """Put three numbers of a byte into one, x lowest: a third as many look-ups, and a whole number a node.

    Each axis is filled up with zeros to a multiple of `_EDGE` nodes.
    """
    bytes_ = directions.view(np.uint8).astype(np.int32)
    numbers = bytes_[..., 0] | bytes_[..., 1] << 8 | bytes_[..., 2] << 16
    return np.pad(numbers, [(0, -count % _EDGE) for count in numbers.shape])


def _blended(
    directions: Int32[Array, "nx ny nz"], at: tuple[Int32[Array, "n 3"], Float[Array, "n 3"]]
) -> Float[Array, "n 3"]:
    """Blend the 4 × 4 × 4 directions from each node `at[0]` on, at the places `at[1]` in [0, 1) of the middle cell."""
    start, place = at
    blocks = jax.vmap(lambda node: jax.lax.dynamic_slice(directions, node, (4, 4, 4)))(start)
    blocks, weights = rows_last(blocks), [_cubic_weights(place[:, axis]) for axis in range(3)]
    components = []
    for shift in (24, 16, 8):
        # The byte moved to the top and back down brings its sign along.
        components.append(_contracted(((blocks << shift) >> 24).astype(jnp.float64), weights))
    return jnp.stack(components, axis=-1)


def _contracted(blocks: Float[Array, "4 4 4 n"], weights: Sequence[Sequence[Float[Array, "n"]]]) -> Float[Array, "n"]:
    """Sum a block of numbers a row, rows last, with one set of weights an axis.

    The barriers keep XLA from writing all 64 terms into one expression, which takes minutes to compile.
    """
    for weight in weights:
        terms = [w * block for w, block in zip(weight, blocks, strict=True)]
        blocks = jax.lax.optimization_barrier(functools.reduce(jnp.add, terms))
    return blocks


def _unit(vector: Float[Array, "3"]) -> Float[Array, "3"]:
    """Return the vector at length 1, or zero; its derivative is finite everywhere."""
    return vector / jnp.sqrt(jnp.sum(vector * vector) + 1e-300)


def _cubic_weights(t: Float[Array, "n"]) -> tuple[Float[Array, "n"], ...]:
    """Return the four cubic B-spline weights at t in [0, 1)."""
    u = 1.0 - t
    return u**3 / 6.0, (4.0 - 6.0 * t**2 + 3.0 * t**3) / 6.0, (4.0 - 6.0 * u**2 + 3.0 * u**3) / 6.0, t**3 / 6.0
