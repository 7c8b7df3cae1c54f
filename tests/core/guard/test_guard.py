"""What the guard answers, one situation at a time."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from truths.guarded_worlds import (
    ASSUMED,
    CAPS,
    NOISY,
    THRESHOLD,
    WORLDS,
    begun,
    filtered,
    guard_in,
    motion_state,
    units,
)

from keepout.core.errors import ControlError
from keepout.core.fields.field import Field
from keepout.core.guard import observer
from keepout.core.guard.braking import stop
from keepout.core.guard.guard import Guard
from keepout.core.guard.safety_layer import GuardFlag, GuardStatus
from keepout.core.motion.arrays import numbers_as_arrays

GUARD = numbers_as_arrays(guard_in("ball"))
STILL = np.zeros(3)
BRAKED = [0.0, -20.0 * GUARD.braking.deceleration, 0.0]


def at(*position, velocity=(0.0, 0.0, 0.0)):
    return motion_state(np.array(position, float), np.array(velocity, float))


FAR, MOVING = at(5.0, 0, 0), at(5.0, 0, 0, velocity=(0.0, 0.1, 0.0))


def answer(state, force, disturbance=STILL, told=None, guard=GUARD):
    return filtered(guard, begun(guard, state), told or state, np.asarray(force, float), disturbance)


@pytest.mark.long
@pytest.mark.parametrize(
    ("state", "command", "told", "passed", "said"),
    [
        (FAR, [0.05, -0.1, 0.02], None, [0.05, -0.1, 0.02], GuardStatus.CLEAR),
        (FAR, [0.5, 0.0, -7.0], None, [0.1, 0.0, -0.1], GuardStatus.CLEAR),  # cut to what the thrusters give
        (MOVING, [np.nan, 0, 0], None, BRAKED, GuardStatus.BRAKING + GuardFlag.COMMAND),
        (MOVING, [np.inf, 0, 0], None, BRAKED, GuardStatus.BRAKING + GuardFlag.COMMAND),
        (MOVING, [0.1, 0, 0], at(np.nan, 0, 0), BRAKED, GuardStatus.BRAKING + GuardFlag.ESTIMATE),
    ],
    ids=["harmless", "beyond the thrusters", "nan", "infinite", "estimate no number"],
)
def test_a_command_is_passed_on_cut_or_replaced(state, command, told, passed, said):
    memory, force, status = answer(state, command, told=told)
    assert status == said
    np.testing.assert_allclose(force, passed, rtol=1e-9, atol=1e-15)
    assert memory.certified


def test_flags():
    calm = numbers_as_arrays(guard_in("ball", disturbance_force=0.0))
    # Where nothing pushes, what an observer leaves of the drift is no disturbance.
    drift = float(calm.assumptions.mass * calm.assumptions.drift)
    for guard, told, flag in (
        (GUARD, 0.0215, GuardFlag.DISTURBANCE),
        (GUARD, 0.0142, 0),
        (calm, 1.1 * drift, GuardFlag.DISTURBANCE),
        (calm, 0.9 * drift, 0),
    ):
        assert answer(FAR, STILL, disturbance=np.array([told, 0, 0]), guard=guard)[2] == flag
    assert answer(at(2.45, 0, 0), STILL)[2] == GuardFlag.FIELD + GuardStatus.ESCAPING
    assert answer(at(41.0, 0, 0), STILL)[2] & GuardFlag.REGION
    memory = answer(FAR, STILL)[0]
    for there, flag in ((at(5.01, 0, 0), GuardFlag.STATE_JUMP), (at(5.0005, 0, 0, velocity=(1e-3, 0, 0)), 0)):
        assert filtered(GUARD, memory, there, STILL)[2] & GuardFlag.STATE_JUMP == flag


def test_one_state_that_nothing_explains_leaves_the_plan_as_it_is():
    push = np.array([-0.1, 0.0, 0.0])
    memory, _, _ = filtered(GUARD, begun(GUARD, MOVING), MOVING, STILL)
    wrong = motion_state(memory.expected_position + jnp.array([0.0, 0.0, 1.0]), memory.expected_velocity)
    followed, force, status = filtered(GUARD, memory, wrong, push)
    assert status == GuardStatus.BRAKING + GuardFlag.STATE_JUMP
    np.testing.assert_allclose(force, BRAKED, atol=1e-12)
    # The next state is explained again, and the flight goes on as if nothing had been told.
    back = motion_state(followed.expected_position, followed.expected_velocity)
    assert filtered(GUARD, followed, back, STILL)[2] == GuardStatus.CLEAR
    # A state that stays where nothing explained it is believed: the plan is far from it.
    there = motion_state(wrong.position + wrong.velocity, wrong.velocity)
    status = filtered(GUARD, followed, there, push)[2]
    assert status == GuardStatus.ESCAPING + GuardFlag.STATE_JUMP + GuardFlag.OFF_PLAN


def test_what_contradicts_itself_carries_no_command_and_what_is_out_of_date_is_flagged():
    guard, push = numbers_as_arrays(guard_in("ball", valid_until=10.0)), np.ones(3)
    memory, held = begun(guard, FAR), GuardStatus.HOLDING + GuardFlag.CONTRADICTED
    assert filtered(guard, memory, FAR, push)[2] == GuardStatus.CLEAR
    assert filtered(guard, memory, FAR, push, contradicted=True)[2] == held
    proved_wrong = eqx.tree_at(lambda m: m.contradicted, memory, jnp.asarray(True))
    after, _, status = filtered(guard, proved_wrong, FAR, push)
    assert status == held
    assert after.contradicted
    for time, flag in ((10.0, 0), (10.6, GuardFlag.EXPIRED)):
        assert filtered(guard, memory, dataclasses.replace(FAR, time=jnp.asarray(time)), push)[2] == flag


@pytest.mark.long
def test_with_the_declared_errors_told_nothing_changes():
    guard, push = guard_in("ball", **NOISY), jnp.array([-0.1, 0.0, 0.0])

    @jax.jit
    def both(x):
        def step(memories, x):
            state = motion_state(jnp.array([1.0, 0.0, 0.0]) * x, jnp.array([-0.01, 0.0, 0.0]))
            told, *first = guard.filter(memories[0], state, push, jnp.zeros(3), jnp.asarray(CAPS))
            untold, *second = guard.filter(memories[1], state, push, jnp.zeros(3))
            return (told, untold), (first, second)

        memory = guard.initial_state(at(4.0, 0.0, 0.0))
        return jax.lax.scan(step, (memory, memory), x)[1]

    (told, seen), (untold, same) = both(4.0 - 0.01 * np.arange(20))
    np.testing.assert_array_equal(told, untold)
    np.testing.assert_array_equal(seen, same)


def test_the_observer_begins_again_within_the_bounds():
    guard, rng = guard_in("ball", **NOISY), np.random.default_rng(0)
    memory = observer.begin(at(0, 0, 0), guard.assumptions, guard.windows)

    @eqx.filter_jit
    def seen(steady, told, errors):
        no, known = jnp.asarray(False), dataclasses.replace(memory, steady=steady)
        return observer.correct(guard.assumptions, guard.braking, known, told[0], told[1], errors, no, no)

    for _ in range(20):
        errors, told = np.asarray(CAPS) * rng.uniform(0.0, 1.0, 2), rng.normal(size=(2, 3)) * 0.1
        for part, where, error, most in zip(seen(np.asarray(False), told, errors), told, errors, CAPS, strict=True):
            assert np.linalg.norm(part - where) + error <= most * (1 + 1e-12)
    position, _ = seen(np.asarray(True), np.stack([np.ones(3), np.zeros(3)]), np.zeros(2))
    assert np.linalg.norm(position - 1.0) > 0.1


class Rippled(Field):
    """Distance to a ball of 2 m, ± 0.02 m: too high in a thin shell about the place asked first, too low beside it."""

    place: jax.Array

    def value(self, points):
        radius = jnp.sqrt(jnp.sum(points**2, axis=-1))
        return radius - 2.0 + jnp.where(jnp.abs(radius - self.place) < 1e-6, 0.02, -0.02)

    def value_and_gradient(self, points):
        return self.value(points), points / jnp.linalg.norm(points)

    def value_gradient_hessian(self, points):
        raise NotImplementedError


@eqx.filter_jit
def certified_and_moved(guard, places, way, speed):
    """Over starts from near to far: whether each is certified, and how far its stop is."""

    def one(place):
        there = eqx.tree_at(lambda guard: guard.field.place, guard, place)
        return there.certified(motion_state(place * way, -speed * way))

    return jax.vmap(one)(places), jnp.linalg.norm(stop(guard.assumptions, guard.braking, -speed * way))


@pytest.mark.long
@pytest.mark.parametrize("share", [1.0, 0.75])
def test_what_is_certified_stays_above_the_threshold_only_with_the_fields_error_carried_twice(share):
    guard = Guard(Rippled(jnp.asarray(0.0)), THRESHOLD, 1.0, ASSUMED, evaluation_error=share * 0.02)
    places, way = np.linspace(2.5, 2.7, 101), units(np.random.default_rng(0), 1)[0]
    for speed in (0.0, 0.02):
        told, moved = certified_and_moved(numbers_as_arrays(guard), places, way, jnp.asarray(speed))
        least = (places - 2.0 - moved - guard.braking.position_radius - 0.02)[np.asarray(told)]
        assert len(least)
        if share == 1.0 or speed == 0.0:
            assert np.all(least > THRESHOLD - 1e-9) == (share == 1.0)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *[("mass", -1.0), ("mass", np.nan), ("period", 0.0), ("disturbance_force", -0.1), ("mass_error", 1.0)],
        *[("delay", 9), ("force_error", -1.0), ("excursion", np.nan), ("velocity_excursion", -1e-9)],
        *[("fault_force", np.inf), ("fault_steps", 101), ("fault_steps", -1)],
    ],
)
def test_assumptions_out_of_range_are_refused(name, value):
    with pytest.raises(ControlError, match=f"guard: {name} is"):
        dataclasses.replace(ASSUMED, **{name: value})


@pytest.mark.parametrize(
    ("changes", "options", "said"),
    [
        ({"force_limit": 0.02}, {}, r"force_limit is 0\.02 N"),  # too weak
        ({}, {"evaluation_error": -1e-9}, "evaluation_error is"),
        ({}, {"evaluation_error": np.nan}, "evaluation_error is"),
        ({"fault_force": 0.1}, {}, r"fault_steps is 0; with a fault_force of 0\.1 N"),  # a fault without an end
    ],
)
def test_a_guard_that_cannot_be_is_refused(changes, options, said):
    with pytest.raises(ControlError, match=said):
        Guard(WORLDS["ball"], THRESHOLD, 1.0, dataclasses.replace(ASSUMED, **changes), **options)
