"""The exported C: what it refuses, and that compiled it answers as Python does, to rounding, statuses and all."""

import os
import re
import shutil
import struct
import subprocess
import tomllib
import zlib
from pathlib import Path

import compiled_step
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flight_code_states import with_parts
from truths import boxes, long_fields
from truths.command_line import keepout_command

import keepout
from keepout.apps.flight_code import rounding
from keepout.apps.flight_code.folder import sources, write_flight_code
from keepout.apps.flight_code.missions import Coded, coded
from keepout.core.errors import ExchangeError
from keepout.core.fields.field import values
from keepout.core.fields.grid import GridField
from keepout.core.fields.neural import NeuralField
from keepout.core.flight import loop
from keepout.core.mission.build import Mission, prepare
from keepout.core.mission.scenario import Scenario
from keepout.core.proof.bounds import ELEMENTARY, UNIT64

pytestmark = pytest.mark.long
compiler = pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc here")
MISSION = f"""
target.source = "box"
field.source = "{boxes.LEARNED.as_posix()}"
guard = {{delay = 1, position_error = 0.03, velocity_error = 0.002}}
"""


@pytest.fixture(scope="module")
def mission() -> Mission:
    return prepare(tomllib.loads(MISSION))


@pytest.fixture(scope="module")
def made(mission: Mission) -> Coded:
    return coded(mission)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write it by the command, as a user does."""
    base = tmp_path_factory.mktemp("flight_code")
    scenario, out = base / "mission.toml", base / "flight"
    scenario.write_text(MISSION, encoding="utf-8")
    summary = keepout_command("export", scenario, "--to", "c", "-o", out, "--json").json
    assert set(summary["files"]) == {path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()}
    assert "@" not in (out / "README.md").read_text(encoding="utf-8")
    return out


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"orbit": {"j2": True}}, "orbit.j2"),
        ({"drag": {"density": 1e-12}}, "drag"),
        ({"navigation": {"suite": "far", "estimate": "raw"}}, "navigation.estimate"),
        ({"control": {"observer": "printed"}}, "control.observer"),
        ({"control": {"circulation": "switching"}}, "control.circulation"),
        ({"control": {"profile": "paper"}}, "control.profile"),
        ({"faults": {"law": "bang-bang"}}, "faults.law"),
        ({"approach": {"abort": "drift"}}, "approach rules"),
        ({"thrusters": {"held_in": "inertial"}, "guard": {"delay": 1}}, "thrusters.held_in"),
    ],
)
def test_a_scenario_that_the_code_cannot_fly_is_refused_by_name(changes: dict, named: str, tmp_path: Path):
    out = tmp_path / "flight"
    with pytest.raises(ExchangeError, match=named):
        write_flight_code(Scenario().replace(**changes), out)
    assert not out.exists()


def test_parts_of_ones_own_are_refused_by_what_they_are(mission: Mission, tmp_path: Path):
    goal = mission.setup.controller.goal
    own = mission.with_law(keepout.PolicyLaw(goal, lambda away, velocity, time: -0.01 * away - 0.2 * velocity))
    with pytest.raises(ExchangeError, match="the law is a PolicyLaw"):
        write_flight_code(own, tmp_path / "flight")
    (tmp_path / "file").write_text("")
    with pytest.raises(ExchangeError, match="file"):
        write_flight_code(mission, tmp_path / "file")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_the_packed_field_differs_by_no_more_than_the_guard_is_told(mission: Mission, made: Coded):
    before, after = mission.guard, made.mission.guard
    assert before is not None
    assert after is not None
    assert after.evaluation_error == before.evaluation_error + made.packing_error + made.rounding.guard_field
    assert after.assumptions.force_error == before.assumptions.force_error + made.rounding.force
    assert 0.0 < made.packing_error < 5e-4
    radius = float(before.field.continuation.outer_radius)  # pyright: ignore[reportAttributeAccessIssue]
    places = np.random.default_rng(0).uniform(-radius, radius, (20_000, 3))
    apart = np.abs(values(after.field, places) - values(before.field, places))
    assert 0.1 * made.packing_error < apart.max() <= made.packing_error


@pytest.mark.slow  # builds the guard of a satellite
def test_the_tables_of_a_satellite_are_small(tmp_path: Path):
    assert write_flight_code(prepare(Scenario()), tmp_path / "flight")["tables_bytes"] < 3.5e6


@compiler
@pytest.mark.skipif(np.finfo(np.longdouble).nmant < 63, reason="no wider float here")
def test_double_loses_no_more_than_is_counted(made: Coded, folder: Path):
    code, guard, field = compiled_step.CompiledStep(made, folder), made.mission.guard, made.law.velocity.field
    assert guard is not None
    assert isinstance(guard.field, GridField)
    assert isinstance(field, NeuralField)
    rng, reach = np.random.default_rng(0), rounding.reach_of(guard)
    places = rng.normal(size=(400, 3))
    places *= (reach * rng.uniform(0.02, 1.0, (400, 1)) ** 2) / np.linalg.norm(places, axis=1)[:, None]
    by_guard, by_law = code.fields(places)
    lost = np.abs(by_guard - long_fields.spline(guard.field, places)).max()
    assert 1e-16 < lost <= rounding.of_spline(guard.field, reach) < made.rounding.guard_field < 1e-10
    lost = np.abs(by_law - long_fields.network(field, places)).max()
    assert 1e-16 < lost <= made.rounding.law_field < 1e-8
    assert 0.0 < made.rounding.force < 1e-10
    # The functions that these bounds are of: units of the result's last place, of the arc cosine of its largest.
    x = np.concatenate([rng.uniform(-60.0, 0.0, 3000), rng.uniform(1.0, 2.0, 3000), rng.uniform(0.0, 1.0, 3000)])
    named = {"exp": np.exp, "log": np.log, "acos": np.arccos}
    for part, (name, truth) in zip(np.split(x, 3), named.items(), strict=True):
        exact = truth(part.astype(np.longdouble))
        size = np.pi / 2 if name == "acos" else np.abs(exact)
        units = np.abs(code.function(name, part) - exact) / (UNIT64 * size)
        assert units.max() < (2.0 if name == "acos" else 1.0) * ELEMENTARY


@compiler
def test_it_compiles_silently_and_passes_its_self_test(folder: Path):
    # By itself, whatever `make` these tests are run by.
    apart = {name: value for name, value in os.environ.items() if name not in ("MAKEFLAGS", "MFLAGS", "MAKELEVEL")}
    built = subprocess.run(["make", "all", "check"], cwd=folder, capture_output=True, text=True, env=apart)
    assert built.returncode == 0, built.stdout + built.stderr
    assert "warning" not in built.stderr
    assert " 0 numbers that Python gives otherwise" in built.stdout
    flown = subprocess.run(["./fly_mission", "tables.bin", "5"], cwd=folder, capture_output=True, text=True)
    assert len(flown.stdout.splitlines()) == 7


@compiler
def test_a_build_that_rounds_otherwise_is_refused(folder: Path, tmp_path: Path):
    program = tmp_path / "selftest"
    files = [str(path) for path in sorted(folder.glob("keepout_*.c"))]
    files += [str(folder / name) for name in ("mission_tables.c", "selftest.c")]
    # Compiled as if sums could be taken in another order, which the header cannot see.
    flags = ["-O3", "-fassociative-math", "-fno-signed-zeros", "-fno-trapping-math"]
    subprocess.run(["gcc", "-std=c99", *flags, "-w", "-o", str(program), *files, "-lm"], check=True)
    answer = subprocess.run([str(program), str(folder / "tables.bin")], capture_output=True, text=True)
    assert answer.returncode == 1
    assert "rounds otherwise" in answer.stderr


@compiler
def test_an_image_that_is_damaged_is_refused(made: Coded, folder: Path):
    code = compiled_step.CompiledStep(made, folder, flags=("-std=c99", "-O0"))
    whole = (folder / "tables.bin").read_bytes()
    assert code.opened(whole) == 0
    for place, answer in ((0, 2), (8, 3), (12, 3), (30, 4), (20, 4), (-1, 4)):
        image = bytearray(whole)
        image[place] ^= 1
        assert code.opened(bytes(image)) == answer
    assert [code.opened(whole[:count]) for count in (0, 23, len(whole) - 1)] == [1, 1, 1]
    other = bytearray(whole)
    other[-1] ^= 1
    struct.pack_into("<I", other, 20, zlib.crc32(other[24:]))
    assert code.opened(bytes(other)) == 5


@pytest.mark.slow  # the self-test holds 64 steps against Python
@compiler
def test_steps_answer_as_python_does_whatever_is_told(made: Coded, folder: Path):
    code, setup, rng = compiled_step.CompiledStep(made, folder), made.mission.setup, np.random.default_rng(1)
    count = 64
    start = jax.tree.map(lambda a: jnp.broadcast_to(a, (count, *jnp.shape(a))), made.mission.initial)
    places = rng.normal(size=(count, 3))
    places *= rng.uniform(1.0, 14.0, (count, 1)) / np.linalg.norm(places, axis=1)[:, None]
    speeds = jnp.asarray(rng.normal(0, 0.03, (count, 3)))
    state = with_parts(start, position=jnp.asarray(places), velocity=speeds)
    memory = jax.jit(jax.vmap(lambda e: loop.memories(setup, e)))(state)

    @jax.jit
    @jax.vmap
    def step(memory, estimate, truth):
        law, guard, order, force, status = loop.command(setup, *memory, estimate)
        moved = setup.motion.step(truth, force, setup.disturbance, setup.period, setup.mass)
        return (law, guard), (force, order, status), moved

    sent = rng.uniform(-0.05, 0.05, (8, 3))
    begun = code.begin(compiled_step.estimates_of(state), sent)
    meant = jax.jit(jax.vmap(lambda e: loop.memories(setup, e, under_way=jnp.asarray(sent))))(state)
    told = compiled_step.memories_of(made, *meant)
    for part in told.dtype.names or ():
        for name in told[part].dtype.names:
            np.testing.assert_allclose(begun[part][name], told[part][name], rtol=1e-11, atol=1e-13)
    seen = set()
    for _ in range(240):  # a plan must come to rest for its place to be held
        told = compiled_step.memories_of(made, *memory)
        wrong = rng.uniform(-1.0, 1.0, (2, count, 3)) * np.array([0.02, 1e-3])[:, None, None]
        wrong[0] += rng.normal(0, 0.5, (count, 3)) * (rng.random((count, 1)) < 0.05)
        wrong[0, rng.random(count) < 0.03] = np.nan
        estimate = with_parts(state, position=state.position + wrong[0], velocity=state.velocity + wrong[1])
        far = jnp.asarray(10.0 ** rng.uniform(0, 250, (count, 1)) * (rng.random((count, 1)) < 0.03))
        estimate = with_parts(estimate, position=jnp.where(far > 0, far, estimate.position))
        order = code.step(told, compiled_step.estimates_of(estimate))
        memory, (force, answer, status), state = step(memory, estimate, state)
        np.testing.assert_array_equal(order["guard_status"], status)
        np.testing.assert_array_equal(order["control_status"], answer.status)
        np.testing.assert_allclose(order["force"], force, rtol=1e-10, atol=1e-13)
        np.testing.assert_allclose(order["barrier"], answer.barrier, rtol=1e-11, atol=1e-12)
        after = compiled_step.memories_of(made, *memory)
        for part in after.dtype.names or ():
            for name in after[part].dtype.names:
                np.testing.assert_allclose(told[part][name], after[part][name], rtol=1e-10, atol=1e-13)
        seen |= set(np.asarray(status).tolist())
    assert {status & 3 for status in seen} == {0, 1, 2, 3}
    assert len(seen) > 12


def test_sources_name_functions_that_there_are():
    """Each comment that names a Python file names one that is there."""
    root = Path(keepout.__file__).parent
    for name, content in sources().items():
        for path in re.findall(r"\b((?:core|control|guard|fields|flights|motion|apps)/[a-z_/]+\.py)", content.decode()):
            assert (root / path).is_file() or (root / "core" / path).is_file(), f"{name}: {path}"
