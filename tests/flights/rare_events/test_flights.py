"""Flights by their tapes: what the numbers stand for, the clearance, and a rare event from end to end."""

import math

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
from keepout.flights.rare_events.event import Tape, TapedFlights, rare

NEAR = Scenario().replace(
    name="near",
    duration=40.0,
    start={"position": (8.0, 1.5, 1.2)},
    goal={"position": (8.0, -1.5, 1.2)},
    guard={"enabled": False},
    control={"guidance": "straight"},
)
ALL = {
    "position_bias": 0.01,
    "velocity_bias": 1e-4,
    "position_noise": 0.02,
    "velocity_noise": 2e-4,
    "position_noise_std": 0.03,
    "velocity_noise_std": 0.003,
    "noise_correlation_time": 5.0,
    "dropped": 0.2,
    "gain_error": 0.1,
    "delay": 1,
}
NOISY = NEAR.replace(
    faults={
        "dropped": 0.2,
        "gain_error": 0.1,
        "position_noise_std": 0.05,
        "velocity_noise_std": 0.02,
        "noise_correlation_time": 10.0,
    }
)
RANDOM = {"kind": "random", "amplitude": 0.02}
SPREAD = {"start_position_std": 0.05, "start_velocity_std": 0.001}


@pytest.fixture(scope="module")
def flown():
    return TapedFlights(prepare(NEAR.replace(faults=ALL, disturbance=RANDOM, rare=SPREAD)))


def made_of(flown, tapes):
    """Setups and starts of tapes, with a leading axis."""
    return eqx.filter_jit(eqx.filter_vmap(lambda z: flown.tape.flown(flown.mission.setup, z)))(jnp.asarray(tapes))


@pytest.mark.slow  # the laws of each fault are in core/guard/test_faults
@pytest.mark.long
def test_the_numbers_of_a_tape_have_the_laws_of_the_faults(flown):
    tapes = np.random.default_rng(0).standard_normal((1500, flown.tape.numbers))
    setup, start = made_of(flown, tapes)
    errors, losses, _, gain = setup.faults.parts
    assert errors.position.shape == (1500, 41, 3)
    # Of the whole error, bias in a sphere, noise in a ball, a Gauss–Markov process: the variances of an axis add up.
    for total, (bias, noise, std) in ((errors.position, (0.01, 0.02, 0.03)), (errors.velocity, (1e-4, 2e-4, 3e-3))):
        variance = bias**2 / 3 + noise**2 / 5 + std**2
        assert np.var(total) == pytest.approx(variance, rel=0.03)
        assert np.mean(total[:, 0] ** 2) == pytest.approx(variance, rel=0.1)
        lagged = np.mean(total[:, 5:] * total[:, :-5])
        assert lagged == pytest.approx(bias**2 / 3 + std**2 * math.exp(-1.0), rel=0.06)
    assert np.mean(losses.lost) == pytest.approx(0.2, abs=0.01)
    factor = np.asarray(gain.factor).ravel()
    assert stats.kstest(factor, stats.uniform(0.9, 0.2).cdf).pvalue > 1e-3
    waves = setup.disturbance.sinusoids
    assert stats.kstest(np.ravel(waves.frequency)[::7], stats.uniform(0.001, 0.299).cdf).pvalue > 1e-3
    assert stats.kstest(np.ravel(waves.phase)[::7], stats.uniform(0.0, 2 * np.pi).cdf).pvalue > 1e-3
    assert np.std(start.position - np.array([8.0, 1.5, 1.2])) == pytest.approx(0.05, rel=0.05)
    assert np.std(start.velocity) == pytest.approx(1e-3, rel=0.05)


@pytest.mark.long
def test_bounded_noise_stays_in_its_ball():
    scenario = NEAR.replace(faults={"position_noise": 0.02})
    tape, setup = Tape.of(scenario), prepare(scenario).setup
    tapes = jnp.asarray(np.random.default_rng(1).standard_normal((100, tape.numbers)))
    parts = eqx.filter_jit(eqx.filter_vmap(lambda z: tape.flown(setup, z)[0].faults))(tapes).parts
    length = np.linalg.norm(parts[0].position, axis=-1).ravel()
    assert length.max() <= 0.02
    assert stats.kstest((length / 0.02) ** 3, stats.uniform.cdf).pvalue > 1e-3


@pytest.mark.long
def test_a_tape_without_errors_is_the_flight_without_faults():
    # In the middle of each normal no command is lost and the thrusters are right.
    taped = TapedFlights(prepare(NOISY))
    clean = prepare(NEAR)
    log = loop.fly(clean.setup, clean.initial, clean.steps, jax.random.key(0))
    flight = taped.fly(np.zeros(taped.tape.numbers))
    assert np.allclose(flight.record.position, log.position, atol=1e-9)
    assert np.allclose(flight.record.force, log.force, atol=1e-9)


@pytest.mark.slow  # a flight alone and in a batch is the same in core/flight/test_batches
@pytest.mark.as_used
@pytest.mark.long
def test_the_clearance_is_the_audits_and_knows_no_company(flown):
    tapes = np.random.default_rng(2).standard_normal((140, flown.tape.numbers))
    clearance = flown.clearance(tapes)
    assert np.array_equal(flown.clearance(tapes[[130, 3]]), clearance[[130, 3]])
    assert np.std(clearance) > 1e-3
    for place in (3, 130):
        flight = flown.fly(tapes[place])
        assert flight.audit.minimum_clearance == pytest.approx(clearance[place], abs=1e-6)
        assert flight.clearance.min() + 1e-6 >= clearance[place]


@pytest.mark.slow  # test_subset.py goes on with a simulation
def test_a_rare_event_that_was_interrupted_goes_on_to_the_same_answer_and_gives_its_worst_flight_again(tmp_path):
    scenario = NOISY

    def interrupted(fraction, message):
        if list(tmp_path.glob("state-*.npz")):
            raise KeyboardInterrupt

    asked = {"below": 0.3, "flights": 64, "runs": 2}
    with pytest.raises(KeyboardInterrupt):
        rare(scenario, **asked, state=tmp_path, progress=interrupted)
    resumed, whole = rare(scenario, **asked, state=tmp_path), rare(scenario, **asked)
    answers = [found.summary() | {"seconds": None} for found in (resumed, whole)]
    assert answers[0] == answers[1]
    summary = answers[0]
    assert summary["grade"] == "measured"
    low, high = summary["interval"]
    assert low < summary["probability"] < high
    assert summary["probability"] == pytest.approx(np.mean(summary["runs"]))
    assert "not proved" in whole.said
    again = TapedFlights(prepare(scenario)).fly(resumed.worst_tape)
    assert np.array_equal(again.record.position, whole.worst.record.position)
    assert again.audit.minimum_clearance == summary["least_clearance_m"] < 0.3


@pytest.mark.parametrize(
    ("changes", "said"),
    [({}, "nothing in it is random"), ({"faults": {"law": "random"}}, r'faults\.law: "random" draws')],
)
def test_what_is_not_random_or_draws_for_itself_has_no_tape(changes, said):
    with pytest.raises(ScenarioError, match=said):
        Tape.of(NEAR.replace(**changes))


@pytest.mark.slow  # that nothing is beyond the assumptions is told below, and by tests/core/mission/test_assumptions.py
def test_what_the_theorem_excludes_is_not_measured():
    errors = {"guard": {"enabled": True, "position_error": 0.02}, "faults": {"position_noise": 0.02}}
    covered = NEAR.replace(target={"source": "box"}, field={"source": "grid"}, **errors)
    with pytest.raises(ScenarioError, match="theorem covers this scenario"):
        rare(covered)


def test_gaussian_noise_is_beyond_the_assumptions_and_correlation_without_noise_is_refused():
    guarded = NEAR.replace(guard={"enabled": True, "position_error": 1.0})
    assert broken_assumptions(guarded) == ()
    [broken] = broken_assumptions(guarded.replace(faults={"position_noise_std": 0.01}))
    assert broken == "faults.position_noise_std 0.01 m > 0 (Gaussian noise has no bound)"
    with pytest.raises(ScenarioError, match="noise_correlation_time needs"):
        NEAR.replace(faults={"noise_correlation_time": 5.0})
