"""Closed-form worlds for the guard's tests, and an exact integration of a chaser in them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from keepout.control.braking import GuardAssumptions
from keepout.fields.field import Field
from keepout.motion.relative import MotionState

PIECES = 8
"""A disturbance is constant over this fraction of a control step."""

ASSUMED = GuardAssumptions(
    mass=20.0,
    force_limit=0.1,
    period=1.0,
    disturbance_force=0.0142,
    angular_rate=1.1e-3,
    angular_acceleration=0.0,
    gravity_gradient=3e-6,
    range_limit=40.0,
    speed_limit=0.15,
)


class Boxes(Field):
    """Exact distance to a union of boxes; its gradient jumps, which a guard must stand."""

    lower: jax.Array
    upper: jax.Array

    def value(self, points):
        away = jnp.maximum(self.lower - points[..., None, :], points[..., None, :] - self.upper)
        outside = jnp.maximum(away, 0.0)
        norm = jnp.sqrt(jnp.sum(outside**2, axis=-1) + 1e-300)
        return jnp.min(norm + jnp.minimum(jnp.max(away, axis=-1), 0.0), axis=-1)

    def value_and_gradient(self, points):
        assert points.ndim == 1
        return jax.value_and_grad(self.value)(points)

    def value_gradient_hessian(self, points):
        raise NotImplementedError


class Ball(Field):
    """Distance to a ball of 2 m."""

    def value(self, points):
        return jnp.sqrt(jnp.sum(points**2, axis=-1)) - 2.0

    def value_and_gradient(self, points):
        return jax.value_and_grad(self.value)(points)

    def value_gradient_hessian(self, points):
        raise NotImplementedError


def boxes(*corners):
    lower, upper = np.array(corners, float).transpose(1, 0, 2)
    return Boxes(jnp.asarray(lower), jnp.asarray(upper))


WORLDS = {
    "ball": Ball(),
    "union": boxes([(-3, -1, -1), (3, 1, 1)], [(-0.2, -6, -0.2), (0.2, 6, 0.2)], [(2, 0, 0), (2.5, 0.5, 4)]),
    # Two plates 1.6 m apart: with a threshold of 0.5 m a corridor of 0.6 m is left.
    "slot": boxes([(-4, -4, 0.8), (4, 4, 1.0)], [(-4, -4, -1.0), (4, 4, -0.8)]),
}


def motion_state(position, velocity):
    return MotionState(jnp.zeros(()), position, velocity, jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.zeros(3))


def advance(position, velocity, acceleration, disturbance):
    """A control step under a held acceleration and a disturbance (PIECES, 3), exactly; also the path at the joints."""
    h = 1.0 / PIECES

    def piece(state, w):
        r, v = state
        r = r + h * v + 0.5 * h**2 * (acceleration + w)
        v = v + h * (acceleration + w)
        return (r, v), r

    (r, v), path = jax.lax.scan(piece, (position, velocity), disturbance)
    return r, v, path


KINDS = ("constant", "bang-bang", "resonant", "random")
INTENTS = ("into the body", "anything", "fast")


def disturbance(kind, size, key, direction, step):
    """Admissible accelerations (PIECES, 3), m/s², all of norm `size`; `kind` is an index into KINDS."""
    # Against the direction for a while, then along it: the kernel's sign change, and then some.
    slow = jnp.where(jnp.floor_divide(step, 7) % 2 == 0, 1.0, -1.0)
    fast = jnp.where((jnp.arange(PIECES) * 2) // PIECES == step % 2, 1.0, -1.0)
    w = jax.random.normal(key, (PIECES, 3))
    along = jnp.stack([jnp.ones(PIECES), jnp.full(PIECES, slow), fast])[jnp.minimum(kind, 2)]
    return size * jnp.where(kind == 3, w / jnp.linalg.norm(w, axis=-1, keepdims=True), along[:, None] * direction)


def unit(key):
    v = jax.random.normal(key, (3,))
    return v / jnp.linalg.norm(v)


def fly_batch(guard, keys, *, steps, size, kind, intent, errors=(0.0, 0.0), gain=0.0):
    """Fly guarded chasers from random states; every command is `intent`'s, every disturbance worst-case.

    Returns whether the start was certified (flights,), and for each step the guard's memory, true position and velocity
    after it, the least field value on the true path, the status, and the force commanded.
    """
    numbers = (jnp.asarray(size), jnp.asarray(KINDS.index(kind)), jnp.asarray(INTENTS.index(intent)))
    return _fly_batch(guard, keys, steps, *numbers, jnp.asarray(errors), jnp.asarray(gain))


@eqx.filter_jit
def _fly_batch(guard, keys, steps, size, kind, intent, errors, gain):
    mass, delay = guard.assumptions.mass, guard.assumptions.delay

    def estimate_of(r, v, key):
        a, b = jax.random.split(key)
        return motion_state(r + errors[0] * unit(a), v + errors[1] * unit(b))

    def one(key):
        a, b, c, d, key = jax.random.split(key, 5)
        position = 7.0 * jax.random.uniform(a, (3,), minval=-1.0, maxval=1.0)
        velocity = 0.14 * jax.random.uniform(b) ** 0.5 * unit(c)
        first = estimate_of(position, velocity, d)
        start = guard.initial_state(first)

        def step(carry, k):
            r, v, memory, queue, estimate, key = carry
            a, b, c, d, e, key = jax.random.split(key, 6)
            toward = -guard.field.value_and_gradient(r)[1]
            wind = jnp.where(jax.random.uniform(a) < 0.8, toward, unit(b))
            commands = jnp.stack(
                [
                    0.1 * jnp.sign(toward),
                    0.15 * jax.random.uniform(c, (3,), minval=-1.0, maxval=1.0),
                    2.0 * (0.11 * jnp.where(k % 60 < 40, toward, -toward) - v),
                ]
            )
            memory, out, status = guard.filter(memory, estimate, commands[intent], jnp.zeros(3))
            queue = jnp.concatenate([queue, out[None]])
            scale = 1.0 + gain * jnp.sign(jax.random.normal(b, (3,)))
            r, v, path = advance(r, v, scale * queue[0] / mass, disturbance(kind, size, d, wind, k))
            row = (memory, r, v, jnp.min(guard.field.value(path)), status, out)
            return (r, v, memory, queue[1:], estimate_of(r, v, e), key), row

        initial = (position, velocity, start, jnp.zeros((delay, 3)), first, key)
        return start.certified, jax.lax.scan(step, initial, jnp.arange(steps))[1]

    return jax.vmap(one)(keys)
