"""Where the theorem starts: from every estimate of a true start, and where a way out ends."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from truths.guarded_worlds import ASSUMED, WORLDS, fly_too_fast, motion_state, of_any_numbers

from keepout.guard.guard import Guard
from keepout.guard.status import GuardStatus

pytestmark = pytest.mark.long

ESTIMATES = 16


def guard_for(world, **changes):
    return Guard(WORLDS[world], threshold=0.5, lipschitz=1.0, assumptions=dataclasses.replace(ASSUMED, **changes))


def unit(rng, *shape):
    v = rng.normal(size=(*shape, 3))
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def judged(guard, *states):
    """For each true state: certified from the truth, from every estimate as the guard says, and from each of some."""
    return tuple(map(np.asarray, _judged(of_any_numbers(guard), *map(jnp.asarray, states))))


@eqx.filter_jit
def _judged(guard, position, velocity, off_position, off_velocity):
    def one(r, v):
        return guard.certified(motion_state(r, v)), guard.certified_start(motion_state(r, v))

    told_r = (position[:, None] + off_position).reshape(-1, 3)
    told_v = (velocity[:, None] + off_velocity).reshape(-1, 3)
    told = jax.vmap(lambda r, v: guard.initial_state(motion_state(r, v)).certified)(told_r, told_v)
    return *jax.vmap(one)(position, velocity), told.reshape(off_position.shape[:2])


def draw(guard, seed, count):
    """True states near where certification ends, and admissible estimates: at random, and towards the body."""
    rng, a = np.random.default_rng(seed), guard.assumptions
    r = rng.uniform(-6.0, 6.0, (count, 3))
    # Most are moved to where the field is little above the least value: there the answers part.
    field = jax.jit(jax.vmap(guard.field.value_and_gradient))
    for _ in range(6):
        value, gradient = field(jnp.asarray(r))
        level = guard.least_value + rng.exponential(0.15, count)
        r = r + np.where(rng.random(count) < 0.8, level - np.asarray(value), 0.0)[:, None] * np.asarray(gradient)
    v = 0.15 * rng.random((count, 1)) * unit(rng, count)
    inward = -np.asarray(field(jnp.asarray(r))[1])[:, None]
    size = np.where(np.arange(ESTIMATES) < 12, 1.0, rng.random(ESTIMATES))[:, None]
    lean = np.where(np.arange(ESTIMATES) % 2, 8.0, 0.0)[:, None]
    ways = [unit(rng, count, ESTIMATES) + lean * inward, unit(rng, count, ESTIMATES) + lean * inward]
    away = np.stack([w / np.linalg.norm(w, axis=-1, keepdims=True) for w in ways])
    # Along the motion an estimate of a greater speed stops later.
    away[1, :, ::4] = (v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-9))[:, None]
    away *= 1.0 - 1e-9
    return r, v, a.position_error * size * away[0], a.velocity_error * size * away[1]


ERRORS = [
    {"position_error": 0.05},
    {"position_error": 0.01, "velocity_error": 2e-3},
    {"position_error": 0.01, "velocity_error": 1e-3, "delay": 3},
]


@settings(max_examples=6, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), world=st.sampled_from(["union", "slot"]), errors=st.sampled_from(ERRORS))
def test_a_certified_start_is_certified_from_every_estimate(seed, world, errors):
    guard = guard_for(world, **errors)
    _, start, told = judged(guard, *draw(guard, seed, 2000))
    assert start.sum() > 20
    assert told[start].all()


@pytest.mark.parametrize("errors", ERRORS)
def test_the_truth_alone_does_not_tell_and_the_condition_is_tight(errors):
    guard = guard_for("ball", **errors)
    truth, start, told = judged(guard, *draw(guard, 1, 2000))
    assert not np.any(start & ~truth)
    # Certified from the truth, and not from an estimate that the guard may be told: the promise would be void.
    open_ = truth & ~told.all(axis=1)
    assert open_.sum() > 50
    # Of the states refused for their estimates, a good part has a bad estimate among the few drawn.
    assert open_.sum() > 0.2 * (truth & ~start).sum()


def test_with_a_perfect_estimate_both_are_the_same():
    guard = guard_for("union")
    truth, start, _ = judged(guard, *draw(guard, 2, 2000))
    assert truth.sum() > 100
    assert (truth != start).mean() < 1e-3


@pytest.mark.parametrize("delay", [0, 3])
def test_a_way_out_ends_only_where_the_speed_is_kept_from_then_on(delay):
    # A start above the speed limit: the commands under way must bring it below before anything is certified.
    guard = guard_for("ball", delay=delay, disturbance_force=0.004)
    certified, status, speed = fly_too_fast(guard, 5, 200)
    escaped = status[:, 0] & 3 == GuardStatus.ESCAPING
    assert escaped.sum() > 50
    assert certified[:, -1].all()
    assert speed[np.maximum.accumulate(certified, axis=1)].max() <= guard.assumptions.speed_limit
    assert speed[escaped].max() > guard.assumptions.speed_limit
