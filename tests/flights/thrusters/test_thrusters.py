"""Layouts, what they can give, which thrusters fire, and the bounds on what pulses do wrong."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linprog

from keepout.core.errors import ScenarioError
from keepout.flights.thrusters.layout import PRESETS, Capability, Layout, force_box, preset, share
from keepout.flights.thrusters.on_off import Allocation, OnOffThrusters, thruster_errors, vector_error

KEY = jax.random.key(3)
LIMIT = 0.1


def made(name, limit=LIMIT, **numbers):
    return preset(name, force=limit / share(name), arm=0.5, **numbers)


def random_layout(seed, count):
    generator = np.random.default_rng(seed)
    direction = generator.normal(size=(count, 3))
    return Layout(generator.normal(size=(count, 3)), direction, generator.uniform(0.02, 0.1, count))


# Each number of thrusters has programs of its own.
layouts = st.builds(random_layout, st.integers(0, 10_000), st.sampled_from([4, 7, 12]))


def least_propellant(layout, force):
    """SciPy's answer: the least Σ f t for a force, or None where no on-times give it."""
    found = linprog(layout.force, A_eq=layout.pushes().T, b_eq=force, bounds=(0.0, 1.0), method="highs")
    return found.fun if found.status == 0 else None


shares = eqx.filter_jit(lambda allocation, force: allocation.shares(force))


@pytest.mark.long
@given(layouts, st.integers(0, 10_000))
def test_the_allocation_is_the_linear_program(layout, seed):
    generator = np.random.default_rng(seed)
    allocation = Allocation.of(layout)
    for _ in range(5):
        on = generator.uniform(size=layout.count) * (generator.uniform(size=layout.count) < 0.6)
        force = on @ layout.pushes()  # within reach, as it was made by on-times
        found = np.asarray(shares(allocation, jnp.asarray(force)))
        assert found.min() >= 0.0
        assert found.max() <= 1.0
        np.testing.assert_allclose(found @ layout.pushes(), force, atol=1e-9)
        least = least_propellant(layout, force)
        assert found @ layout.force <= least * (1.0 + 1e-6) + 1e-12


@pytest.mark.parametrize("ones", [2, 3])
def test_directions_of_which_four_lie_in_a_plane_give_the_force_asked_for(ones):
    """To a cube's corners, or its edges: then the planes of four groups met in a point, and forces were cut off."""
    corners = np.array(list(itertools.product((-1.0, 0.0, 1.0), repeat=3)))
    corners = corners[np.abs(corners).sum(axis=1) == ones]
    layout = Layout(-0.5 * corners, corners, np.full(len(corners), LIMIT))
    limit, allocation = force_box(layout), Allocation.of(layout)
    for force in np.random.default_rng(0).uniform(-limit, limit, (200, 3)):
        found = np.asarray(shares(allocation, jnp.asarray(force)))
        np.testing.assert_allclose(found @ layout.pushes(), force, atol=1e-12)


@pytest.mark.parametrize("name", PRESETS)
def test_presets_fire_the_closed_form_without_torque(name):
    layout = made(name)
    allocation = Allocation.of(layout)
    generator = np.random.default_rng(0)
    for force in [*generator.uniform(-LIMIT, LIMIT, (50, 3)), np.zeros(3), np.array([LIMIT, -LIMIT, 0.0])]:
        found = np.asarray(shares(allocation, jnp.asarray(force)))
        expected = np.maximum(layout.direction @ force, 0.0) / LIMIT
        np.testing.assert_allclose(found, expected, atol=1e-12)
        np.testing.assert_allclose(found @ layout.torques(), 0.0, atol=1e-12)


def test_a_thruster_lost_leaves_pairs_without_torque_first():
    layout = made("24").without(1)
    found = np.asarray(shares(Allocation.of(layout), jnp.array([0.04, 0.0, 0.0])))
    np.testing.assert_allclose(found @ layout.torques(), 0.0, atol=1e-12)
    assert found[1] == 0.0
    more = np.asarray(shares(Allocation.of(layout), jnp.array([0.075, 0.0, 0.0])))
    np.testing.assert_allclose(more[:4], [1.0, 0.0, 1.0, 1.0])


def zonotope_box(layout, stuck=None, on=False):
    """Independent of the linear program: the support function along the normals of all facets of the set of forces."""
    pushes = layout.pushes()
    constant = np.zeros(3)
    if stuck is not None:
        constant = pushes[stuck] * on
        pushes = np.delete(pushes, stuck, axis=0)
    normals = np.cross(pushes[:, None], pushes[None]).reshape(-1, 3)
    normals = normals[np.linalg.norm(normals, axis=1) > 1e-12]
    normals = np.concatenate([normals, -normals])
    height = np.maximum(normals @ pushes.T, 0.0).sum(axis=1) + normals @ constant
    return max(0.0, float(np.min(height / np.abs(normals).sum(axis=1))))


@given(layouts, st.booleans())
def test_force_boxes_are_those_of_the_set_of_forces(layout, on):
    assert force_box(layout) == pytest.approx(zonotope_box(layout), abs=1e-8)
    stuck = "on" if on else "off"
    assert force_box(layout, 0, stuck) == pytest.approx(zonotope_box(layout, 0, on), abs=1e-8)


@pytest.mark.parametrize(("name", "left", "torque_free"), [("six", 0.0, 0.0), ("12", 0.5, 0.0), ("24", 0.75, 0.75)])
def test_what_a_preset_has_left(name, left, torque_free):
    able = Capability.of(made(name))
    assert able.whole == pytest.approx(LIMIT)
    np.testing.assert_allclose([*able.stuck_off, *able.stuck_on], left * LIMIT, atol=1e-9)
    assert able.after_failure == pytest.approx(left * LIMIT)
    balanced = Capability.of(made(name), torque_free=True)
    assert balanced.whole == pytest.approx(LIMIT)
    np.testing.assert_allclose([*balanced.stuck_off, *balanced.stuck_on], torque_free * LIMIT, atol=1e-9)


def thrusters(layout, **chosen):
    return OnOffThrusters.of(layout, **({"force_limit": LIMIT, "period": 1.0} | chosen))


PERIODS = 4000


@eqx.filter_jit
def _run(model, asked, key):
    return jax.lax.scan(lambda state, command: model.fire(state, command), model.initial_state(key), asked)[1]


def flown(model, asked, seed=0):
    """Fire for a row of commands; the pulses, mean forces, on-times and propellant of each period."""
    # Every other number of periods is compiled anew: nothing is asked in those that are added.
    whole = np.zeros((PERIODS, 3))
    whole[: len(asked)] = asked
    firing = _run(model, jnp.asarray(whole), jax.random.fold_in(KEY, seed))
    return jax.tree.map(lambda column: np.asarray(column)[: len(asked)], firing)


TIME = np.linspace(0.0, 1.0, 101)


@jax.jit
def integrals(pulses):
    """Of the pulses' departure from their mean: its final second integral, and both along the period."""

    def of(order):
        return jax.vmap(lambda p: jax.vmap(lambda t: p.moment(order, t))(TIME))(pulses)

    return jax.vmap(lambda p: p.moment(2, 1.0))(pulses), of(2), of(1)


def commands(count, seed=0, limit=LIMIT):
    generator = np.random.default_rng(seed)
    values = generator.uniform(-limit, limit, (count, 3)) * generator.choice([0.02, 0.2, 1.0], (count, 1))
    values[:: count // 10] = limit * generator.choice([-1.0, 1.0], (len(values[:: count // 10]), 3))
    return values


ERRORS = {"rise_delay": 0.004, "misalignment": 0.02, "scale_error": 0.03}


SLOW = [pytest.param(*pair, marks=pytest.mark.slow) for pair in (("12", False), ("24", True))]


@pytest.mark.long
@pytest.mark.parametrize(("name", "delta_sigma"), [("six", False), ("six", True), ("12", True), ("24", False), *SLOW])
@pytest.mark.parametrize("errors", [{}, ERRORS], ids=["exact", "errors"])
def test_bounds_hold_and_are_nearly_met(name, delta_sigma, errors):
    layout = made(name, **errors)
    bounds = thruster_errors(layout, force_limit=LIMIT, mass=20.0, period=1.0, delta_sigma=delta_sigma)
    asked = commands(PERIODS)
    firing = flown(thrusters(layout, delta_sigma=delta_sigma), asked)
    # Every error together: a force that is constant over the period, and one that changes sign in its middle.
    final, moved, speed = map(np.asarray, integrals(firing.pulses))
    moved, speed = moved / 20.0, speed / 20.0
    same_effect = np.linalg.norm(firing.force - asked, axis=1) + 4.0 * np.linalg.norm(final, axis=1)
    gain = bounds.gain_error * np.sqrt(3.0) * LIMIT
    assert same_effect.max() <= bounds.force_error + gain + 1e-12
    distance = np.linalg.norm(moved, axis=2).max() + np.linalg.norm(final, axis=1).max() / 20.0
    assert distance <= bounds.excursion
    assert np.linalg.norm(speed, axis=2).max() <= bounds.velocity_excursion
    if not errors:
        assert same_effect.max() >= 0.8 * bounds.force_error
        assert distance >= 0.8 * bounds.excursion
        owed = np.linalg.norm(np.cumsum(firing.force - asked, axis=0), axis=1)
        assert owed.max() <= bounds.running_error
        assert owed.max() > 0.3 * min(bounds.running_error, 0.01)


@pytest.mark.long
def test_errors_of_thrusters_that_are_askew_together_add_up_as_vectors():
    """Each axis is turned towards the other two: what pulses leave out is more than (1 + ε) √3 F of their share."""
    layout = made("six", misalignment=0.05)
    bounds = thruster_errors(layout, force_limit=LIMIT, mass=20.0, period=1.0, delta_sigma=False)
    six = thrusters(layout)
    along = np.asarray(six.push)
    across = np.sign(along.sum(axis=1, keepdims=True)) * np.ones(3) * np.linalg.norm(along, axis=1, keepdims=True)
    across = (across - along) / np.sqrt(2.0)
    askew = np.cos(0.05) * along + np.sin(0.05) * across
    np.testing.assert_allclose(np.linalg.norm(askew, axis=1), np.linalg.norm(along, axis=1))
    shares = 0.5 * layout.least_on_time * (along.sum(axis=1) > 0.0) * (1.0 - 1e-9)
    state = eqx.tree_at(lambda memory: memory.push, six.initial_state(jax.random.key(0)), jnp.asarray(askew))
    _, firing = six.fire(state, jnp.asarray(shares @ along))
    np.testing.assert_array_equal(firing.force, 0.0)
    left_out = np.linalg.norm(shares @ askew)
    assert (1.0 + vector_error(layout)) * np.linalg.norm(shares @ along) < left_out <= bounds.force_error


@pytest.mark.long
def test_delta_sigma_gives_in_the_mean_what_pulse_width_leaves_out():
    small = np.tile([0.0004, -0.0007, 0.0009], (500, 1))  # all below half of the shortest pulse's 0.002 N
    plain = flown(thrusters(made("six")), small)
    np.testing.assert_array_equal(plain.force, 0.0)
    summed = np.asarray(flown(thrusters(made("six"), delta_sigma=True), small).force).mean(axis=0)
    np.testing.assert_allclose(summed, small[0], atol=0.001 / 500 + 1e-12)


@pytest.mark.long
def test_pulses_keep_to_the_least_on_time_and_the_period():
    firing = flown(thrusters(made("12"), delta_sigma=True), commands(2000))
    on = np.asarray(firing.on_time)
    assert np.all((on == 0.0) | (on >= 0.02 - 1e-12))
    assert on.max() <= 1.0 + 1e-12
    assert np.any((on > 0.0) & (on < 0.03))


@pytest.mark.long
def test_propellant_is_thrust_over_exhaust_velocity():
    firing = flown(thrusters(made("24", specific_impulse=60.0)), commands(100))
    thrust = (np.asarray(firing.on_time) * LIMIT / 4.0).sum(axis=1)
    np.testing.assert_allclose(firing.propellant, thrust / (60.0 * 9.80665), rtol=1e-12)


@pytest.mark.long
def test_a_late_valve_pours_into_the_next_period():
    layout = made("six", rise_delay=0.01)
    asked = np.array([[LIMIT, 0, 0], [LIMIT, 0, 0], [0, 0, 0], [0.5 * LIMIT, 0, 0]])
    firing = flown(thrusters(layout), asked)
    np.testing.assert_allclose(firing.on_time[:, 0], [0.99, 1.0, 0.01, 0.5], atol=1e-12)


@pytest.mark.long
def test_errors_are_drawn_within_their_bounds_once_a_flight():
    layout = made("12", misalignment=0.02, scale_error=0.03)
    model = thrusters(layout)
    worst = 0.0
    keys = jax.vmap(jax.random.key)(jnp.arange(200))
    for push in np.asarray(jax.jit(jax.vmap(lambda key: model.initial_state(key).push))(keys)):
        size = np.linalg.norm(push, axis=1) / layout.force
        angle = np.arccos(np.clip(np.sum(push * layout.direction, axis=1) / (size * layout.force), -1.0, 1.0))
        assert np.abs(size - 1.0).max() <= 0.03
        assert angle.max() <= 0.02 + 1e-9
        worst = max(worst, np.linalg.norm(push - layout.pushes(), axis=1).max() / layout.force[0])
    assert 0.7 * vector_error(layout) < worst <= vector_error(layout)


@pytest.mark.long
@pytest.mark.parametrize("stuck", ["off", "on"])
@pytest.mark.parametrize("name", ["12", pytest.param("24", marks=pytest.mark.slow)])
def test_every_stuck_thruster_is_made_up_for_once_it_is_known(name, stuck):
    layout = made(name)
    left = Capability.of(layout).after_failure
    asked = commands(60, limit=left)
    bounds = thruster_errors(layout, force_limit=left, mass=20.0, period=1.0, delta_sigma=False, detection_time=4.0)
    assert bounds.fault_steps == 4
    for thruster in range(layout.count):
        chosen = {"stuck": (thruster, stuck), "stuck_from": 10.0, "detection_time": 4.0, "force_limit": left}
        firing = flown(thrusters(layout, **chosen), asked)
        wrong = np.linalg.norm(firing.force - asked, axis=1)
        assert wrong[:10].max() <= bounds.force_error
        assert wrong[10:14].max() <= bounds.force_error + bounds.fault_force
        assert wrong[14:].max() <= bounds.force_error
        assert np.all(np.asarray(firing.on_time)[10:, thruster] == float(stuck == "on"))
        unknown = flown(thrusters(layout, **(chosen | {"detection_time": np.inf})), asked)
        assert np.linalg.norm(unknown.force - asked, axis=1)[14:].max() > 2.0 * bounds.force_error


@pytest.mark.long
def test_a_command_that_is_not_a_number_stays_one():
    firing = flown(thrusters(made("six")), np.array([[np.nan, 0.0, 0.0]]))
    assert np.isnan(firing.force).any()


def test_refusals_name_the_numbers():
    with pytest.raises(ScenarioError, match=r"do not span three axes .*singular value"):
        Layout(np.zeros((4, 3)), np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]]), np.full(4, 0.1))
    with pytest.raises(ScenarioError, match="least_on_time: 2 s is longer than the control period, 1 s"):
        thrusters(made("six", least_on_time=2.0))
    with pytest.raises(ScenarioError, match=r"rise_delay: 0\.6 s"):
        thrusters(made("six", rise_delay=0.6))
    with pytest.raises(ScenarioError, match="thrusters are 0 to 5"):
        thrusters(made("six"), stuck=(6, "on"))
    with pytest.raises(ScenarioError, match=r"scale_error is 1\.5"):
        made("six", scale_error=1.5)
