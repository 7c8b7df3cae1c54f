"""Flights by their tapes: bounded noise, flights without errors, and what has no tape."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from keepout.core.errors import ScenarioError
from keepout.core.flight import loop
from keepout.core.mission.build import prepare
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import broken_assumptions
from keepout.flights.rare_events.event import Tape, TapedFlights

NEAR = Scenario().replace(
    name="near",
    duration=40.0,
    start={"position": (8.0, 1.5, 1.2)},
    goal={"position": (8.0, -1.5, 1.2)},
    guard={"enabled": False},
    control={"guidance": "straight"},
)
NOISY = NEAR.replace(
    faults={
        "dropped": 0.2,
        "gain_error": 0.1,
        "position_noise_std": 0.05,
        "velocity_noise_std": 0.02,
        "noise_correlation_time": 10.0,
    }
)


@pytest.mark.long
def test_bounded_noise_stays_in_its_ball():
    scenario = NEAR.replace(faults={"position_noise": 0.02})
    tape, setup = Tape.of(scenario), prepare(scenario).setup
    tapes = jnp.asarray(np.random.default_rng(1).standard_normal((100, tape.numbers)))
    parts = eqx.filter_jit(eqx.filter_vmap(lambda z: tape.flown(setup, z)[0].faults))(tapes).parts
    length = np.linalg.norm(parts[0].position, axis=-1).ravel()
    assert length.max() <= 0.02
    assert stats.kstest((length / 0.02) ** 3, stats.uniform.cdf).pvalue > 1e-3


@pytest.mark.slow  # faults at their middle are none: core/guard/test_faults
def test_a_tape_without_errors_is_the_flight_without_faults():
    # In the middle of each normal no command is lost and the thrusters are right.
    taped = TapedFlights(prepare(NOISY))
    clean = prepare(NEAR)
    log = loop.fly(clean.setup, clean.initial, clean.steps, jax.random.key(0))
    flight = taped.fly(np.zeros(taped.tape.numbers))
    assert np.allclose(flight.record.position, log.position, atol=1e-9)
    assert np.allclose(flight.record.force, log.force, atol=1e-9)


@pytest.mark.parametrize(
    ("changes", "said"),
    [({}, "nothing in it is random"), ({"faults": {"law": "random"}}, r'faults\.law: "random" draws')],
)
def test_what_is_not_random_or_draws_for_itself_has_no_tape(changes, said):
    with pytest.raises(ScenarioError, match=said):
        Tape.of(NEAR.replace(**changes))


def test_gaussian_noise_is_beyond_the_assumptions_and_correlation_without_noise_is_refused():
    guarded = NEAR.replace(guard={"enabled": True, "position_error": 1.0})
    assert broken_assumptions(guarded) == ()
    [broken] = broken_assumptions(guarded.replace(faults={"position_noise_std": 0.01}))
    assert broken == "faults.position_noise_std 0.01 m > 0 (Gaussian noise has no bound)"
    with pytest.raises(ScenarioError, match="noise_correlation_time needs"):
        NEAR.replace(faults={"noise_correlation_time": 5.0})
