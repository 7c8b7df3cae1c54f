"""Campaigns: each flight is that flown alone, whatever flies beside it, and what flights share is computed once."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from truths.flights import KEY, STEPS, make_setup, start_state

from keepout.core.errors import ScenarioError
from keepout.core.flight.batches import TARGET, Batching, alike_among, flight_key, fly_batches, states_at
from keepout.core.flight.faults import WrongEstimate
from keepout.core.flight.loop import FlightOutcome, fly, outcome, start, step
from keepout.core.flight.record import FlightRecord
from keepout.core.motion.attitude import Tumbling
from keepout.core.motion.disturbance import ConstantDisturbance
from keepout.flights.thrusters.layout import preset
from keepout.flights.thrusters.on_off import OnOffThrusters

COLUMNS = "position", "guard_status"


def starts(setup, count):
    direction = np.random.default_rng(3).standard_normal((count, 3))
    position = 8 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    return states_at(setup.motion, position, np.zeros((count, 3)))


def tumbling_setup(**changes):
    turning = Tumbling([0.002, -0.003, 0.001], np.diag([1.0, 2.0, 2.5]))
    setup = make_setup(disturbance=ConstantDisturbance([0.0, 0.01, 0.0]), **changes)
    return eqx.tree_at(lambda s: s.motion.attitude_motion, setup, turning)


def flown(setup, states, **options):
    """The positions of all flights, three at a time."""
    parts, together = [], Batching(**{"seed": 5, "batch": 3} | options)
    fly_batches(setup, states, STEPS, together, columns=COLUMNS, landed=lambda _, log: parts.append(log["position"]))
    return np.concatenate(parts)


def on_off(stuck=(0, "on"), stuck_from=1e6, **numbers):
    """A setup with thrusters that are on or off, of which one sticks, if ever: all share a program."""
    layout, chosen = preset("12", force=0.1, arm=0.5, **numbers), {"stuck": stuck, "stuck_from": stuck_from}
    return make_setup(thrusters=OnOffThrusters.of(layout, force_limit=0.1, period=1.0, detection_time=5.0, **chosen))


@pytest.fixture(scope="module")
def campaign():
    """Seven flights about a tumbling target, with errors of the estimate."""
    setup = tumbling_setup(faults=WrongEstimate(0.1, 0.0, 0.1, 0.01))
    states, chunks, reports = starts(setup, 7), {}, []
    result = fly_batches(
        setup,
        states,
        STEPS,
        Batching(seed=5, batch=3, workers=2),
        columns=COLUMNS,
        landed=lambda first, log: chunks.update({first: log}),
        progress=lambda fraction, message: reports.append((fraction, message)),
    )
    assert {first: len(log["position"]) for first, log in chunks.items()} == {0: 3, 3: 3, 6: 1}
    assert set(chunks[0]) == set(COLUMNS)
    assert [fraction for fraction, _ in reports] == pytest.approx([3 / 7, 6 / 7, 1.0])
    assert reports[-1][1] == "7 of 7 flights"
    return setup, states, result, np.concatenate([chunks[first]["position"] for first in sorted(chunks)])


@pytest.mark.long
def test_a_campaign_is_its_single_flights(campaign):
    setup, states, result, position = campaign
    assert position.shape == (7, STEPS + 1, 3)
    for index in (0, 4, 6):
        log = fly(setup, jax.tree.map(lambda x, i=index: x[i], states), STEPS, flight_key(5, index))
        np.testing.assert_allclose(position[index], log.position, atol=1e-11)
        alone = outcome(setup, log)
        for name in FlightOutcome.__annotations__.keys() - {"propellant"}:
            np.testing.assert_allclose(getattr(result, name)[index], getattr(alone, name), rtol=1e-9, err_msg=name)


@pytest.mark.as_used
@pytest.mark.long
def test_flown_in_parts_or_alone_each_flight_is_the_same_to_the_bit(campaign):
    setup, states, _, whole = campaign

    def part(first, last, place):
        some = jax.tree.map(lambda x: x[first:last], states)
        return flown(setup, some, places=range(place, place + last - first), alike=alike_among(states))

    for first, last in ((0, 4), (4, 7), (3, 4), (6, 7)):
        np.testing.assert_array_equal(part(first, last, first), whole[first:last])
    # In another place, from the same starts, other noise.
    assert np.abs(part(4, 7, 0) - whole[4:]).max() > 1e-3


@pytest.mark.slow  # flights that share some columns are beside flights alone in the tests above
def test_shared_or_not_a_flight_is_the_same(campaign):
    setup, states, _, whole = campaign
    assert alike_among(states) == ("time", "attitude", "angular_velocity")
    np.testing.assert_allclose(flown(setup, states, alike=()), whole, rtol=0.0, atol=1e-11)


def test_keys_of_flights_differ():
    keys = jax.vmap(lambda place: flight_key(7, place))(jnp.arange(100_000))
    assert len(np.unique(jax.random.key_data(keys), axis=0)) == 100_000
    np.testing.assert_array_equal(jax.random.key_data(flight_key(7, 99_990)), jax.random.key_data(keys)[99_990])


def test_impossible_campaigns_are_refused():
    setup = make_setup()
    states = starts(setup, 2)
    with pytest.raises(ScenarioError, match="columns: thrust"):
        fly_batches(setup, states, 5, columns=("thrust",))
    with pytest.raises(ScenarioError, match="alike: position; valid are time"):
        fly_batches(setup, states, 5, Batching(alike=("position",)))
    assert set(TARGET) < set(vars(states))
    with pytest.raises(ScenarioError, match="leading axes"):
        fly_batches(setup, states, 5, Batching(vary=lambda s: s.goal))  # (3,) is not one goal a flight
    for position, velocity, said in (
        (np.zeros((0, 3)), None, "flights: 0"),
        (np.zeros((2, 3)), np.zeros(3), "velocities: shape"),
        (np.full((2, 3), np.nan), None, "positions: shape"),
        (np.zeros(3), None, "positions: shape"),
    ):
        with pytest.raises(ScenarioError, match=said):
            states_at(setup.motion, position, velocity)


@pytest.mark.slow  # forces and pulses are in flights/thrusters/test_thrusters
def test_rows_hold_the_mean_force_and_what_it_burnt_and_the_record_keeps_it(tmp_path):
    setup = on_off(misalignment=0.02, scale_error=0.02, rise_delay=0.005)
    log = fly(setup, start_state(setup), STEPS, KEY)
    state, one = start(setup, start_state(setup), KEY), eqx.filter_jit(step)
    fire, memory = eqx.filter_jit(setup.thrusters.fire), state.thrusters
    for row in range(5):
        state, entry = one(setup, state)
        memory, firing = fire(memory, entry.guarded_force)
        np.testing.assert_allclose(entry.force, firing.force, atol=1e-15)
        np.testing.assert_allclose(log.force[row], firing.force, atol=1e-12)
        np.testing.assert_allclose(log.propellant[row], firing.propellant, rtol=1e-9)
    final = outcome(setup, log)
    assert float(final.propellant) == pytest.approx(float(jnp.sum(log.propellant[:-1])))
    # One thruster for each newton second: at least what the forces' largest axes need, at most what all of them do.
    thrust, flow = np.abs(np.asarray(log.force[:-1])), 1.0 / (70.0 * 9.80665)
    assert 0.9 * flow * thrust.max(axis=1).sum() < float(final.propellant) < 1.1 * flow * thrust.sum()
    record = FlightRecord.of_log(log, outcome=final)
    again = FlightRecord.load(record.save(tmp_path / "flight.parquet"))
    np.testing.assert_array_equal(again.propellant, log.propellant)
    assert again.header["final"]["propellant"] == pytest.approx(float(final.propellant))
