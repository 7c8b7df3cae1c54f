"""The theorem of docs/guard.md as a property of states: from every certified one, whatever is commanded, back into one.

The certified set is written down again here from the document, apart from the guard's own code: the field over the
plan's whole tube (sampled densely, on exact distances), and an error from the plan that the rest of the impulse
response can still hold.
"""

import dataclasses
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from truths.guarded_worlds import ASSUMED, INTENTS, KINDS, WORLDS, fly_batch, of_any_numbers

from keepout.guard.braking import radii
from keepout.guard.guard import Guard
from keepout.guard.status import GuardFlag

pytestmark = pytest.mark.long

THRESHOLD = 0.5


def guard_for(world, **changes):
    return Guard(WORLDS[world], threshold=THRESHOLD, lipschitz=1.0, assumptions=dataclasses.replace(ASSUMED, **changes))


def remaining_response(guard, D, terms=400):
    """β_j of the document for no delay and a perfect estimate: what disturbances may still add to e_r after j steps."""
    b, T = guard.braking, guard.assumptions.period
    closed = np.array([[1, T], [0, 1]]) - np.outer([T**2 / 2, T], [b.position_gain, b.velocity_gain])
    powers = [np.eye(2)]
    for _ in range(terms):
        powers.append(closed @ powers[-1])
    powers = np.stack(powers)
    tau = (np.arange(400) + 0.5) / 400 * T
    kernel = D * T * np.abs(powers[:, 0, :1] * tau + powers[:, 0, 1:]).mean(axis=1)
    return powers, np.cumsum(kernel[::-1])[::-1]


@eqx.filter_jit
def plan_clearance(guard, position, velocity):
    """Least field value over the nominal braking motion, step by step to rest, then densely along it."""
    b, T = guard.braking, guard.assumptions.period

    def step(state, _):
        r, v = state
        speed = jnp.linalg.norm(v, axis=-1, keepdims=True)
        u = -v / jnp.maximum(speed, 1e-12) * jnp.minimum(b.deceleration, speed / T)
        return (r + T * v + 0.5 * T**2 * u, v + T * u), None

    (end, left), _ = jax.lax.scan(step, (position, velocity), length=60)
    along = jnp.linspace(0.0, 1.0, 80)
    values = jax.lax.map(lambda s: guard.field.value(position + s * (end - position)), along)
    return jnp.where(jnp.max(jnp.abs(left), axis=-1) < 1e-9, values.min(axis=0), -jnp.inf)


def certified_states(guard, memory, r, v, D):
    """Membership of (r, v, plan) in the certified set, and the largest excess of its error condition."""
    e = np.stack([np.asarray(r - memory.plan_position), np.asarray(v - memory.plan_velocity)], axis=-2)
    powers, rest = remaining_response(guard, D)
    free = np.linalg.norm(np.einsum("mj,...jx->m...x", powers[:60, 0], e), axis=-1)
    excess = (free - rest[:60].reshape(-1, *[1] * (free.ndim - 1))).max(axis=0)
    clear = plan_clearance(of_any_numbers(guard), memory.plan_position, memory.plan_velocity)
    within = clear >= THRESHOLD + guard.braking.position_radius
    return np.asarray(within) & (excess <= 1e-7) & np.asarray(memory.certified), excess


@pytest.mark.parametrize("world", WORLDS)
def test_one_step_leaves_a_certified_state(world):
    guard = guard_for(world)
    D = guard.assumptions.disturbance
    states = 0
    for number, (kind, intent) in enumerate(itertools.product(KINDS, INTENTS)):
        certified, (memory, r, v, lowest, status, out) = fly_batch(
            guard, number, 400, steps=16, size=D * (1 - 1e-9), kind=kind, intent=intent
        )
        chosen = np.asarray(certified)
        assert chosen.sum() > 30
        after, excess = certified_states(guard, memory, r, v, D)
        assert after[chosen].all(), excess[chosen].max()
        assert np.asarray(lowest)[chosen].min() > THRESHOLD
        assert np.abs(np.asarray(out)).max() <= ASSUMED.force_limit * (1 + 1e-9)
        assert not np.any(np.asarray(status)[chosen] & int(GuardFlag.STATE_JUMP | GuardFlag.OFF_PLAN | GuardFlag.FIELD))
        assert np.any(np.asarray(status)[chosen] & 3)
        states += after[chosen].size
    assert 3 * states > 100_000


def deepest(
    assumed, true_size, world="ball", delay=0, errors=(0.0, 0.0), gain=0.0, flights=150, steps=100, kind="constant"
):
    guard = Guard(WORLDS[world], threshold=THRESHOLD, lipschitz=1.0, assumptions=assumed)
    certified, rows = fly_batch(
        guard, 3, flights, steps=steps, size=true_size, kind=kind, intent="into the body", errors=errors, gain=gain
    )
    chosen = np.asarray(certified)
    assert chosen.sum() > 15
    return guard, np.asarray(rows[3])[chosen].min(), np.asarray(rows[4])[chosen]


@pytest.mark.parametrize(
    ("changes", "errors", "gain"),
    [
        pytest.param({"delay": 1}, (0.0, 0.0), 0.0, id="delay 1", marks=pytest.mark.slow),
        pytest.param({"delay": 3}, (0.0, 0.0), 0.0, id="delay 3", marks=pytest.mark.slow),
        pytest.param(
            {"position_error": 0.01, "velocity_error": 5e-4}, (0.01, 5e-4), 0.0, id="estimate", marks=pytest.mark.slow
        ),
        pytest.param({"gain_error": 0.05}, (0.0, 0.0), 0.05, id="gain", marks=pytest.mark.slow),
        pytest.param(
            {"delay": 2, "position_error": 0.005, "velocity_error": 2e-4, "gain_error": 0.02},
            (0.005, 2e-4),
            0.02,
            id="all",
        ),
    ],
)
@pytest.mark.parametrize("world", ["union"])
def test_delay_estimate_and_gain_errors_within_their_bounds(changes, errors, gain, world):
    assumed = dataclasses.replace(ASSUMED, **changes)
    scale = gain * 3**0.5 * ASSUMED.authority
    for kind in ("constant", "resonant"):
        _, lowest, status = deepest(
            assumed, (assumed.disturbance - scale) * (1 - 1e-9), world, errors=errors, gain=gain, kind=kind
        )
        assert lowest > THRESHOLD
        assert not np.any(status & int(GuardFlag.STATE_JUMP | GuardFlag.OFF_PLAN | GuardFlag.FIELD))


def test_the_bound_is_used_up():
    # A constant push towards the body must bring the chaser near the threshold: a slack guard passes every other test.
    guard, lowest, _ = deepest(ASSUMED, ASSUMED.disturbance, kind="constant", steps=300)
    assert THRESHOLD < lowest < THRESHOLD + 0.6 * guard.braking.position_radius


def test_with_its_disturbance_bound_halved_the_guard_fails_and_says_so():
    half = dataclasses.replace(ASSUMED, disturbance_force=ASSUMED.disturbance_force / 2)
    _, lowest, status = deepest(half, 2.0 * half.disturbance, kind="constant", steps=300)
    assert lowest < THRESHOLD
    assert np.all(np.any(status & int(GuardFlag.STATE_JUMP), axis=1))


def test_resting_chaser_stays_in_the_ball():
    guard = guard_for("ball", disturbance_force=0.02)
    D = guard.assumptions.disturbance
    certified, (memory, r, *_) = fly_batch(guard, 1, 150, steps=300, size=D, kind="constant", intent="into the body")
    still = np.asarray(jnp.linalg.norm(memory.plan_velocity, axis=-1) < 1e-9) & np.asarray(certified)[:, None]
    away = np.linalg.norm(np.asarray(r - memory.plan_position), axis=-1)
    assert still.sum() > 1000
    assert 0.3 * guard.braking.position_radius < away[still].max() <= guard.braking.position_radius


@pytest.mark.parametrize("poles", [(0.1, 0.2), (0.3, 0.9), (0.8, 0.8)])
def test_radii_are_reached_by_the_worst_disturbance(poles):
    # The disturbance that follows the kernel's sign drives the error to ρ: the radius is a least upper bound.
    made = radii(ASSUMED, *poles)
    T, D = ASSUMED.period, ASSUMED.disturbance
    closed = np.array([[1, T], [0, 1]]) - np.outer([T**2 / 2, T], [made.position_gain, made.velocity_gain])
    assert np.allclose(np.sort(np.linalg.eigvals(closed).real), np.sort(poles), atol=1e-6)
    fine = 200
    tau = (np.arange(fine) + 0.5) / fine * T
    row, total = np.array([1.0, 0.0]), 0.0
    control = 0.0
    for _ in range(600):
        total += np.abs(row @ np.stack([T - tau, np.ones(fine)])).sum() * T / fine
        row = row @ closed
    row = -np.array([made.position_gain, made.velocity_gain])
    for _ in range(600):
        control += np.abs(row @ np.stack([T - tau, np.ones(fine)])).sum() * T / fine
        row = row @ closed
    bow = T**2 / 8 * (made.reserve + D)
    assert D * total == pytest.approx(made.position_radius - bow, rel=1e-4)
    assert D * control == pytest.approx(made.reserve, rel=1e-4)
