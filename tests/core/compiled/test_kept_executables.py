"""Whole programs on disk: taken without tracing, with the same bits, and only where all they depend on is the same."""

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from keepout.core.compiled import kept_executables
from keepout.core.compiled.kept_executables import (
    _constants,
    _pickled,
    _sources,
    _UnknownError,
    kept_jit,
)
from keepout.core.compiled.kept_programs import VARIABLE, keep_programs
from keepout.core.control.profiles import Tuning
from keepout.core.fields import field
from keepout.core.fields.own import SphereField

pytestmark = [
    pytest.mark.as_used,
    pytest.mark.skipif(not hasattr(os, "getuid"), reason="no owners and modes of files here"),
]

POINTS = np.random.default_rng(0).normal(size=(5, 3))
SPHERE = SphereField(jnp.zeros(3), jnp.asarray(2.0))
TRUE = np.linalg.norm(POINTS, axis=1) - 2.0


def fresh(monkeypatch) -> None:
    """Forget in this process what was compiled or taken."""
    monkeypatch.setattr(field, "_value", kept_jit(field._value.__wrapped__))


def kept(folder: Path) -> set[str]:
    """Calls on the disk."""
    return {entry.name for entry in folder.glob("call_*")}


def traced(monkeypatch) -> list[str]:
    """Note every function that JAX traces from now on."""
    found: list[str] = []

    def heard(name, seconds, **told):
        if name.endswith("jaxpr_trace_duration"):
            found.append(told["fun_name"])

    jax.monitoring.register_event_duration_secs_listener(heard)
    return found


def test_a_kept_program_gives_the_same_bits_without_being_traced(folder, monkeypatch):
    fresh(monkeypatch)
    first = field.values(SPHERE, POINTS)
    np.testing.assert_allclose(first, TRUE, rtol=1e-12)
    assert len(kept(folder)) == 1
    fresh(monkeypatch)
    found = traced(monkeypatch)
    assert np.array_equal(field.values(SPHERE, POINTS), first)
    assert "kept__value" not in found
    keep_programs.cache_clear()
    fresh(monkeypatch)
    assert np.array_equal(field.values(SPHERE, POINTS), first), "and those of filter_jit"


@pytest.mark.long
def test_another_shape_type_or_number_is_another_call(folder, monkeypatch):
    sizes = set()
    for points in (jnp.zeros((4, 3)), jnp.zeros((5, 3)), jnp.zeros((5, 3), jnp.float32)):
        fresh(monkeypatch)
        field._value(SPHERE, points)
        sizes.add(len(kept(folder)))
    assert sizes == {1, 2, 3}
    with jax.default_matmul_precision("float32"):
        fresh(monkeypatch)
        field._value(SPHERE, jnp.zeros((4, 3)))
    assert len(kept(folder)) == 4


def test_a_process_has_so_many_programs_at_hand_and_lets_go_of_those_used_longest_ago(folder, monkeypatch):
    """A program takes hundreds of pieces of memory, of which a process may have 65,530."""
    monkeypatch.setattr(kept_executables, "_AT_HAND", 2)
    fresh(monkeypatch)
    for rows in (3, 4, 3, 5):
        field._value(SPHERE, jnp.zeros((rows, 3)))
    for entry in folder.iterdir():
        entry.unlink()
    for rows in (3, 5):
        field._value(SPHERE, jnp.zeros((rows, 3)))
    assert kept(folder) == set()
    assert np.array_equal(field._value(SPHERE, jnp.zeros((4, 3))), np.full(4, -2.0))
    assert len(kept(folder)) == 1


def test_numbers_at_the_top_of_modules_are_part_of_the_key(folder, monkeypatch):
    fresh(monkeypatch)
    field.values(SPHERE, POINTS)
    monkeypatch.setattr(field, "SOMETHING", 5, raising=False)
    fresh(monkeypatch)
    field.values(SPHERE, POINTS)
    assert len(kept(folder)) == 2


def test_nothing_is_kept_or_taken_where_a_function_of_keepout_was_replaced(folder, monkeypatch):
    points = jnp.zeros((7, 3))  # JAX itself, in one process, would not see it for a shape that it knows
    fresh(monkeypatch)
    field._value(SPHERE, points)
    before = kept(folder)
    monkeypatch.setattr(SphereField, "value", lambda self, points: jnp.full(points.shape[:-1], 7.0))
    with pytest.raises(_UnknownError):
        _constants()
    fresh(monkeypatch)
    np.testing.assert_array_equal(field._value(SPHERE, points), 7.0)
    assert kept(folder) == before


class Foreign(SphereField):
    """A field of somebody else, whose source no key tells."""


def test_what_is_not_of_keepout_is_not_kept(folder, monkeypatch):
    fresh(monkeypatch)
    foreign = Foreign(jnp.zeros(3), jnp.asarray(2.0))
    np.testing.assert_allclose(field.values(foreign, POINTS), TRUE, rtol=1e-12)
    assert kept(folder) == set()
    for mine in (Foreign, lambda: 1, traced):
        with pytest.raises(_UnknownError):
            _pickled(mine)
    assert _pickled((Tuning, np.dtype("f4"), "word", 1.5)) == _pickled((Tuning, np.dtype("f4"), "word", 1.5))

    def mine(x):
        return 2.0 * x

    assert kept_jit(mine)(jnp.ones(3)).tolist() == [2.0, 2.0, 2.0]
    assert kept(folder) == set()


def test_a_source_file_younger_than_the_process_stops_keeping(monkeypatch, tmp_path):
    shutil.copytree(kept_executables._PACKAGE, tmp_path / "keepout", ignore=shutil.ignore_patterns("data"))
    monkeypatch.setattr(kept_executables, "_PACKAGE", tmp_path / "keepout")
    told = _sources.__wrapped__()
    path = tmp_path / "keepout" / "core" / "flight" / "loop.py"
    old = path.stat().st_mtime
    path.write_text(path.read_text() + "\n# another\n")
    with pytest.raises(_UnknownError, match=r"loop\.py"):
        _sources.__wrapped__()
    os.utime(path, (old, old))
    assert _sources.__wrapped__() != told
    monkeypatch.setattr(kept_executables, "_PACKAGE", tmp_path / "nothing")
    with pytest.raises(_UnknownError):
        _sources.__wrapped__()


def out(x):
    """Call back into Python."""
    return jax.pure_callback(lambda y: 2.0 * np.asarray(y), jax.ShapeDtypeStruct((), x.dtype), x)


def test_a_program_that_calls_back_into_python_is_not_kept(folder, monkeypatch):
    monkeypatch.setattr(kept_executables, "_require_own", lambda value: None)
    assert float(kept_jit(out)(jnp.asarray(3.0))) == 6.0
    assert kept(folder) == set()


def run(program: str, folder: Path | str) -> tuple[list, str]:
    """Run a program in a process as a user starts it, and give what it printed."""
    own = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    done = subprocess.run(
        [sys.executable, "-c", program], env=own | {VARIABLE: str(folder)}, capture_output=True, text=True, check=True
    )
    return json.loads(done.stdout.splitlines()[-1]), done.stderr


VALUE = """
import json, sys, numpy as np, jax, jax.numpy as jnp
from jax import monitoring
traced, hits = [], []
monitoring.register_event_duration_secs_listener(
    lambda name, seconds, **told: traced.append(told["fun_name"]) if name.endswith("jaxpr_trace_duration") else None
)
monitoring.register_event_listener(lambda name, **_: hits.append(name.endswith("/cache_hits")))
from keepout.core.compiled.kept_programs import keep_programs
from keepout.core.fields import field
from keepout.core.fields.own import SphereField
before = jax.config.jax_compilation_cache_dir
keep_programs()
value = field.values(SphereField(jnp.zeros(3), jnp.asarray(2.0)), np.ones((1, 3)))[0]
other = jax.jit(lambda x: jnp.sin(jnp.cumsum(x)) @ jnp.exp(-x))(jnp.linspace(0.0, 1.0, 1000))
print(json.dumps([before, [float(value).hex(), float(other).hex()], "kept__value" in traced, any(hits)]))
"""


@pytest.mark.slow  # the tests above keep and take programs within a process
def test_from_one_process_to_the_next_programs_are_taken_and_lost_damaged_or_edited_ones_made_anew(
    tmp_path, monkeypatch
):
    source, kept_in = tmp_path / "source", tmp_path / "kept"
    shutil.copytree(kept_executables._PACKAGE, source / "keepout", ignore=shutil.ignore_patterns("data", "__pycache__"))
    past = time.time() - 100.0
    for path in source.rglob("*.py"):
        os.utime(path, (past, past))
    monkeypatch.setenv("PYTHONPATH", str(source))
    (before, first, _, hits), _ = run(VALUE, "off")
    assert before is None, "importing Keepout sets nothing"
    assert not hits
    assert float.fromhex(first[0]) == pytest.approx(np.sqrt(3.0) - 2.0)
    traced_and_taken = {"": (False, True), "call_*": (True, True), "jit*": (False, False), "*-cache": (True, False)}
    for lost in ("*-cache", "", "call_*", "", "jit*"):
        for path in kept_in.rglob(lost) if lost else ():
            path.unlink()
        (_, values, *told), said = run(VALUE, kept_in)
        assert values == first
        assert tuple(told) == traced_and_taken[lost], lost
        assert said == ""
    for path in kept_in.rglob("*-cache"):
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    (_, values, *_), said = run(VALUE, kept_in)
    assert values == first
    assert "damaged" in said
    assert "Error reading persistent compilation cache entry" in said
    path = source / "keepout" / "core" / "fields" / "own.py"
    text = path.read_text()
    line = next(line for line in text.splitlines() if "self.radius" in line and "return" in line)
    path.write_text(text.replace(line, line + " + 1.0"))
    os.utime(path, (past + 10.0, past + 10.0))
    (_, values, was_traced, _), _ = run(VALUE, kept_in)
    assert was_traced
    assert float.fromhex(values[0]) == pytest.approx(float.fromhex(first[0]) + 1.0)
