"""Where the theorem starts: from every estimate of a true start, and where a way out ends."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from truths.guarded_worlds import guard_in, motion_state, units

from keepout.core.errors import ControlError
from keepout.core.guard.start import require_flyable
from keepout.core.motion.arrays import numbers_as_arrays

pytestmark = pytest.mark.long

STATES, ESTIMATES = 400, 16


def judged(guard, *states):
    """For each true state: certified from the truth, from every estimate as the guard says, and from each of some."""
    return tuple(map(np.asarray, _judged(numbers_as_arrays(guard), *states)))


@eqx.filter_jit
def _judged(guard, position, velocity, off_position, off_velocity):
    def told(r, v):
        return jax.vmap(lambda r, v: guard.certified(motion_state(r, v)))(r, v)

    # The truth first, then what may be told of it.
    off = [jnp.concatenate([0.0 * away[:, :1], away], axis=1) for away in (off_position, off_velocity)]
    all_ = jax.vmap(told)(position[:, None] + off[0], velocity[:, None] + off[1])
    start = jax.vmap(lambda r, v: guard.certified_start(motion_state(r, v)))(position, velocity)
    return all_[:, 0], start, all_[:, 1:]


_field = eqx.filter_jit(lambda field, points: jax.vmap(field.value_and_gradient)(points))


def draw(guard, seed):
    """True states near where certification ends, and admissible estimates: at random, and towards the body."""
    rng, a = np.random.default_rng(seed), guard.assumptions
    r = rng.uniform(-6.0, 6.0, (STATES, 3))
    # Most are moved to where the field is little above the least value: there the answers part.
    for _ in range(6):
        value, gradient = map(np.asarray, _field(guard.field, r))
        level = guard.least_value + rng.exponential(0.15, STATES)
        r = r + np.where(rng.random(STATES) < 0.8, level - value, 0.0)[:, None] * gradient
    v = 0.15 * rng.random((STATES, 1)) * units(rng, STATES)
    inward = -np.asarray(_field(guard.field, r)[1])[:, None]
    size = np.where(np.arange(ESTIMATES) < 12, 1.0, rng.random(ESTIMATES))[:, None]
    lean = np.where(np.arange(ESTIMATES) % 2, 8.0, 0.0)[:, None]
    ways = units(rng, 2, STATES, ESTIMATES) + lean * inward
    away = ways / np.linalg.norm(ways, axis=-1, keepdims=True)
    # Along the motion an estimate of a greater speed stops later.
    away[1, :, ::4] = (v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-9))[:, None]
    away *= 1.0 - 1e-9
    return r, v, a.position_error * size * away[0], a.velocity_error * size * away[1]


ERRORS = [{"position_error": 0.05, "velocity_error": 1e-3}, {"position_error": 0.01, "velocity_error": 1.5e-3}]


@given(seed=st.integers(0, 2**32 - 1), world=st.sampled_from(["union", "slot"]), errors=st.sampled_from(ERRORS))
def test_a_certified_start_is_certified_from_every_estimate(seed, world, errors):
    guard = guard_in(world, delay=2, **errors)
    _, start, told = judged(guard, *draw(guard, seed))
    assert start.sum() > 4
    assert told[start].all()


def judged_often(guard):
    answers = [judged(guard, *draw(guard, seed)) for seed in range(5)]
    return (np.concatenate(answer) for answer in zip(*answers, strict=True))


@pytest.mark.parametrize("errors", ERRORS, ids=str)
def test_the_truth_alone_does_not_tell_and_the_condition_is_tight(errors):
    truth, start, told = judged_often(guard_in("ball", delay=2, **errors))
    assert not np.any(start & ~truth)
    # Certified from the truth, and not from an estimate that the guard may be told: the promise would be void.
    open_ = truth & ~told.all(axis=1)
    assert open_.sum() > 50
    # Of the states refused for their estimates, a good part has a bad estimate among the few drawn.
    assert open_.sum() > 0.2 * (truth & ~start).sum()


def test_with_a_perfect_estimate_both_are_the_same():
    truth, start, _ = judged_often(guard_in("union"))
    assert truth.sum() > 100
    assert (truth != start).mean() < 1e-3


def test_what_cannot_be_flown_is_refused():
    def at(*position):
        return motion_state(np.array(position), np.zeros(3))

    guard, goal = guard_in("ball"), jnp.array([0.0, 3.0, 0.0])
    assert require_flyable(guard, at(5.0, 0.0, 0.0), goal)
    assert not require_flyable(guard, at(2.4, 0.0, 0.0), goal)
    for start, to, said in (
        (5.0, 2.51, r"0\.510 m at the goal"),
        (1.0, 3.0, "inside the target"),
        (np.nan, 3.0, r"start.position is \[nan"),
        (5.0, 43.0, "range_limit is 40"),
    ):
        with pytest.raises(ControlError, match=said):
            require_flyable(guard, at(start, 0.0, 0.0), jnp.array([0.0, to, 0.0]))
