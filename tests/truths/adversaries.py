"""Flights of a double integrator whose noise and disturbance do what hurts an estimate most, in batches."""

import equinox as eqx
import jax
import jax.numpy as jnp

from keepout.core.motion import rotation
from keepout.core.motion.relative import MotionState
from keepout.flights.navigation.sensor_errors import ErrorPart

PIECES = 4
"""Pieces of a period over which the disturbance is constant."""
NOISES = 4
"""Kinds of adversarial noise: on the sphere at random, always the same way, to and fro, none."""
PUSHES = 5
"""Kinds of disturbance: away from what is known, with the velocity's error, at random, constant, none."""


class Adversary(ErrorPart):
    """Noise on the surface of its ball, of one of the kinds of `NOISES`."""

    radius: jax.Array
    kind: jax.Array

    def normals(self, dimension):
        return dimension

    def initial_state(self, normals, dimension):
        return normals / jnp.linalg.norm(normals)

    def draw(self, state, normals, dimension):
        fresh = normals / jnp.linalg.norm(normals)
        error = jnp.stack([fresh, state, state, jnp.zeros(dimension)])[self.kind]
        # 1 - 1e-15: a unit vector times a radius can be a unit in the last place longer than the radius.
        return jnp.where(self.kind == 2, -state, state), self.radius * (1.0 - 1e-15) * error

    def variance(self, dimension):
        return self.radius**2 / dimension

    def bound(self):
        return self.radius


def motion_state(position, velocity, attitude=None):
    attitude = rotation.identity() if attitude is None else attitude
    return MotionState(jnp.zeros(()), position, velocity, attitude, jnp.zeros(3))


def fly(estimate, disturbance, key, kind, start, errors, steps):
    """Fly one flight against an adversary that pushes with up to `disturbance` (m/s²).

    Returns a row a step: off (2,), how far the truth is from the centre; the radii (2,); the radii before the samples
    were taken in (2,); contradicted; the truth (6,); what came (sensors,).
    """
    keys = jax.random.split(key, 6)
    attitude = rotation.normalise(jax.random.normal(keys[0], (4,)))
    truth = motion_state(start[:3], start[3:], attitude)
    off = jax.random.normal(keys[1], (2, 3))
    off = off / jnp.linalg.norm(off, axis=-1, keepdims=True) * errors[:, None] * (1.0 - 1e-15)
    told = motion_state(start[:3] + off[0], start[3:] + off[1], attitude)
    lines = estimate.suite.initial_state(keys[2], truth)
    steady = jax.random.normal(keys[3], (3,))
    D, T = disturbance, estimate.period

    def step(carry, _):
        truth, lines, known, key = carry
        key, a, b = jax.random.split(key, 3)
        lines, samples = estimate.suite.sample(lines, truth)
        before = jnp.stack([known.position.radius, known.velocity.radius])
        known, found = estimate.correct(known, samples, motion_state(jnp.zeros(3), jnp.zeros(3), attitude))
        wrong = truth.position - found.state.position, truth.velocity - found.state.velocity
        row = (
            jnp.stack([jnp.linalg.norm(wrong[0]), jnp.linalg.norm(wrong[1])]),
            found.errors,
            before,
            found.contradicted,
            jnp.concatenate([truth.position, truth.velocity]),
            jnp.stack([sample.came for sample in samples]),
        )
        force = estimate.mass * 5e-3 * jax.random.uniform(a, (3,), minval=-1.0, maxval=1.0)
        drawn = jax.random.normal(b, (PIECES, 3))
        outward = jnp.stack([wrong[0], wrong[1]])[:, None] + jnp.zeros((2, PIECES, 3)) + 1e-12 * drawn
        all_ways = jnp.stack([*outward, drawn, steady + jnp.zeros((PIECES, 3)), jnp.ones((PIECES, 3))])
        w = all_ways[kind[1]]
        w = jnp.where(kind[1] == PUSHES - 1, 0.0, D) * w / jnp.linalg.norm(w, axis=-1, keepdims=True)
        r, v, h = truth.position, truth.velocity, T / PIECES
        for piece in w:
            total = force / estimate.mass + piece
            r, v = r + h * v + 0.5 * h**2 * total, v + h * total
        return (motion_state(r, v, attitude), lines, estimate.advance(known, force), key), row

    return jax.lax.scan(step, (truth, lines, estimate.initial_state(told, errors), keys[4]), length=steps)[1]


def against(tree, kind):
    """The same with noise of another kind in every adversary."""

    def told(part):
        return Adversary(part.radius, kind) if isinstance(part, Adversary) else part

    return jax.tree.map(told, tree, is_leaf=lambda part: isinstance(part, Adversary))


@eqx.filter_jit
def fly_many(estimate, disturbance, keys, kinds, starts, errors, steps):
    """Fly flights in a batch, each against the kind of noise that its first entry of `kinds` says."""

    def one(key, kind, start):
        return fly(against(estimate, kind[0]), disturbance, key, kind, start, errors, steps)

    return jax.vmap(one)(keys, kinds, starts)
