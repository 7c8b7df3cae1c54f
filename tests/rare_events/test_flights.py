"""Flights by their tapes: what the numbers stand for, the clearance, and `keepout rare` from end to end."""

import csv
import json
import math
import os
import signal
import subprocess
import sys
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from truths.command_line import keepout_command

from keepout.errors import ScenarioError
from keepout.flight import loop
from keepout.flight.record import FlightRecord
from keepout.mission.assumptions import broken_assumptions
from keepout.mission.build import prepare
from keepout.mission.scenario import Scenario
from keepout.rare_events.event import rare
from keepout.rare_events.flights import TapedFlights
from keepout.rare_events.tape import Tape

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
RANDOM = {"kind": "random", "amplitude": 0.02}
SPREAD = {"start_position_std": 0.05, "start_velocity_std": 0.001}


@pytest.fixture(scope="module")
def flown():
    return TapedFlights(prepare(NEAR.replace(faults=ALL, disturbance=RANDOM, rare=SPREAD)), workers=2)


def made_of(flown, tapes):
    """Setups and starts of tapes, with a leading axis."""
    return eqx.filter_jit(eqx.filter_vmap(lambda z: flown.tape.flown(flown.mission.setup, z)))(jnp.asarray(tapes))


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
def test_a_tape_draws_the_random_disturbances_phases_whatever_phase_is_added(flown):
    """A phase that is uniform over a turn stays so: the tape is the same, and what it draws."""
    moved = NEAR.replace(faults=ALL, disturbance=RANDOM | {"phase": 1.0}, rare=SPREAD)
    tape = Tape.of(moved)
    assert tape.layout == flown.tape.layout
    numbers = jnp.asarray(np.random.default_rng(0).standard_normal(tape.numbers))
    old, _ = flown.tape.flown(flown.mission.setup, numbers)
    new, _ = tape.flown(prepare(moved).setup, numbers)
    for name in ("frequency", "phase"):
        waves = (getattr(setup.disturbance.sinusoids, name) for setup in (old, new))
        np.testing.assert_array_equal(*waves)


@pytest.mark.long
def test_bounded_noise_stays_in_its_ball():
    scenario = NEAR.replace(faults={"position_noise": 0.02})
    tape = Tape.of(scenario)
    setup = prepare(scenario).setup
    tapes = jnp.asarray(np.random.default_rng(1).standard_normal((100, tape.numbers)))
    parts = eqx.filter_jit(eqx.filter_vmap(lambda z: tape.flown(setup, z)[0].faults))(tapes).parts
    length = np.linalg.norm(parts[0].position, axis=-1).ravel()
    assert length.max() <= 0.02
    assert stats.kstest((length / 0.02) ** 3, stats.uniform.cdf).pvalue > 1e-3


@pytest.mark.long
def test_a_tape_without_errors_is_the_flight_without_faults():
    # In the middle of each normal no command is lost and the thrusters are right.
    scenario = NEAR.replace(faults={"dropped": 0.2, "gain_error": 0.1, "position_noise_std": 0.1})
    taped = TapedFlights(prepare(scenario), workers=1)
    clean = prepare(NEAR)
    log = loop.fly(clean.setup, clean.initial, clean.steps, jax.random.key(0))
    flight = taped.fly(np.zeros(taped.tape.numbers))
    assert np.allclose(flight.record.position, log.position, atol=1e-9)
    assert np.allclose(flight.record.force, log.force, atol=1e-9)


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


@pytest.mark.long
def test_a_rare_event_from_end_to_end_goes_on_after_a_kill(tmp_path):
    scenario = tmp_path / "near.toml"
    scenario.write_text(
        'name = "near"\nduration = 40.0\nstart.position = [8.0, 1.5, 1.2]\ngoal.position = [8.0, -1.5, 1.2]\n'
        'guard.enabled = false\ncontrol.guidance = "straight"\n'
        "faults = {position_noise_std = 0.05, velocity_noise_std = 0.02, noise_correlation_time = 10.0}\n"
    )
    command = ["rare", str(scenario), "--below", "0.3", "--flights", "64", "--json"]
    program = [sys.executable, "-m", "keepout.cli", *command]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    killed, whole = tmp_path / "killed", tmp_path / "whole"
    with subprocess.Popen([*program, "-o", str(killed)], env=environment, stdout=subprocess.DEVNULL) as process:
        while not list(killed.glob("state-*.npz")) and process.poll() is None:
            time.sleep(0.02)
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
    assert not (killed / "summary.json").exists()
    answers = []
    for out in (killed, whole):
        answers.append(keepout_command(*command, "-o", out).json)
        assert json.loads((out / "summary.json").read_text()) == answers[-1]
    same = [{k: v for k, v in a.items() if k not in ("seconds", "worst_flight", "worst_tape")} for a in answers]
    assert same[0] == same[1]
    summary = answers[1]
    assert summary["grade"] == "measured"
    low, high = summary["interval"]
    assert low < summary["probability"] < high
    assert summary["probability"] == pytest.approx(np.mean(summary["runs"]))
    assert "not proved" in summary["said"]
    with (whole / "levels.csv").open() as file:
        levels = list(csv.DictReader(file))
    assert len(levels) == summary["levels"]
    assert [float(level["threshold_m"]) for level in levels[1:]] == summary["thresholds_m"]
    assert (whole / "curve.png").stat().st_size > 10_000
    assert "nearest" in (whole / "index.html").read_text()
    record = FlightRecord.load(whole / "near-worst.parquet")
    tape = np.load(whole / "near-worst-tape.npy")
    again = TapedFlights(prepare(Scenario.load(scenario))).fly(tape)
    assert np.array_equal(again.record.position, record.position)
    assert again.audit.minimum_clearance == summary["least_clearance_m"] < 0.3


def test_a_scenario_without_anything_random_has_no_tape():
    with pytest.raises(ScenarioError, match="nothing in it is random"):
        Tape.of(NEAR)


def test_a_law_with_draws_of_its_own_has_no_tape():
    with pytest.raises(ScenarioError, match=r'faults\.law: "random" draws'):
        Tape.of(NEAR.replace(faults={"law": "random"}))


@pytest.mark.long
def test_what_the_theorem_excludes_is_not_measured():
    covered = NEAR.replace(guard={"enabled": True, "position_error": 0.02}, faults={"position_noise": 0.02})
    with pytest.raises(ScenarioError, match="theorem covers this scenario"):
        rare(covered)


def test_gaussian_noise_is_beyond_the_assumptions():
    guarded = NEAR.replace(guard={"enabled": True, "position_error": 1.0})
    assert broken_assumptions(guarded) == ()
    [broken] = broken_assumptions(guarded.replace(faults={"position_noise_std": 0.01}))
    assert broken == "faults.position_noise_std 0.01 m > 0 (Gaussian noise has no bound)"


def test_a_correlation_time_without_noise_is_refused():
    with pytest.raises(ScenarioError, match="noise_correlation_time needs"):
        NEAR.replace(faults={"noise_correlation_time": 5.0})
