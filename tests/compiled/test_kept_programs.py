"""Compiled programs on disk: whose folder, which folder, when not at all, and the same numbers with and without."""

import json
import os
import stat
import subprocess
import sys
import time
import warnings
from pathlib import Path

import jax
import pytest

from keepout.compiled import kept_programs
from keepout.compiled.kept_programs import VARIABLE, KeptProgramsWarning, keep_programs

pytestmark = pytest.mark.skipif(not hasattr(os, "getuid"), reason="no owners and modes of files here")

JAX_SETTINGS = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")


@pytest.fixture(autouse=True)
def settings(monkeypatch):
    """A process as a user starts it: JAX was given no folder. The tests' own comes back afterwards."""
    before = {name: getattr(jax.config, name) for name in JAX_SETTINGS}
    jax.config.update("jax_compilation_cache_dir", None)
    monkeypatch.delenv(VARIABLE, raising=False)
    keep_programs.cache_clear()
    yield
    for name, value in before.items():
        jax.config.update(name, value)
    keep_programs.cache_clear()


@pytest.fixture
def private(tmp_path, monkeypatch) -> Path:
    """A private folder that the variable names."""
    folder = tmp_path / "private"
    folder.mkdir(0o700)
    monkeypatch.setenv(VARIABLE, str(folder))
    return folder


def refused(said: str) -> None:
    with pytest.warns(KeptProgramsWarning) as told:
        assert keep_programs() is None
    assert keep_programs() is None, "warned once"
    assert jax.config.jax_compilation_cache_dir is None
    assert len(told) == 1
    text = str(told[0].message)
    assert said in text
    assert VARIABLE in text
    assert "\n" not in text


def test_a_folder_of_the_user_alone_is_made_for_this_processor(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("HOME", str(tmp_path))
    old = os.umask(0)
    try:
        folder = keep_programs()
    finally:
        os.umask(old)
    assert folder is not None
    assert folder.is_relative_to(tmp_path)
    assert jax.config.jax_compilation_cache_dir == str(folder)
    for made in (folder, folder.parent, folder.parent.parent):
        assert stat.S_IMODE(made.stat().st_mode) == 0o700
    assert folder.name.startswith("programs-")


def test_nothing_is_kept_where_the_variable_says_off(monkeypatch, tmp_path):
    monkeypatch.setenv(VARIABLE, "off")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert keep_programs() is None
    assert jax.config.jax_compilation_cache_dir is None
    assert not list(tmp_path.iterdir())


def test_a_folder_that_jax_was_given_is_left(private, tmp_path):
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "mine"))
    assert keep_programs() is None
    assert jax.config.jax_compilation_cache_dir == str(tmp_path / "mine")
    assert not list(private.iterdir())


@pytest.mark.parametrize("mode", [0o755, 0o750, 0o770, 0o777, 0o701, 0o710])
def test_a_folder_open_to_others_is_refused(private, mode):
    private.chmod(mode)
    refused(f"{private}: is open to others (mode {mode:04o}")


def test_the_folder_of_the_processor_is_held_to_the_same(private):
    folder = keep_programs()
    assert folder is not None
    jax.config.update("jax_compilation_cache_dir", None)
    keep_programs.cache_clear()
    folder.chmod(0o777)
    refused(f"{folder}: is open to others")


def test_a_link_is_refused(private, tmp_path, monkeypatch):
    link = tmp_path / "link"
    link.symlink_to(private)
    monkeypatch.setenv(VARIABLE, str(link))
    refused(f"{link}: is no folder, or a link to one")


def test_a_file_is_refused(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv(VARIABLE, str(tmp_path / "file"))
    refused("is no folder")


def test_a_folder_of_another_user_is_refused(private, monkeypatch):
    mine = os.getuid()
    monkeypatch.setattr(os, "getuid", lambda: mine + 1)
    refused("belongs to another user")


def test_an_entry_of_another_user_is_refused(private, tmp_path):
    folder = keep_programs()
    assert folder is not None
    jax.config.update("jax_compilation_cache_dir", None)
    keep_programs.cache_clear()
    (tmp_path / "code").write_bytes(b"")
    (folder / "jit_f-0-cache").symlink_to(tmp_path / "code")
    refused("belongs to another user, or is a link")


def test_a_folder_that_others_could_replace_is_refused(tmp_path, monkeypatch):
    open_to_all = tmp_path / "open"
    (open_to_all / "private").mkdir(0o700, parents=True)
    monkeypatch.setenv(VARIABLE, str(open_to_all / "private"))
    true_stat = Path.stat

    def as_if_passable(path, **given):
        state = true_stat(path, **given)  # pytest's own folders are 0700, and below them nobody could do harm
        return os.stat_result((state.st_mode | 0o055, *state[1:])) if path in (tmp_path, *tmp_path.parents) else state

    monkeypatch.setattr(Path, "stat", as_if_passable)
    open_to_all.chmod(0o777)
    refused(f"{open_to_all}: may be written by others")
    keep_programs.cache_clear()
    open_to_all.chmod(0o1777)
    assert keep_programs() is not None, "with the sticky bit, as /tmp has it, nobody can"


@pytest.mark.skipif(hasattr(os, "getuid") and os.getuid() == 0, reason="nothing stops root from writing")
def test_a_folder_that_cannot_be_made_is_one_warning(tmp_path, monkeypatch):
    tmp_path.chmod(0o500)
    monkeypatch.setenv(VARIABLE, str(tmp_path / "below"))
    refused("Permission denied")


def test_processor_compiler_and_flags_have_folders_of_their_own(private, monkeypatch):
    folders = set()

    def another():
        jax.config.update("jax_compilation_cache_dir", None)
        keep_programs.cache_clear()
        folders.add(keep_programs())
        return len(folders)

    assert another() == 1
    assert another() == 1
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_max_isa=AVX2")
    assert another() == 2
    monkeypatch.setattr(kept_programs.jaxlib.version, "__version__", "0.0.1")
    assert another() == 3
    told = kept_programs._processors()
    monkeypatch.setattr(kept_programs, "_processors", lambda: (*told[:-1], told[-1] + " more"))
    assert another() == 4
    if hasattr(os, "sched_getaffinity"):
        monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(77)))
        assert another() == 5


@pytest.mark.skipif(sys.platform != "linux", reason="/proc/cpuinfo")
def test_the_processor_is_known_by_model_and_instruction_sets(monkeypatch):
    told = "\n".join(kept_programs._processors())
    text = Path("/proc/cpuinfo").read_text()
    known = "flags" if "flags" in text else "Features"
    sets = next(line for line in text.splitlines() if line.startswith(known))
    assert sets in told
    changing = "processor\t: 1\nmodel name\t: A\ncpu MHz\t\t: 3000.1\nflags\t\t: fpu avx2\nbogomips\t: 1.5\n"
    monkeypatch.setattr(kept_programs.Path, "read_text", lambda _: changing + changing.replace("3000.1", "2999"))
    assert kept_programs._processors() == ("flags\t\t: fpu avx2", "model name\t: A")


def test_what_was_not_used_for_long_goes(private, monkeypatch):
    folder = keep_programs()
    assert folder is not None
    other = private / "programs-of-another-processor"
    other.mkdir(0o700)
    now = time.time()
    entries = [folder / "a-cache", other / "b-cache", folder / "c-cache", folder / "d-cache"]
    for age, entry in enumerate(entries):
        entry.write_bytes(bytes(100))
        os.utime(entry, (now - 1000 * age, now - 1000 * age))
    mine = private / "mine-cache"
    mine.write_bytes(bytes(1000))
    monkeypatch.setattr(kept_programs, "MOST_BYTES", 250)
    jax.config.update("jax_compilation_cache_dir", None)
    keep_programs.cache_clear()
    assert keep_programs() == folder
    assert [entry.exists() for entry in entries] == [True, True, False, False]
    assert mine.exists(), "what is no kept program is not touched"


PROGRAM = """
import json, sys, jax, jax.numpy as jnp
from jax import monitoring
hits = []
monitoring.register_event_listener(lambda name, **_: hits.append(name))
import keepout
from keepout.compiled.kept_programs import keep_programs
before = jax.config.jax_compilation_cache_dir
folder = keep_programs()
value = jax.jit(lambda x: jnp.sin(jnp.cumsum(x)) @ jnp.exp(-x))(jnp.linspace(0.0, 1.0, 1000))
print(json.dumps([before, str(folder), float(value).hex(), hits.count("/jax/compilation_cache/cache_hits")]))
"""


def run(program: str, folder: str | Path, *arguments: str) -> tuple[list, str]:
    """Run a program in a process as a user starts it, and give what it printed."""
    own = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    command = [sys.executable, "-c", program, *arguments]
    done = subprocess.run(command, env=own | {VARIABLE: str(folder)}, capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1]), done.stderr


@pytest.mark.long
def test_a_second_process_takes_what_the_first_compiled_and_computes_the_same(tmp_path):
    kept = tmp_path / "kept"
    (before, first_folder, first, hits), _ = run(PROGRAM, kept)
    assert before is None, "importing Keepout sets nothing"
    assert hits == 0
    (_, second_folder, second, hits), said = run(PROGRAM, kept)
    assert hits > 0
    assert said == ""
    (_, none, without, hits), _ = run(PROGRAM, "off")
    assert hits == 0
    assert (first_folder, none) == (second_folder, "None")
    assert first == second == without


@pytest.mark.long
def test_a_damaged_program_is_compiled_anew(tmp_path):
    kept = tmp_path / "kept"
    (_, folder, first, _), _ = run(PROGRAM, kept)
    for entry in Path(folder).iterdir():
        entry.write_bytes(entry.read_bytes()[: entry.stat().st_size // 2])
    (_, _, second, hits), said = run(PROGRAM, kept)
    assert hits == 0
    assert first == second
    assert "Error reading persistent compilation cache entry" in said


FLIGHT = """
import json, hashlib, sys
import numpy as np
import keepout
from keepout.mission.campaign import run_campaign
scenario = keepout.Scenario.load("examples/case1.toml").replace(duration=60.0)
bare = scenario.replace(guard={"enabled": False}, control={"guidance": "straight"})
flight = keepout.fly(scenario if sys.argv[1] == "guarded" else bare)
flown = run_campaign(bare.replace(campaign={"runs": 3}))
whole = hashlib.sha256()
for name, column in sorted(vars(flight.record).items()):
    if isinstance(column, np.ndarray):
        whole.update(np.ascontiguousarray(column).tobytes())
for columns in (flown.columns(), flown.series.values):
    for name, column in sorted(columns.items()):
        whole.update(np.ascontiguousarray(column).tobytes())
print(json.dumps([flight.summary(), whole.hexdigest()]))
"""


@pytest.mark.long
@pytest.mark.parametrize("law", ["bare", pytest.param("guarded", marks=pytest.mark.slow)])
def test_a_flight_and_a_campaign_are_the_same_bits_with_and_without(tmp_path, law):
    kept = tmp_path / "kept"
    first, _ = run(FLIGHT, kept, law)
    again, said = run(FLIGHT, kept, law)
    without, _ = run(FLIGHT, "off", law)
    assert first == again == without
    assert "persistent compilation cache" not in said
    assert list(kept.glob("programs-*/code__flown-*"))
    assert list(kept.glob("programs-*/code__fly_batch-*"))
