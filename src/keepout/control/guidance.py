"""Guidance: the desired velocity v_c before safety, as a function of position."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


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
    """Down the travel time to the goal, blended into the straight line near it (design section 2.6).

    `travel_time` holds the time at the nodes of a regular grid with corner `origin` (m) and `spacing` (m), the speed
    far from everything being 1 m/s; it is read through cubic B-splines (twice continuously differentiable). Between
    `inner` and `outer` metres from the goal the direction turns from straight to geodesic. Outside the grid the way
    leads back to it. The speed is v_max tanh(‖r_e‖ / k_p). Build it with `keepout.control.geodesic.geodesic_guidance`.
    """

    goal: Float[Array, "3"]
    speed: Float[Array, ""]
    slowing_length: Float[Array, ""]
    travel_time: Float[Array, "nx ny nz"]
    origin: Float[Array, "3"]
    spacing: Float[Array, ""]
    inner: Float[Array, ""]
    outer: Float[Array, ""]

    def desired_velocity(self, position: Float[Array, "3"]) -> Float[Array, "3"]:
        """Return the desired velocity, m/s."""
        straight, distance = _towards(self.goal, position, self.slowing_length)
        gradient = self.gradient(position)
        size = jnp.sqrt(jnp.sum(gradient * gradient) + 1e-300)
        geodesic = -gradient / size * jnp.tanh(distance / self.slowing_length)
        s = jnp.clip((distance - self.inner) / (self.outer - self.inner), 0.0, 1.0)
        weight = s * s * (3.0 - 2.0 * s)
        return self.speed * (weight * geodesic + (1.0 - weight) * straight)

    def gradient(self, position: Float[Array, "3"]) -> Float[Array, "3"]:
        """Return the gradient of the travel time, s/m."""
        last = jnp.asarray(self.travel_time.shape) - 2.0
        place = (position - self.origin) / self.spacing
        held = jnp.clip(place, 1.0, last - 1e-9)
        outside = place - held
        cell = jax.lax.stop_gradient(jnp.floor(held))
        t = held - cell
        start = cell.astype(jnp.int32) - 1
        block = jax.lax.dynamic_slice(self.travel_time, (start[0], start[1], start[2]), (4, 4, 4)).astype(t.dtype)
        w, dw = _cubic_weights(t)
        along = jnp.stack(
            [
                _contract(block, dw[:, 0], w[:, 1], w[:, 2]),
                _contract(block, w[:, 0], dw[:, 1], w[:, 2]),
                _contract(block, w[:, 0], w[:, 1], dw[:, 2]),
            ]
        )
        inside = jnp.where(outside == 0.0, along / self.spacing, 0.0)
        size = jnp.sqrt(jnp.sum(jnp.where(outside == 0.0, 0.0, outside) ** 2) + 1e-300)
        return inside + outside / size


def _contract(block: Float[Array, "4 4 4"], x: Array, y: Array, z: Array) -> Array:
    return jnp.sum(block * x[:, None, None] * y[:, None] * z)


def _cubic_weights(t: Float[Array, "3"]) -> tuple[Float[Array, "4 3"], Float[Array, "4 3"]]:
    """Return the four cubic B-spline weights at t in [0, 1), and their derivatives."""
    u = 1.0 - t
    weights = jnp.stack(
        [u**3 / 6.0, (4.0 - 6.0 * t**2 + 3.0 * t**3) / 6.0, (4.0 - 6.0 * u**2 + 3.0 * u**3) / 6.0, t**3 / 6.0]
    )
    slopes = jnp.stack([-(u**2) / 2.0, (3.0 * t**2 - 4.0 * t) / 2.0, (4.0 * u - 3.0 * u**2) / 2.0, t**2 / 2.0])
    return weights, slopes
