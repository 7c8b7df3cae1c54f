"""States that nothing explains carry a command only where it is safe from them and from the guard's own estimate."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from truths.guarded_worlds import ASSUMED, PIECES, WORLDS, advance, directions, motion_state, of_any_numbers

from keepout.guard.guard import Guard
from keepout.guard.status import GuardFlag, GuardStatus

THRESHOLD, BALL = 0.5, 2.0
ERRORS = {"position_error": 0.03, "velocity_error": 1.5e-3}
FLIGHTS = 4000


def guard_with(**changes):
    return of_any_numbers(Guard(WORLDS["ball"], THRESHOLD, 1.0, dataclasses.replace(ASSUMED, **changes)))


@eqx.filter_jit
def jumped(guard, calm, starts, velocities, commands, moved, turned):
    """Fly some calm steps, tell the last state moved; what is expected, told and under way then, and the answer."""
    a = guard.assumptions

    def one(r, v, command, moved, turned):
        memory, queue = guard.initial_state(motion_state(r, v)), jnp.zeros((a.delay, 3))
        for _ in range(calm):
            memory, out, _ = guard.filter(memory, motion_state(r, v), jnp.zeros(3), jnp.zeros(3))
            queue = jnp.concatenate([queue, out[None]])
            r, v, _ = advance(r, v, queue[0] / a.mass, jnp.zeros((PIECES, 3)))
            queue = queue[1:]
        own = (memory.expected_position, memory.expected_velocity)
        if memory.observed is not None:
            own = (memory.observed.expected_position, memory.observed.expected_velocity)
        told = (r + moved, v + turned)
        _, out, status = guard.filter(memory, motion_state(*told), command, jnp.zeros(3))
        return memory.certified, own, told, queue, out, status

    return jax.vmap(one)(starts, velocities, commands, moved, turned)


def clearance_after(position, velocity, accelerations, deceleration):
    """Least distance from the ball under accelerations held for a second each, then braking along a straight line."""
    points = [position]
    for acceleration in accelerations:
        position, velocity = position + velocity + 0.5 * acceleration, velocity + acceleration
        points.append(position)
    speed = np.linalg.norm(velocity)
    rest = np.fmod(speed, deceleration)
    stop = velocity / max(speed, 1e-12) * ((speed**2 - rest**2) / (2.0 * deceleration) + 0.5 * rest)
    points.append(position + stop)
    corners = np.stack(points)
    shares = np.linspace(0.0, 1.0, 30)[:, None, None]
    way = (1.0 - shares) * corners[:-1] + shares * corners[1:]
    return np.linalg.norm(way.reshape(-1, 3), axis=1).min() - BALL


@pytest.mark.long
@pytest.mark.parametrize(
    ("errors", "delay", "calm"),
    [({}, 2, 3), (ERRORS, 0, 3), (ERRORS, 2, 3), (ERRORS, 0, 0)],
    ids=["no errors, delay", "errors", "errors, delay", "at the first step"],
)
def test_a_command_is_passed_on_only_where_it_is_safe_from_both_states(errors, delay, calm):
    guard, generator = guard_with(delay=delay, **errors), np.random.default_rng(delay)
    starts = generator.uniform(3.0, 8.0, (FLIGHTS, 1)) * np.asarray(directions(generator, FLIGHTS))
    velocities = generator.uniform(0.0, 0.1, (FLIGHTS, 1)) * np.asarray(directions(generator, FLIGHTS))
    moved = generator.choice([0.005, 0.15, 0.3, 1.0, 4.0], (FLIGHTS, 1)) * np.asarray(directions(generator, FLIGHTS))
    turned = generator.choice([0.0, 0.05, 0.2], (FLIGHTS, 1)) * np.asarray(directions(generator, FLIGHTS))
    commands = generator.choice([-0.1, 0.0, 0.1], (FLIGHTS, 3))
    found = jumped(guard, calm, *map(jnp.asarray, (starts, velocities, commands, moved, turned)))
    certified, own, told, queue, out, status = jax.tree.map(np.asarray, found)
    assert certified.mean() > 0.4
    flagged = status & GuardFlag.STATE_JUMP != 0
    assert flagged.mean() > 0.5
    passed = np.flatnonzero(flagged & (status & 3 == GuardStatus.CLEAR))
    assert calm == 0 or len(passed) > 20  # a first plan is as far from what is told as its state is
    a, braking = guard.assumptions, guard.braking
    for i in passed:
        accelerations = np.concatenate([queue[i], out[i][None]]) / float(a.mass)
        for position, velocity in (own, told):
            left = clearance_after(position[i], velocity[i], accelerations, float(braking.deceleration))
            assert left > THRESHOLD + float(braking.position_radius)


def test_one_state_that_nothing_explains_leaves_the_plan_as_it_is():
    guard = guard_with()
    step = eqx.filter_jit(lambda *arguments: guard.filter(*arguments, jnp.zeros(3)))
    far, push = motion_state(jnp.array([5.0, 0.0, 0.0]), jnp.array([0.0, 0.1, 0.0])), jnp.array([-0.1, 0.0, 0.0])
    memory, _, _ = step(guard.initial_state(far), far, jnp.zeros(3))
    expected = motion_state(memory.expected_position, memory.expected_velocity)
    wrong = motion_state(expected.position + jnp.array([0.0, 0.0, 1.0]), expected.velocity)
    followed, force, status = step(memory, wrong, push)
    assert status == GuardStatus.BRAKING + GuardFlag.STATE_JUMP
    np.testing.assert_allclose(force, [0.0, -20.0 * guard.braking.deceleration, 0.0], atol=1e-12)
    # The next state is explained again, and the flight goes on as if nothing had been told.
    back = motion_state(followed.expected_position, followed.expected_velocity)
    assert step(followed, back, jnp.zeros(3))[2] == GuardStatus.CLEAR
    # A state that stays where nothing explained it is believed: the plan is far from it.
    there = motion_state(wrong.position + wrong.velocity, wrong.velocity)
    status = step(followed, there, push)[2]
    assert status & GuardFlag.STATE_JUMP
    assert status & GuardFlag.OFF_PLAN
    assert status & 3 == GuardStatus.ESCAPING


def test_what_contradicts_itself_carries_no_command_and_what_is_out_of_date_is_flagged():
    guard = guard_with(valid_until=10.0)
    step = eqx.filter_jit(
        lambda memory, told, wrong: guard.filter(memory, told, jnp.ones(3), jnp.zeros(3), None, wrong)
    )
    still = motion_state(jnp.array([5.0, 0.0, 0.0]), jnp.zeros(3))
    memory = guard.initial_state(still)
    assert step(memory, still, jnp.asarray(False))[2] == GuardStatus.CLEAR
    assert step(memory, still, jnp.asarray(True))[2] == GuardStatus.HOLDING + GuardFlag.CONTRADICTED
    proved_wrong = eqx.tree_at(lambda m: m.contradicted, memory, jnp.asarray(True))
    after, _, status = step(proved_wrong, still, jnp.asarray(False))
    assert status == GuardStatus.HOLDING + GuardFlag.CONTRADICTED
    assert bool(after.contradicted)
    for time, flag in ((10.0, 0), (10.6, GuardFlag.EXPIRED)):
        assert step(memory, dataclasses.replace(still, time=jnp.asarray(time)), jnp.asarray(False))[2] == flag
