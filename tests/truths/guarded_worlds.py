"""Closed-form worlds for the guard's tests, and an exact integration of a chaser in them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from keepout.fields.field import Field
from keepout.guard.braking import GuardAssumptions
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
    # The second is there twice, so that the slot is of as many boxes as the union and shares its programs.
    "slot": boxes([(-4, -4, 0.8), (4, 4, 1.0)], *2 * [[(-4, -4, -1.0), (4, 4, -0.8)]]),
}


def motion_state(position, velocity):
    return MotionState(jnp.zeros(()), position, velocity, jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.zeros(3))


def of_any_numbers(guard):
    """The guard with arrays for its numbers, as campaigns fly it: guards that differ in numbers share a program."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf) if isinstance(leaf, float) else leaf, guard)


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


def disturbance(kind, size, random, direction, step):
    """Admissible accelerations (PIECES, 3), m/s², all of norm `size`; `kind` is an index into KINDS."""
    # Against the direction for a while, then along it: the kernel's sign change, and then some.
    slow = jnp.where(jnp.floor_divide(step, 7) % 2 == 0, 1.0, -1.0)
    fast = jnp.where((jnp.arange(PIECES) * 2) // PIECES == step % 2, 1.0, -1.0)
    along = jnp.stack([jnp.ones(PIECES), jnp.full(PIECES, slow), fast])[jnp.minimum(kind, 2)]
    return size * jnp.where(kind == 3, random, along[:, None] * direction)


def directions(generator, *shape):
    v = generator.normal(size=(*shape, 3))
    return jnp.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))


def fly_batch(guard, seed, flights, *, steps, size, kind, intent, errors=(0.0, 0.0), gain=0.0):
    """Fly guarded chasers from random states; every command is `intent`'s, every disturbance worst-case.

    Returns whether the start was certified (flights,), and for each step the guard's memory, true position and velocity
    after it, the least field value on the true path, the status, and the force commanded.
    """
    generator = np.random.default_rng(seed)
    speed = 0.14 * generator.uniform(size=(flights, 1)) ** 0.5
    starts = (
        jnp.asarray(generator.uniform(-7.0, 7.0, (flights, 3))),
        jnp.asarray(speed) * directions(generator, flights),
        errors[0] * directions(generator, flights, steps + 1),
        errors[1] * directions(generator, flights, steps + 1),
    )
    draws = (
        jnp.asarray(generator.uniform(size=(flights, steps)) < 0.8),
        directions(generator, flights, steps),
        jnp.asarray(generator.uniform(-0.15, 0.15, (flights, steps, 3))),
        directions(generator, flights, steps, PIECES),
        1.0 + gain * jnp.asarray(generator.choice([-1.0, 1.0], (flights, steps, 3))),
    )
    numbers = (jnp.asarray(size), jnp.asarray(KINDS.index(kind)), jnp.asarray(INTENTS.index(intent)))
    return _fly_batch(of_any_numbers(guard), starts, draws, *numbers)


@eqx.filter_jit
def _fly_batch(guard, starts, draws, size, kind, intent):
    mass, delay = guard.assumptions.mass, guard.assumptions.delay

    def one(start, draw):
        position, velocity, position_errors, velocity_errors = start
        first = motion_state(position + position_errors[0], velocity + velocity_errors[0])
        memory = guard.initial_state(first)

        def step(carry, row):
            k, (toward_body, random_way, random_force, random_push, scale), position_error, velocity_error = row
            r, v, memory, queue, told = carry
            toward = -guard.field.value_and_gradient(r)[1]
            commands = jnp.stack(
                [0.1 * jnp.sign(toward), random_force, 2.0 * (0.11 * jnp.where(k % 60 < 40, toward, -toward) - v)]
            )
            memory, out, status = guard.filter(memory, motion_state(*told), commands[intent], jnp.zeros(3))
            queue = jnp.concatenate([queue, out[None]])
            wind = jnp.where(toward_body, toward, random_way)
            push = disturbance(kind, size, random_push, wind, k)
            r, v, path = advance(r, v, scale * queue[0] / mass, push)
            row = (memory, r, v, jnp.min(guard.field.value(path)), status, out)
            return (r, v, memory, queue[1:], (r + position_error, v + velocity_error)), row

        initial = (position, velocity, memory, jnp.zeros((delay, 3)), (first.position, first.velocity))
        rows = (jnp.arange(len(draw[0])), draw, position_errors[1:], velocity_errors[1:])
        return memory.certified, jax.lax.scan(step, initial, rows)[1]

    return jax.vmap(one)(starts, draws)


def fly_too_fast(guard, seed, flights, *, steps=60):
    """Fly chasers around the ball that begin near or above the speed limit, a constant push of norm D on each.

    Returns, for each flight and step, whether the guard has a certified plan after it, its status, and the true speed
    at the step's start.
    """
    a, generator = guard.assumptions, np.random.default_rng(seed)
    speed = jnp.asarray(generator.uniform(0.9, 1.3, (flights, 1)) * a.speed_limit)
    away = jnp.asarray(generator.uniform(6.0, 9.0, (flights, 1)))
    starts = away * directions(generator, flights), speed * directions(generator, flights)
    pushes = a.disturbance * directions(generator, flights)
    return tuple(map(np.asarray, _fly_too_fast(of_any_numbers(guard), *starts, pushes, steps)))


@eqx.filter_jit
def _fly_too_fast(guard, positions, velocities, pushes, steps):
    def one(position, velocity, push):
        def step(carry, _):
            r, v, memory, queue = carry
            before = jnp.linalg.norm(v)
            memory, force, status = guard.filter(memory, motion_state(r, v), jnp.zeros(3), jnp.zeros(3))
            queue = jnp.concatenate([queue, force[None]])
            r, v, _ = advance(r, v, queue[0] / guard.assumptions.mass, jnp.broadcast_to(push, (PIECES, 3)))
            return (r, v, memory, queue[1:]), (memory.certified, status, before)

        first = guard.initial_state(motion_state(position, velocity))
        queue = jnp.zeros((guard.assumptions.delay, 3))
        return jax.lax.scan(step, (position, velocity, first, queue), length=steps)[1]

    return jax.vmap(one)(positions, velocities, pushes)
