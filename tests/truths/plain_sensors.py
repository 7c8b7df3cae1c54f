"""Sensors with nothing but what an estimator asks of them: tests make their samples themselves."""

import equinox as eqx
import jax.numpy as jnp

from keepout.core.flight.navigation import Sensor


class Told(Sensor):
    """Answers what an estimator asks; it never samples by itself."""

    noise: object
    every: int = eqx.field(static=True, default=1)
    latency: int = eqx.field(static=True, default=0)
    most_missed: int = eqx.field(static=True, default=0)

    def initial_state(self, key, truth):
        raise NotImplementedError

    def sample(self, state, truth):
        raise NotImplementedError

    def covariance(self, value):
        return jnp.asarray(self.noise) * jnp.eye(value.shape[0])

    def position_ball(self, value, estimate):
        return None

    def velocity_ball(self, value, estimate):
        return None


class Place(Told):
    """Relative position, m; `noise` is the variance an axis."""

    def ideal(self, state):
        return state.position


class Pace(Told):
    """Relative velocity, m/s."""

    def ideal(self, state):
        return state.velocity


class Height(Told):
    """One component of the position, m."""

    def ideal(self, state):
        return state.position[2:]


class Sight(Told):
    """Range (m) and two bearings (rad)."""

    def ideal(self, state):
        x, y, z = state.position
        distance = jnp.sqrt(x * x + y * y + z * z)
        return jnp.stack([distance, jnp.arctan2(y, x), jnp.arcsin(z / distance)])

    def covariance(self, value):
        correlated = jnp.array([[1e-2, 1e-5, 0.0], [1e-5, 1e-6, 0.0], [0.0, 0.0, 1e-6]])
        return self.noise * correlated


class Turned(Told):
    """The target's attitude as a quaternion."""

    def ideal(self, state):
        return state.attitude
