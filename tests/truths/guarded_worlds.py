"""Closed-form worlds for the guard's tests, and flights of a chaser in them against whatever is drawn.

All that differs between flights is numbers: worlds, guards, laws, disturbances and errors of the estimate. So guards of
one delay, with or without an observer, share one compiled program for all of them.
"""

import dataclasses
import itertools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from keepout.core.fields.field import Field
from keepout.core.guard.braking import GuardAssumptions
from keepout.core.guard.guard import Guard
from keepout.core.motion.arrays import numbers_as_arrays
from keepout.core.motion.relative import MotionState

PIECES = 8
"""A disturbance is constant over this fraction of a control step."""
FLIGHTS, STEPS = 60, 10
"""Flown at once, and before the program is called again."""
THRESHOLD = 0.5
CAPS = 0.03, 1.5e-3
"""Largest errors of an estimate, m and m/s."""
NOISY = {"position_error": CAPS[0], "velocity_error": CAPS[1]}

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
    """Exact distance to a union of boxes with a crust of `radius`; its gradient jumps, which a guard must stand."""

    lower: jax.Array
    upper: jax.Array
    radius: jax.Array

    def value(self, points):
        away = jnp.maximum(self.lower - points[..., None, :], points[..., None, :] - self.upper)
        outside = jnp.maximum(away, 0.0)
        norm = jnp.sqrt(jnp.sum(outside**2, axis=-1) + 1e-300)
        return jnp.min(norm + jnp.minimum(jnp.max(away, axis=-1), 0.0), axis=-1) - self.radius

    def value_and_gradient(self, points):
        assert points.ndim == 1
        return jax.value_and_grad(self.value)(points)

    def value_gradient_hessian(self, points):
        raise NotImplementedError


def boxes(*corners, radius=0.0):
    lower, upper = np.array(corners, float).transpose(1, 0, 2)
    return Boxes(jnp.asarray(lower), jnp.asarray(upper), jnp.asarray(radius))


# As many boxes in each, so that they share their programs.
WORLDS = {
    "ball": boxes(*3 * [[(0, 0, 0), (0, 0, 0)]], radius=2.0),
    "union": boxes([(-3, -1, -1), (3, 1, 1)], [(-0.2, -6, -0.2), (0.2, 6, 0.2)], [(2, 0, 0), (2.5, 0.5, 4)]),
    # Two plates 1.6 m apart: with a threshold of 0.5 m a corridor of 0.6 m is left.
    "slot": boxes([(-4, -4, 0.8), (4, 4, 1.0)], *2 * [[(-4, -4, -1.0), (4, 4, -0.8)]]),
}


def guard_in(world, **changes):
    return Guard(WORLDS[world], THRESHOLD, 1.0, dataclasses.replace(ASSUMED, **changes))


def motion_state(position, velocity):
    turned = jnp.array([1.0, 0.0, 0.0, 0.0])
    return MotionState(jnp.zeros(()), jnp.asarray(position), jnp.asarray(velocity), turned, jnp.zeros(3))


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


def units(rng, *shape):
    v = rng.normal(size=(*shape, 3))
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


class Flights(NamedTuple):
    """What n flights begin with, are told, commanded and pushed by, step by step.

    An estimate is off by `off` (n, steps, 2, 3) and by `lean` (n, steps, 2) along the field's gradient, m and m/s, and
    the bounds `errors` (n, steps, 2) are told of that. The command is `force` (n, steps, 3), N, and `pull` (n, steps)
    towards the body on each axis, N, and a feedback's to a speed `chase` (n, steps) towards the body, m/s, unless that
    is nan. `swing` (n, steps, PIECES) is how much of the largest disturbance pushes towards the body, and `push`
    (n, steps, PIECES, 3) the rest of it; `gain` (n, steps, 3) is what the thrusters make of a command.
    """

    position: np.ndarray
    velocity: np.ndarray
    off: np.ndarray
    lean: np.ndarray
    errors: np.ndarray
    force: np.ndarray
    pull: np.ndarray
    chase: np.ndarray
    swing: np.ndarray
    push: np.ndarray
    gain: np.ndarray


class Flown(NamedTuple):
    """Of each flight and step: the plan after it, the true state after it, what was told, and the guard's own estimate.

    lowest: the least field value on the step's true path.
    """

    plan_position: np.ndarray
    plan_velocity: np.ndarray
    certified: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    lowest: np.ndarray
    status: np.ndarray
    force: np.ndarray
    told: tuple[np.ndarray, np.ndarray]
    own: tuple[np.ndarray, np.ndarray]


def calm(position, velocity, steps, errors=(0.0, 0.0)):
    """Flights without commands or disturbances, of exact estimates."""
    position, velocity = np.atleast_2d(position).astype(float), np.atleast_2d(velocity).astype(float)
    shape = len(position), steps
    return Flights(
        position,
        np.broadcast_to(velocity, position.shape),
        off=np.zeros((*shape, 2, 3)),
        lean=np.zeros((*shape, 2)),
        errors=np.broadcast_to(errors, (*shape, 2)),
        force=np.zeros((*shape, 3)),
        pull=np.zeros(shape),
        chase=np.full(shape, np.nan),
        swing=np.zeros((*shape, PIECES)),
        push=np.zeros((*shape, PIECES, 3)),
        gain=np.ones((*shape, 3)),
    )


PUSHES = "constant", "bang-bang", "resonant", "random"
INTENTS = "into the body", "anything", "fast"


def hostile(seed, count, steps, pushes=PUSHES, intents=INTENTS):
    """Flights from random states, each with one of the laws and one of the worst disturbances, all pairs in turn."""
    rng, k = np.random.default_rng(seed), np.arange(steps)
    kind, intent = (np.array(column) for column in zip(*itertools.product(pushes, intents), strict=True))
    kind, intent = np.resize(kind, count)[:, None], np.resize(intent, count)[:, None]
    speed = 0.14 * rng.uniform(size=(count, 1)) ** 0.5
    flights = calm(rng.uniform(-7.0, 7.0, (count, 3)), speed * units(rng, count), steps)
    # Against the direction for a while, then along it: the kernel's sign change, and then some.
    slow = np.where(k // 7 % 2 == 0, 1.0, -1.0)[:, None]
    fast = np.where((np.arange(PIECES) * 2) // PIECES == k[:, None] % 2, 1.0, -1.0)
    along = np.where(kind[..., None] == "bang-bang", slow, np.where(kind[..., None] == "resonant", fast, 1.0))
    toward = (rng.uniform(size=(count, steps)) < 0.8)[..., None]
    aside = (along * ~toward)[..., None] * units(rng, count, steps)[:, :, None]
    drawn = kind == "random"
    return flights._replace(
        swing=np.where(drawn[..., None], 0.0, along * toward),
        push=np.where(drawn[..., None, None], units(rng, count, steps, PIECES), aside),
        pull=np.where(intent == "into the body", 0.1, np.zeros(steps)),
        force=np.where((intent == "anything")[..., None], rng.uniform(-0.15, 0.15, (count, steps, 3)), 0.0),
        chase=np.where(intent == "fast", np.where(k % 60 < 40, 0.11, -0.11), np.nan),
    )


NOISES = "random", "constant", "flipping", "inward"


def deceived(seed, count, steps, *, caps=CAPS, noises=NOISES, varying=True, spells=0.0):
    """Flights with one of the kinds of noise in turn, each estimate within the errors told of it, up to `caps`.

    Noise of kind "inward" lies along the line to the body, one way for a while, then the other; so does the disturbance
    of all. In a share `spells` of all spells of 40 steps the errors, and the noise, are up to three times the caps.
    """
    rng, k = np.random.default_rng(seed), np.arange(steps)
    kind = np.resize(noises, count)[:, None]
    share = rng.uniform(size=(count, steps, 2)) if varying else np.ones((count, steps, 2))
    wide = np.repeat(rng.uniform(size=(count, steps // 40 + 1)) < spells, 40, axis=1)[:, :steps]
    errors = np.where(wide[..., None], 3.0 * (1.0 + share) / 2.0, share) * np.asarray(caps)
    errors[:, 0] = caps
    turns, flips = rng.integers(10, 80, (count, 1)), rng.integers(2, 60, (count, 1))
    sign = np.where(k // turns % 2 == 0, 1.0, -1.0)
    flip = np.where((kind == "flipping") & (k // flips % 2 == 1), -1.0, 1.0)[..., None, None]
    steady = units(rng, count, 2)[:, None] * flip
    drawn = units(rng, count, steps, 2) * rng.uniform(size=(count, steps, 2, 1))
    off = np.where((kind == "random")[..., None, None], drawn, steady) * (1 - 1e-9) * errors[..., None]
    inward = (kind == "inward")[..., None]
    pulled = k % (2 * turns) < turns
    speed = 0.1 * rng.uniform(size=(count, 1))
    return calm(rng.uniform(-6.0, 6.0, (count, 3)), speed * units(rng, count), steps)._replace(
        errors=errors,
        off=np.where(inward[..., None], 0.0, off),
        lean=np.where(inward, (1 - 1e-9) * errors * sign[..., None], 0.0),
        pull=np.where(pulled, 0.1, 0.0),
        force=np.where(pulled[..., None], 0.0, 0.1 * units(rng, count, steps)),
        swing=np.broadcast_to(sign[..., None], (count, steps, PIECES)),
    )


def fly(guard, flights, size=None, first=None):
    """Fly against disturbances of `size` m/s² (what the guard assumes, if left out).

    The first plan is made for an estimate that is off by `first` (n, 2, 3), m and m/s; left out, for the first told.

    Returns whether each start was certified from its first estimate, and `Flown`.
    """
    size = guard.assumptions.disturbance * (1 - 1e-9) if size is None else size
    guard, size = numbers_as_arrays(guard), jnp.asarray(float(size))
    count, steps = flights.force.shape[:2]
    assert steps % STEPS == 0
    first = flights.off[:, 0] if first is None else first
    certified, flown = [], []
    for start in range(0, count, FLIGHTS):
        places = np.arange(start, start + FLIGHTS) % count
        position, velocity, *rows = (np.asarray(array)[places] for array in flights)
        carry, sure = _begin(guard, position, velocity, first[places], rows[1][:, 0])
        parts = []
        for begun in range(0, steps, STEPS):
            carry, part = _fly_on(guard, carry, [row[:, begun : begun + STEPS] for row in rows], size)
            parts.append(jax.device_get(part))
        certified.append(np.asarray(sure))
        flown.append(jax.tree.map(lambda *some: np.concatenate(some, axis=1), *parts))
    whole = jax.tree.map(lambda *some: np.concatenate(some)[:count], *flown)
    return np.concatenate(certified)[:count], whole


def _told(guard, r, v, off, lean):
    """Give the direction to the body, and the estimate."""
    toward = -guard.field.value_and_gradient(r)[1]
    return toward, motion_state(r + off[0] - lean[0] * toward, v + off[1] - lean[1] * toward)


@eqx.filter_jit
def _begin(guard, positions, velocities, off, lean):
    def one(r, v, off, lean):
        memory = guard.initial_state(_told(guard, r, v, off, lean)[1])
        return (r, v, memory, jnp.zeros((guard.assumptions.delay, 3))), memory.certified

    return jax.vmap(one)(positions, velocities, off, lean)


@eqx.filter_jit
def _fly_on(guard, carry, rows, size):
    def step(carry, row):
        r, v, memory, queue = carry
        off, lean, errors, force, pull, chase, swing, push, gain = row
        toward, estimate = _told(guard, r, v, off, lean)
        chased = jnp.where(jnp.isnan(chase), 0.0, 2.0 * (chase * toward - v))
        own = memory if memory.observed is None else memory.observed
        own = own.expected_position, own.expected_velocity
        memory, out, status = guard.filter(
            memory, estimate, force + pull * jnp.sign(toward) + chased, jnp.zeros(3), errors
        )
        queue = jnp.concatenate([queue, out[None]])
        push = size * (swing[:, None] * toward + push)
        r, v, path = advance(r, v, gain * queue[0] / guard.assumptions.mass, push)
        told = estimate.position, estimate.velocity
        plan = memory.plan_position, memory.plan_velocity, memory.certified
        row = Flown(*plan, r, v, jnp.min(guard.field.value(path)), status, out, told, own)
        return (r, v, memory, queue[1:]), row

    return jax.vmap(lambda carry, rows: jax.lax.scan(step, carry, rows))(carry, tuple(rows))


def filtered(guard, memory, estimate, force, disturbance=(0.0, 0.0, 0.0), contradicted=False):
    """One step of a guard."""
    # Of one type each, so that one program serves all.
    return _filtered(guard, *jax.tree.map(np.asarray, (memory, estimate, force, np.array(disturbance), contradicted)))


@eqx.filter_jit
def _filtered(guard, memory, estimate, force, disturbance, contradicted):
    return guard.filter(memory, estimate, force, disturbance, None, contradicted)


begun = eqx.filter_jit(lambda guard, estimate: guard.initial_state(estimate))
