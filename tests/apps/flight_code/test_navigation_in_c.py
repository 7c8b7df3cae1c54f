"""Suites of sensors in the exported C: what is refused, and that filter, set and guard know what Python's know."""

import dataclasses
import os
import shutil
import subprocess
import tomllib
from pathlib import Path

import flight_code_navigation as navigation
import numpy as np
import pytest
from compiled_step import CompiledStep
from flight_code_missions import Exported
from flight_code_states import FLIGHTS, compared
from truths import boxes

from keepout.apps.flight_code.folder import write_flight_code
from keepout.apps.flight_code.missions import MOST_KEPT, coded
from keepout.core.errors import ExchangeError
from keepout.core.mission.build import prepare
from keepout.core.mission.scenario import Scenario
from keepout.flights.navigation.known_set import SetMembership

pytestmark = pytest.mark.long
compiler = pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc here")
ALIKE = f"""
target.source = "box"
field.source = "{boxes.LEARNED.as_posix()}"
duration = 40.0
chaser = {{mass = 30.0, force_limit = 1.0}}
"""
SUITES = {
    "close": {"navigation": {"suite": "close", "dropout": 0.05, "most_missed": 2}, "guard": {"delay": 1}},
    "near": {"navigation": {"suite": "near"}},
    "far": {
        "navigation": {"suite": "far"},
        "guard": {"enabled": False},
        "attitude": {"kind": "inertial"},
        "control": {"observer": "constant"},
    },
}


# One suite in each run of the tests, with a guard and a delay; the others hold the same of their sensors.
@pytest.fixture(
    scope="module", params=["close", *(pytest.param(name, marks=pytest.mark.slow) for name in ("near", "far"))]
)
def flown(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Exported:
    mission = prepare(Scenario.of(tomllib.loads(ALIKE)).replace(**SUITES[request.param]))
    folder = tmp_path_factory.mktemp("navigation") / "flight"
    write_flight_code(mission, folder)
    made = coded(mission)
    return Exported(request.param, made, folder, CompiledStep(made, folder))


@compiler
@pytest.mark.slow
def test_steps_and_samples_on_thresholds_are_pythons(flown: Exported):
    flights = navigation.SampledFlights(flown.made)
    found = compared(flown, flights, 60 * FLIGHTS, keep=6)
    assert found.differ == 0
    assert found.force < 1e-10
    assert found.memory < 1e-9, f"{found.memory:.1e} in {found.worst}"
    left_out = [np.asarray(row.after[3].estimator.settled.left_out) for row in found.kept]
    assert np.max(left_out) > 5  # P was widened
    assert any(row.known is not None and row.known["contradicted"].any() for row in found.kept)
    edges = navigation.compared(flown, flights, found.kept, 2000)
    assert edges.crossed > 100
    assert edges.beside == 0
    assert edges.known < 1e-8  # the radius of two balls that just touch is the root of what cancels
    assert edges.memory < 1e-8, f"{edges.memory:.1e} in {edges.worst}"


@pytest.mark.slow
@compiler
def test_whole_flights_end_where_pythons_end(flown: Exported):
    assert navigation.sampled_loops(flown, navigation.SampledFlights(flown.made), 60) < 1e-9


@compiler
def test_it_compiles_silently_and_its_self_test_holds_filter_and_set(flown: Exported):
    apart = {name: value for name, value in os.environ.items() if name not in ("MAKEFLAGS", "MFLAGS", "MAKELEVEL")}
    built = subprocess.run(["make", "all", "check"], cwd=flown.folder, capture_output=True, text=True, env=apart)
    assert built.returncode == 0, built.stdout + built.stderr
    assert "warning" not in built.stderr
    assert " 0 numbers that Python gives otherwise" in built.stdout
    trial = subprocess.run(["./fly_mission", "tables.bin", "5"], cwd=flown.folder, capture_output=True, text=True)
    assert len(trial.stdout.splitlines()) == 7
    for tool, example in (("gcc", "cfs_app.c"), ("g++", "fprime_component.cpp")):
        if shutil.which(tool) is not None:
            subprocess.run([tool, "-fsyntax-only", "-I.", f"examples/{example}"], cwd=flown.folder, check=True)
    # A filter that believes every sample answers otherwise.
    source = flown.folder / "keepout_navigation.c"
    text = source.read_text(encoding="utf-8")
    source.write_text(text.replace("use = finite && (square <= sensor->gate);", "use = finite;"), encoding="utf-8")
    built = subprocess.run(["make", "check"], cwd=flown.folder, capture_output=True, text=True, env=apart)
    source.write_text(text, encoding="utf-8")
    assert built.returncode != 0


def test_the_set_allows_for_the_force_that_the_guard_allows_for(flown: Exported):
    guard, suite = flown.made.mission.guard, flown.made.mission.setup.navigation
    assert suite is not None
    assert isinstance(suite.bounded, SetMembership)
    if guard is None:
        assert flown.name == "far"
        return
    a = guard.assumptions
    assert float(suite.bounded.disturbance) == float(a.disturbance + a.fault_push)
    assert float(a.force_error) >= flown.made.rounding.force > 0.0


@pytest.mark.parametrize("estimate", ["observer", "raw"])
def test_other_estimates_are_refused_by_name(estimate: str, tmp_path: Path):
    scenario = Scenario().replace(navigation={"suite": "close", "estimate": estimate})
    with pytest.raises(ExchangeError, match=f'navigation.estimate is "{estimate}"'):
        write_flight_code(scenario, tmp_path / "flight")
    assert not (tmp_path / "flight").exists()


def test_forces_held_in_inertial_axes_are_refused_with_a_suite(tmp_path: Path):
    scenario = Scenario().replace(navigation={"suite": "close"}, thrusters={"held_in": "inertial"})
    with pytest.raises(ExchangeError, match=r"thrusters\.held_in"):
        write_flight_code(scenario, tmp_path / "flight")


def test_a_set_that_looks_back_too_far_is_refused_with_its_length(flown: Exported, tmp_path: Path):
    mission = flown.made.mission
    suite = mission.setup.navigation
    assert suite is not None
    assert isinstance(suite.bounded, SetMembership)
    bounded = dataclasses.replace(suite.bounded, window=MOST_KEPT + 1)
    setup = dataclasses.replace(mission.setup, navigation=dataclasses.replace(suite, bounded=bounded))
    with pytest.raises(ExchangeError, match=f"looks back over {MOST_KEPT + 1} control periods; {MOST_KEPT} fit"):
        write_flight_code(dataclasses.replace(mission, setup=setup), tmp_path / "flight")
    assert not (tmp_path / "flight").exists()
