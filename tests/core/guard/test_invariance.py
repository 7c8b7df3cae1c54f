"""The theorem of docs/guard.md as a property of states: from every certified one, whatever is commanded, back into one.

The certified set is written down again here from the document, apart from the guard's own code: the field over the
plan's whole tube (sampled densely, on exact distances), and an error from the plan that the rest of the impulse
response can still hold.

That it is invariant, for no delay (n = 0) and no errors of the estimate (ε = 0): with B_i = D Σ_{l≥i} k(cM^l) let the
set have the states x and plans z with |cM^i(x − z)| ≤ B_i for all i ≥ 0 and a certified tube about z's braking motion.
After a step e⁺ = Me + w̃, so |cM^i e⁺| ≤ B_{i+1} + D k(cM^i) = B_i, and the tube about the stepped z is part of the one
before.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from truths.guarded_worlds import ASSUMED, CAPS, NOISY, THRESHOLD, WORLDS, calm, deceived, fly, guard_in, hostile, units

from keepout.core.guard.braking import radii
from keepout.core.guard.safety_layer import GuardFlag, GuardStatus
from keepout.core.motion.arrays import numbers_as_arrays

pytestmark = pytest.mark.long

SILENT = int(GuardFlag.STATE_JUMP | GuardFlag.OFF_PLAN | GuardFlag.FIELD | GuardFlag.WIDE)


def remaining_response(guard, terms=400):
    """B_j for the position: what disturbances may still add to e_r after j steps."""
    b, T, D = guard.braking, guard.assumptions.period, guard.assumptions.disturbance
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


def certified_states(guard, flown):
    """Membership of states and their plans in the certified set, and the largest excess of its error condition."""
    e = np.stack([flown.position - flown.plan_position, flown.velocity - flown.plan_velocity], axis=-2)
    powers, rest = remaining_response(guard)
    free = np.linalg.norm(np.einsum("mj,...jx->m...x", powers[:60, 0], e), axis=-1)
    excess = (free - rest[:60].reshape(-1, *[1] * (free.ndim - 1))).max(axis=0)
    clear = np.asarray(plan_clearance(numbers_as_arrays(guard), flown.plan_position, flown.plan_velocity))
    within = clear >= THRESHOLD + guard.braking.position_radius
    return within & (excess <= 1e-7) & flown.certified, excess


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 6))])
def test_one_step_leaves_a_certified_state(world, seed):
    guard = guard_in(world)
    chosen, flown = fly(guard, hostile(seed, 1200, 20))
    assert chosen.sum() > 120
    after, excess = certified_states(guard, flown)
    assert after[chosen].all(), excess[chosen].max()
    assert flown.lowest[chosen].min() > THRESHOLD
    assert np.abs(flown.force).max() <= ASSUMED.force_limit * (1 + 1e-9)
    assert not np.any(flown.status[chosen] & SILENT)
    assert np.any(flown.status[chosen] & 3)


def deepest(guard, size=None):
    """Fly against steady pushes and full thrust towards a ball; the least field values, and statuses."""
    certified, flown = fly(guard, hostile(3, 360, 300, pushes=["constant"], intents=["into the body"]), size)
    assert certified.sum() > 15
    return flown.lowest[certified].min(), flown.status[certified]


def test_the_bound_is_used_up():
    # A constant push towards the body must bring the chaser so near that half the tube around a plan would not do.
    guard = guard_in("ball")
    lowest, _ = deepest(guard)
    assert THRESHOLD < lowest < THRESHOLD + 0.5 * guard.braking.position_radius


def test_with_its_disturbance_bound_halved_the_guard_fails_and_says_so():
    half = guard_in("ball", disturbance_force=ASSUMED.disturbance_force / 2)
    lowest, status = deepest(half, 2.0 * half.assumptions.disturbance)
    assert lowest < THRESHOLD
    assert np.all(np.any(status & int(GuardFlag.STATE_JUMP), axis=1))


def test_resting_chaser_stays_in_the_ball():
    guard = guard_in("ball", disturbance_force=0.02)
    flights = hostile(1, 180, 300, pushes=["constant"], intents=["into the body"])
    certified, flown = fly(guard, flights, guard.assumptions.disturbance)
    still = (np.linalg.norm(flown.plan_velocity, axis=-1) < 1e-9) & certified[:, None]
    away = np.linalg.norm(flown.position - flown.plan_position, axis=-1)
    assert still.sum() > 1000
    assert 0.3 * guard.braking.position_radius < away[still].max() <= guard.braking.position_radius


ALL_ERRORS = {"delay": 2, **NOISY, "gain_error": 0.02}
ONE_ERROR = [{"delay": 1}, {"delay": 3}, {"position_error": 0.01, "velocity_error": 5e-4}, {"gain_error": 0.05}]


@pytest.mark.parametrize(
    "changes", [ALL_ERRORS, *(pytest.param(c, marks=pytest.mark.slow) for c in ONE_ERROR)], ids=str
)
def test_delay_estimate_and_gain_errors_within_their_bounds(changes):
    guard = guard_in("union", **changes)
    a = guard.assumptions
    flights = hostile(3, 240, 100, ["constant", "resonant"], ["into the body"])
    rng, shape = np.random.default_rng(3), flights.force.shape
    noise = deceived(3, *shape[:2], caps=a.estimate_errors, noises=["random"], varying=False)
    gain = 1.0 + a.gain_error * rng.choice([-1.0, 1.0], shape)
    scale = a.gain_error * 3**0.5 * a.authority
    certified, flown = fly(
        guard, flights._replace(off=noise.off, errors=noise.errors, gain=gain), (a.disturbance - scale) * (1 - 1e-9)
    )
    assert certified.sum() > 15
    assert flown.lowest[certified].min() > THRESHOLD
    assert not np.any(flown.status[certified] & SILENT)


@pytest.mark.parametrize("poles", [(0.1, 0.2), (0.3, 0.9), (0.8, 0.8)])
def test_radii_are_reached_by_the_worst_disturbance(poles):
    # The disturbance that follows the kernel's sign drives the error to ρ: the radius is a least upper bound.
    made = radii(ASSUMED, *poles)
    T, D = ASSUMED.period, ASSUMED.disturbance
    gains = np.array([made.position_gain, made.velocity_gain])
    closed = np.array([[1, T], [0, 1]]) - np.outer([T**2 / 2, T], gains)
    assert np.allclose(np.sort(np.linalg.eigvals(closed).real), np.sort(poles), atol=1e-6)
    tau = (np.arange(200) + 0.5) / 200 * T

    def summed(row):
        total = 0.0
        for _ in range(600):
            total += np.abs(row @ np.stack([T - tau, np.ones(200)])).mean() * T
            row = row @ closed
        return D * total

    bow = T**2 / 8 * (made.reserve + D)
    assert summed(np.array([1.0, 0.0])) == pytest.approx(made.position_radius - bow, rel=1e-4)
    assert summed(-gains) == pytest.approx(made.reserve, rel=1e-4)


def promised(certified, status):
    """Steps (flights, steps) from which the theorem speaks: a command was passed on and no wide estimate came since."""
    modes, wide = status & 3, status & GuardFlag.WIDE != 0
    found, now = np.zeros(status.shape, bool), certified
    for k in range(status.shape[1]):
        now = (modes[:, k] == 0) | (now & ~wide[:, k])
        found[:, k] = now
    return found


@pytest.mark.parametrize("delay", [0, pytest.param(1, marks=pytest.mark.slow), 2])
@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 12))])
def test_the_threshold_is_kept_whatever_is_told_within_the_errors(delay, seed):
    guard = guard_in("ball", delay=delay, **NOISY)
    for spells in (0.0, 0.1):
        certified, flown = fly(guard, deceived(seed, 60, 300, spells=spells))
        safe = promised(certified, flown.status)
        assert safe[:, -1].mean() > 0.5
        assert flown.lowest[safe].min() > THRESHOLD
        if not spells:
            assert safe[certified].all()
            assert not np.any(flown.status[certified] & SILENT)
            assert np.any(flown.status[certified] & 3)


@pytest.mark.slow
@pytest.mark.parametrize("world", ["union", "slot"])
@pytest.mark.parametrize("delay", [0, 1, 2])
def test_the_threshold_is_kept_around_corners_too(world, delay):
    caps = 0.01, 5e-4
    guard = guard_in(world, delay=delay, position_error=caps[0], velocity_error=caps[1])
    certified, flown = fly(guard, deceived(delay, 360, 300, caps=caps))
    assert certified.sum() > 20
    assert flown.lowest[certified].min() > THRESHOLD
    assert not np.any(flown.status[certified] & SILENT)


def test_a_guard_that_allows_for_less_error_fails_and_the_whole_one_does_not():
    guard, flights = guard_in("ball", delay=2, **NOISY), deceived(1, 120, 400, noises=["inward"], varying=False)
    certified, flown = fly(guard, flights)
    assert certified.sum() > 50
    assert THRESHOLD < flown.lowest[certified].min() < THRESHOLD + 0.5 * guard.braking.position_radius
    assert not np.any(flown.status[certified] & SILENT)
    b = guard.braking
    trusted = eqx.tree_at(lambda g: g.braking.position_radius, guard, b.position_radius - b.observer.error_radius)
    half = guard_in("ball", delay=2, position_error=CAPS[0] / 2, velocity_error=8e-4)
    for less in (trusted, half):
        believed = np.minimum(flights.errors, less.assumptions.estimate_errors)
        certified, flown = fly(less, flights._replace(errors=believed))
        assert (flown.lowest[certified].min(axis=1) <= THRESHOLD).sum() > 3


@pytest.mark.parametrize("changes", [{}, {"delay": 2, "position_error": 0.01, "velocity_error": 8e-4}], ids=str)
def test_a_way_out_ends_only_where_the_speed_is_kept_from_then_on(changes):
    # A start above the speed limit: the commands under way must bring it below before anything is certified.
    guard, rng = guard_in("ball", disturbance_force=0.004, **changes), np.random.default_rng(5)
    limit, away = guard.assumptions.speed_limit, rng.uniform(6.0, 9.0, (180, 1))
    flights = calm(away * units(rng, 180), rng.uniform(0.9, 1.3, (180, 1)) * limit * units(rng, 180), 60)
    push = np.broadcast_to(units(rng, 180)[:, None, None], flights.push.shape)
    _, flown = fly(guard, flights._replace(push=push))
    speed = np.linalg.norm(np.concatenate([flights.velocity[:, None], flown.velocity[:, :-1]], axis=1), axis=-1)
    escaped = flown.status[:, 0] & 3 == GuardStatus.ESCAPING
    assert escaped.sum() > 50
    assert flown.certified[:, -1].all()
    assert speed[np.maximum.accumulate(flown.certified, axis=1)].max() <= limit
    assert speed[escaped].max() > limit


def clearance_after(position, velocity, accelerations, deceleration):
    """Least distance from the ball under accelerations held for a second each, then braking along a straight line."""
    points = [position]
    for acceleration in accelerations:
        position, velocity = position + velocity + 0.5 * acceleration, velocity + acceleration
        points.append(position)
    speed = np.linalg.norm(velocity)
    rest = np.fmod(speed, deceleration)
    stop = velocity / max(speed, 1e-12) * ((speed**2 - rest**2) / (2.0 * deceleration) + 0.5 * rest)
    corners = np.stack([*points, position + stop])
    shares = np.linspace(0.0, 1.0, 30)[:, None, None]
    way = (1.0 - shares) * corners[:-1] + shares * corners[1:]
    return np.linalg.norm(way.reshape(-1, 3), axis=1).min() - 2.0


@pytest.mark.parametrize(
    ("changes", "calm_steps"),
    [({}, 3), ({"delay": 2, **NOISY}, 3), (NOISY, 0)],
    ids=["no errors", "errors, delay", "errors, at the first step"],
)
def test_after_a_jump_a_command_is_passed_on_only_where_it_is_safe_from_both_states(changes, calm_steps):
    guard, rng, many, k = guard_in("ball", **changes), np.random.default_rng(0), 4200, calm_steps
    a, deceleration = guard.assumptions, float(guard.braking.deceleration)
    flights = calm(
        rng.uniform(3.0, 8.0, (many, 1)) * units(rng, many), rng.uniform(0, 0.1, (many, 1)) * units(rng, many), 10
    )
    flights = flights._replace(errors=np.broadcast_to(a.estimate_errors, flights.errors.shape))
    moved = rng.choice([0.002, 0.01, 0.03, 0.1, 0.15, 0.3, 1.0], (many, 1)) * units(rng, many)
    turned = rng.choice([0.0, 0.01, 0.05], (many, 1)) * units(rng, many)
    flights.off[:, k] = np.stack([moved, turned], axis=1)
    flights.force[:, k] = rng.choice([-0.1, 0.0, 0.1], (many, 3))
    certified, flown = fly(guard, flights, 0.0, first=np.zeros((many, 2, 3)))
    flagged = flown.status[:, k] & GuardFlag.STATE_JUMP != 0
    assert flagged.mean() > 0.5
    passed = np.flatnonzero(flagged & (flown.status[:, k] & 3 == GuardStatus.CLEAR))
    assert certified.mean() > 0.4
    assert k == 0 or len(passed) > 10  # a first plan is as far from what is told as its state is
    for i in passed:
        accelerations = flown.force[i, k - a.delay : k + 1] / a.mass
        for position, velocity in (flown.own, flown.told):
            left = clearance_after(position[i, k], velocity[i, k], accelerations, deceleration)
            assert left > THRESHOLD + float(guard.braking.position_radius)


@pytest.mark.parametrize("known", [True, False], ids=["errors declared", "none declared"])
def test_wider_than_declared_it_backs_off_and_goes_on_when_that_is_over(known):
    errors = np.tile((0.01, 1e-3) if known else (0.0, 0.0), (4, 160, 1))
    errors[:, 40:120] = np.array([(0.031, 1e-3), (0.01, 2e-3), (np.inf, np.inf), (np.nan, 1e-3)])[:, None]
    guard, k = guard_in("ball", **({"delay": 2, **NOISY} if known else {})), np.arange(160)
    flights = calm(np.tile([9.0, 0.0, 0.0], (4, 1)), [0.0, 0.1, 0.0], 160)
    flights.force[..., 1] = 0.001
    _, flown = fly(guard, flights._replace(errors=errors), 0.0)
    np.testing.assert_array_equal(flown.status & GuardFlag.WIDE != 0, np.tile((k >= 40) & (k < 120), (4, 1)))
    mode, speed = flown.status & 3, np.linalg.norm(flown.velocity, axis=-1)
    assert np.all(mode[:, :40] == GuardStatus.CLEAR)
    assert np.all(np.isin(mode[:, 40:120], (GuardStatus.BRAKING, GuardStatus.HOLDING)))
    assert np.all(mode[:, 119] == GuardStatus.HOLDING)
    assert speed[:, 119].max() < 1e-4
    assert np.all(mode[:, 120:] == GuardStatus.CLEAR)
    assert speed[:, 159].min() > 1e-3


def test_a_flight_without_a_plan_escapes_while_the_bound_is_wide_and_is_certified_when_it_is_not():
    flights = calm([2.45, 0.0, 0.0], np.zeros(3), 200, errors=(0.01, 1e-3))
    errors = flights.errors.copy()
    errors[:, :60] = 0.05, 1e-3
    flights.force[..., 0] = -0.1
    _, flown = fly(guard_in("ball", delay=2, **NOISY), flights._replace(errors=errors), 0.0)
    mode = flown.status[0] & 3
    assert np.all(mode[:60] == GuardStatus.ESCAPING)
    assert np.all(flown.status[0, :60] & GuardFlag.WIDE)
    assert flown.position[0, 58, 0] > 2.5
    assert mode[-1] != GuardStatus.ESCAPING
    assert np.linalg.norm(flown.position[0, 80:], axis=1).min() > 2.0 + THRESHOLD


def test_known_errors_let_a_smaller_jump_be_seen():
    # A jump within the errors told, and beyond them; one estimate that is off, and known to be worse, or not.
    errors = np.tile([[[0.03, 1e-3]], [[0.005, 1e-3]], [[0.005, 1e-3]], [[0.005, 1e-3]]], (1, 60, 1))
    errors[3, 30] = 0.03, 1e-3
    flights = calm(np.tile([9.0, 0.0, 0.0], (4, 1)), [0.0, 0.1, 0.0], 60)
    flights.off[:2, 30:, 0, 0] = 0.04
    flights.off[2:, 30, 0, 0] = 0.025
    _, flown = fly(guard_in("ball", delay=2, **NOISY), flights._replace(errors=errors), 0.0)
    jumped = np.any(flown.status & GuardFlag.STATE_JUMP, axis=1)
    np.testing.assert_array_equal(jumped, [False, True, True, False])


def test_an_escape_leaves_the_margin_and_ends_certified():
    flights = calm([2.3, 0.0, 0.0], [-0.01, 0.0, 0.0], 60)
    flights.force[..., 0] = -0.1
    certified, flown = fly(guard_in("ball"), flights, 0.0)
    assert not certified
    assert flown.status[0, 0] & 3 == GuardStatus.ESCAPING
    assert flown.status[0, -1] & 3 != GuardStatus.ESCAPING
    assert flown.certified[0, -1]
    assert flown.lowest[0, -1] > THRESHOLD
    assert flown.lowest.min() > 0.27
