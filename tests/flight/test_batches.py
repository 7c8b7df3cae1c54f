import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from truths.flights import KEY, STEPS, make_setup, start_state

from keepout.errors import ScenarioError
from keepout.flight import FlightOutcome, fly, outcome
from keepout.flight.batches import fly_batches, states_at
from keepout.flight.faults import WrongEstimate
from keepout.motion import ConstantDisturbance

NAMES = [name for name in FlightOutcome.__annotations__ if name != "propellant"]


def shell(generator, count):
    direction = generator.standard_normal((count, 3))
    return 8 * direction / np.linalg.norm(direction, axis=1, keepdims=True), np.zeros((count, 3))


@pytest.fixture(scope="module")
def flown():
    setup = make_setup()
    states = states_at(setup.motion, *shell(np.random.default_rng(3), 7))
    chunks, reports = {}, []
    result = fly_batches(
        setup,
        states,
        STEPS,
        columns=("position", "guard_status"),
        landed=lambda first, log: chunks.update({first: log}),
        batch=3,
        workers=2,
        progress=lambda fraction, message: reports.append((fraction, message)),
    )
    return setup, states, result, chunks, reports


@pytest.mark.long
def test_a_campaign_is_its_single_flights(flown):
    setup, states, result, chunks, _ = flown
    position = np.concatenate([chunks[first]["position"] for first in sorted(chunks)])
    assert position.shape == (7, STEPS + 1, 3)
    for index in (0, 4, 6):
        log = fly(setup, jax.tree.map(lambda x, i=index: x[i], states), STEPS, KEY)
        np.testing.assert_allclose(position[index], log.position, atol=1e-12)
        alone = outcome(setup, log)
        for name in NAMES:
            np.testing.assert_allclose(getattr(result, name)[index], getattr(alone, name), rtol=1e-10, err_msg=name)


def test_batches_land_whole_and_once(flown):
    *_, chunks, reports = flown
    assert {first: len(log["position"]) for first, log in chunks.items()} == {0: 3, 3: 3, 6: 1}
    assert set(chunks[0]) == {"position", "guard_status"}
    assert [fraction for fraction, _ in reports] == pytest.approx([3 / 7, 6 / 7, 1.0])
    assert reports[-1][1] == "7 of 7 flights"


@pytest.mark.long
def test_flown_in_parts_each_flight_is_the_same():
    noisy = WrongEstimate(0.0, 0.0, 0.1, 0.01)
    setup = make_setup(faults=noisy)
    states = states_at(setup.motion, *shell(np.random.default_rng(3), 7))

    def positions(first, last, *, place=None):
        place = first if place is None else place
        part, parts = jax.tree.map(lambda x: x[first:last], states), []
        landed = lambda _, log: parts.append(log["position"])  # noqa: E731
        fly_batches(setup, part, STEPS, seed=5, first=place, columns=("position",), landed=landed, batch=4)
        return np.concatenate(parts)

    whole = positions(0, 7)
    assert whole.shape == (7, STEPS + 1, 3)
    np.testing.assert_array_equal(np.concatenate([positions(0, 4), positions(4, 7)]), whole)
    # In another place, from the same starts, other noise.
    assert np.abs(positions(4, 7, place=0) - whole[4:]).max() > 1e-3


def test_flights_begin_where_they_are_told_to():
    motion, (position, velocity) = make_setup().motion, shell(np.random.default_rng(1), 5)
    moving = states_at(motion, position, velocity + 0.01)
    np.testing.assert_array_equal(moving.position, position)
    np.testing.assert_array_equal(moving.velocity, np.full((5, 3), 0.01))
    assert moving.attitude.shape == (5, 4)
    resting, alone = states_at(motion, position), motion.initial_state(position[3], np.zeros(3))
    for one, other in zip(jax.tree.leaves(resting), jax.tree.leaves(alone), strict=True):
        np.testing.assert_allclose(one[3], other, rtol=1e-14)


@pytest.mark.long
def test_what_varies_differs_between_flights():
    pushes = jnp.array([[0.0, 0.0, 0.0], [0.05, 0.0, 0.0]])
    setup = make_setup(disturbance=ConstantDisturbance([0.0, 0.0, 0.0]))
    many = eqx.tree_at(lambda s: s.disturbance.constant, setup, pushes)
    states = jax.vmap(lambda r: start_state(setup, r))(jnp.tile(jnp.array([8.0, 0.0, 0.0]), (2, 1)))
    logs = {}
    fly_batches(
        many,
        states,
        STEPS,
        vary=lambda s: s.disturbance,
        columns=("position",),
        landed=lambda first, log: logs.update(log),
    )
    for index in range(2):
        own = make_setup(disturbance=ConstantDisturbance(pushes[index]))
        log = fly(own, start_state(own, (8.0, 0.0, 0.0)), STEPS, KEY)
        np.testing.assert_allclose(logs["position"][index], log.position, atol=1e-12)
    assert np.abs(logs["position"][0] - logs["position"][1]).max() > 1e-3


def test_impossible_campaigns_are_refused():
    setup = make_setup()
    states = states_at(setup.motion, *shell(np.random.default_rng(0), 2))
    with pytest.raises(ScenarioError, match="columns: thrust"):
        fly_batches(setup, states, 5, columns=("thrust",))
    with pytest.raises(ScenarioError, match="leading axes"):
        fly_batches(setup, states, 5, vary=lambda s: s.goal)  # (3,) is not one goal a flight
    with pytest.raises(ScenarioError, match="flights: 0"):
        states_at(setup.motion, np.zeros((0, 3)))
    with pytest.raises(ScenarioError, match="velocities: shape"):
        states_at(setup.motion, np.zeros((2, 3)), np.zeros(3))
    with pytest.raises(ScenarioError, match="positions: shape"):
        states_at(setup.motion, np.full((2, 3), np.nan))
    with pytest.raises(ScenarioError, match="positions: shape"):
        states_at(setup.motion, np.zeros(3))
