"""The loop with thrusters that are on or off: memory, motion, propellant, a stuck thruster."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from truths.flights import KEY, STEPS, make_setup, start_state

from keepout.flight import fly, outcome
from keepout.flight.batches import flight_key, fly_batches
from keepout.flight.loop import start, step
from keepout.flight.record import FlightRecord
from keepout.motion import Thrusters
from keepout.motion.thrusters.layout import preset
from keepout.motion.thrusters.on_off import OnOffThrusters


def on_off(*, force=0.05, stuck=None, delta_sigma=True, **numbers):
    layout = preset("12", force=force, arm=0.5, **numbers)
    return OnOffThrusters.of(
        layout, force_limit=0.1, period=1.0, delta_sigma=delta_sigma, stuck=stuck, stuck_from=20.0, detection_time=5.0
    )


@pytest.fixture(scope="module")
def flown():
    setup = make_setup(thrusters=on_off(misalignment=0.02, scale_error=0.02, rise_delay=0.005))
    return setup, fly(setup, start_state(setup), 60, KEY)


@pytest.mark.long
def test_rows_hold_the_mean_force_and_what_it_burnt(flown):
    setup, log = flown
    state = start(setup, start_state(setup), KEY)
    one = eqx.filter_jit(step)
    memory = state.thrusters
    for row in range(5):
        state, entry = one(setup, state)
        memory, firing = setup.thrusters.fire(memory, entry.guarded_force)
        np.testing.assert_allclose(entry.force, firing.force, atol=1e-15)
        np.testing.assert_allclose(log.force[row], firing.force, atol=1e-12)
        np.testing.assert_allclose(log.propellant[row], firing.propellant, rtol=1e-9)
    burnt = outcome(setup, log).propellant
    assert float(burnt) == pytest.approx(float(jnp.sum(log.propellant[:-1])))
    # One thruster for each newton second: at least what the forces' largest axes need, at most what all of them do.
    thrust = np.abs(np.asarray(log.force[:-1]))
    flow = 1.0 / (70.0 * 9.80665)
    assert 0.9 * flow * thrust.max(axis=1).sum() < float(burnt) < 1.1 * flow * thrust.sum()


def test_held_forces_burn_nothing_that_is_known():
    setup = make_setup(thrusters=Thrusters(0.1))
    log = fly(setup, start_state(setup), STEPS, KEY)
    assert log.propellant is None
    assert outcome(setup, log).propellant is None


@pytest.mark.long
def test_a_flight_is_the_same_in_a_batch(flown):
    setup, _ = flown
    starts = jnp.array([[0.0, 10.0, 6.0], [8.0, 1.0, -3.0], [-5.0, 5.0, 0.0]])
    states = jax.vmap(lambda r: start_state(setup, r))(starts)
    logs = {}
    result = fly_batches(setup, states, 60, columns=("position",), landed=lambda first, log: logs.update(log))
    alone = fly(setup, start_state(setup, starts[1]), 60, flight_key(0, 1))
    np.testing.assert_allclose(logs["position"][1], alone.position, atol=1e-11)
    assert result.propellant.shape == (3,)
    assert len(set(result.propellant.tolist())) == 3


@pytest.mark.long
def test_the_record_keeps_the_propellant(flown, tmp_path):
    setup, log = flown
    record = FlightRecord.of_log(log, outcome=outcome(setup, log))
    again = FlightRecord.load(record.save(tmp_path / "flight.parquet"))
    np.testing.assert_array_equal(again.propellant, log.propellant)
    assert again.header["final"]["propellant"] == pytest.approx(float(outcome(setup, log).propellant))


@pytest.mark.long
@pytest.mark.parametrize("how", ["on", "off"])
def test_a_stuck_thruster_acts_from_its_time_until_it_is_made_up_for(how):
    whole = make_setup(thrusters=on_off(delta_sigma=False, force=0.1))
    used = np.asarray(fly(whole, start_state(whole), 30, KEY).force)[20:25].mean(axis=0)
    axis = int(np.argmax(np.abs(used)))
    thruster = 4 * axis + (0 if (used[axis] > 0) == (how == "off") else 2)  # off: one in use; on: one against it
    setup = make_setup(thrusters=on_off(stuck=(thruster, how), delta_sigma=False, force=0.1))
    log = fly(setup, start_state(setup), 60, KEY)
    wrong = np.linalg.norm(np.asarray(log.force) - np.clip(np.asarray(log.guarded_force), -0.1, 0.1), axis=1)
    assert wrong[:20].max() < 0.0036  # √3 · 0.2 N · half of 20 ms
    assert wrong[20:25].max() > 0.01
    assert wrong[25:].max() < 0.0036
