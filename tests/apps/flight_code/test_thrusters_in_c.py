"""Layouts of thrusters in the exported C: what is refused, and that pulses are those of Python."""

import dataclasses
import itertools
import os
import shutil
import subprocess
import tomllib
from pathlib import Path

import compiled_step
import flight_code_states as states
import flight_code_thrusters as forces
import numpy as np
import pytest
from flight_code_missions import MISSIONS, Exported
from truths import boxes

from keepout.apps.flight_code import rounding
from keepout.apps.flight_code.folder import write_flight_code
from keepout.apps.flight_code.mission_tables import digest_of, tables_text
from keepout.apps.flight_code.missions import MOST_POINTS, coded
from keepout.core.errors import ExchangeError
from keepout.core.mission.build import prepare
from keepout.core.mission.scenario import Scenario
from keepout.flights.thrusters.layout import Layout, force_box
from keepout.flights.thrusters.on_off import OnOffThrusters

pytestmark = pytest.mark.long
compiler = pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc here")
ALIKE = f"""
target.source = "box"
field.source = "{boxes.LEARNED.as_posix()}"
duration = 40.0
"""
PRESETS = {
    "12": {"thrusters": {"layout": "12", "least_on_time": 0.05}, "guard": {"enabled": False}},
    "24": {
        "thrusters": {"layout": "24", "modulation": "delta-sigma", "rise_delay": 0.004, "misalignment": 0.01},
        "guard": {"delay": 1, "position_error": 0.03, "velocity_error": 0.002},
    },
    "own": {"thrusters": MISSIONS["thrusters askew"]["thrusters"], "guard": {"enabled": False}},
}


# One layout in each run of the tests, without a guard, which takes longest; the others hold the same, and what is owed.
@pytest.fixture(scope="module", params=["12", *(pytest.param(name, marks=pytest.mark.slow) for name in ("24", "own"))])
def flown(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Exported:
    mission = prepare(Scenario.of(tomllib.loads(ALIKE)).replace(**PRESETS[request.param]))
    folder = tmp_path_factory.mktemp("thrusters") / "flight"
    summary = write_flight_code(mission, folder)
    made = coded(mission)
    assert summary["rounding_n"] == made.rounding.force
    return Exported(request.param, made, folder, compiled_step.CompiledStep(made, folder))


@pytest.mark.slow  # pulses of every kind of force, and the self-test, are below
@compiler
def test_steps_and_whole_flights_are_pythons_pulses_and_all(flown: Exported):
    flights = states.Flights(flown.made)
    found = states.compared(flown, flights, 40 * states.FLIGHTS)
    assert found.differ == 0
    assert found.beyond == 0, f"{found.force:.1e}, {found.memory:.1e} in {found.worst}"
    pulses = np.concatenate([row.given[states.GIVEN.index("on_time")] for row in found.kept])
    assert (pulses > 0.01).mean() > 0.05
    owed = np.concatenate([np.asarray(row.after[2].owed) for row in found.kept])
    assert np.any(owed) == flown.made.mission.setup.thrusters.delta_sigma  # pyright: ignore[reportAttributeAccessIssue]
    early, by_c, own = states.pulsed_loops(flown, flights, 120)
    assert early < 1e-10
    assert by_c < 30.0 * own


@compiler
def test_forces_of_every_kind_fire_what_python_fires(flown: Exported):
    found = forces.compared(flown, 3000)
    assert found.beside == 0
    assert found.on_it < 0.1 * found.forces
    assert found.given < 1e-12
    assert found.memory < 1e-12


@compiler
def test_its_self_test_holds_the_pulses(flown: Exported):
    apart = {name: value for name, value in os.environ.items() if name not in ("MAKEFLAGS", "MFLAGS", "MAKELEVEL")}
    built = subprocess.run(["make", "check"], cwd=flown.folder, capture_output=True, text=True, env=apart)
    assert built.returncode == 0, built.stdout + built.stderr
    assert "warning" not in built.stderr
    assert " 0 numbers that Python gives otherwise" in built.stdout
    # A step that owes nothing answers otherwise, if anything is owed.
    source = flown.folder / "keepout_thrusters.c"
    text = source.read_text(encoding="utf-8")
    source.write_text(text.replace("+ *owed;", ";"), encoding="utf-8")
    built = subprocess.run(["make", "check"], cwd=flown.folder, capture_output=True, text=True, env=apart)
    source.write_text(text, encoding="utf-8")
    assert (built.returncode != 0) == flown.made.mission.setup.thrusters.delta_sigma  # pyright: ignore[reportAttributeAccessIssue]


@compiler
def test_the_mean_force_is_the_one_asked_for_but_for_what_is_counted(flown: Exported):
    """Of pulses of any length: then only rounding is left."""
    thrusters = flown.made.mission.setup.thrusters
    assert isinstance(thrusters, OnOffThrusters)
    thrusters = dataclasses.replace(thrusters, least_on_time=0.0, rise_delay=0.0, delta_sigma=False)
    setup = dataclasses.replace(flown.made.mission.setup, thrusters=thrusters)
    made = flown.made._replace(mission=dataclasses.replace(flown.made.mission, setup=setup))
    folder = flown.folder.with_name("any-length")
    shutil.copytree(flown.folder, folder)
    digest = digest_of((folder / "tables.bin").read_bytes())
    (folder / "mission_tables.c").write_text(tables_text(made, digest), encoding="utf-8")
    code, limit = compiled_step.CompiledStep(made, folder), float(thrusters.force_limit.max())
    asked = np.random.default_rng(0).uniform(-limit, limit, (4000, 3))
    order = code.fire(np.zeros(len(asked), compiled_step.memory_type(made)), asked)
    counted = rounding.of_pulses(thrusters)
    given = order["pulse"] @ np.asarray(thrusters.push) / float(thrusters.period)
    lost = np.linalg.norm(given - asked, axis=1).max()
    assert 1e-17 < lost <= counted < 1e-5 * limit
    np.testing.assert_allclose(order["mean_force"], given, atol=counted)


def test_rounding_of_degenerate_layouts_is_bounded_too():
    corners = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    layout = Layout(-0.5 * corners, corners, np.full(8, 0.1))
    limit = force_box(layout)
    counted = rounding.of_pulses(OnOffThrusters.of(layout, force_limit=limit, period=1.0))
    assert 0.0 < counted < 1e-4 * limit


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"thrusters": {"layout": "24", "survive_failure": True}}, "thrusters.survive_failure"),
        ({"thrusters": {"layout": "12"}, "faults": {"thruster": 3}}, "faults.thruster"),
    ],
)
def test_thrusters_that_fail_are_refused_by_name(changes: dict, named: str, tmp_path: Path):
    with pytest.raises(ExchangeError, match=named):
        write_flight_code(Scenario().replace(**changes), tmp_path / "flight")
    assert not (tmp_path / "flight").exists()


def test_an_allocation_beyond_the_tables_is_refused_with_its_size(tmp_path: Path):
    ways = np.random.default_rng(0).normal(size=(13, 3))
    own = [{"position": tuple(-0.5 * way), "direction": tuple(way), "force": 0.5} for way in ways]
    scenario = Scenario.of(tomllib.loads(ALIKE)).replace(
        thrusters={"layout": "own", "own": own}, guard={"enabled": False}
    )
    with pytest.raises(ExchangeError, match=f"thrusters.own: its 13 directions have 286 points .*; {MOST_POINTS} fit"):
        write_flight_code(scenario, tmp_path / "flight")
    assert not (tmp_path / "flight").exists()
