"""Compiled programs on disk: whose folder, which folder, and when not at all."""

import os
import stat
import sys
import time
from pathlib import Path

import jax
import pytest

from keepout.core.compiled import kept_programs
from keepout.core.compiled.kept_programs import VARIABLE, KeptProgramsWarning, keep_programs

pytestmark = [
    pytest.mark.as_used,
    pytest.mark.skipif(not hasattr(os, "getuid"), reason="no owners and modes of files here"),
]

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


def again() -> Path | None:
    """What another start of the process would take."""
    jax.config.update("jax_compilation_cache_dir", None)
    keep_programs.cache_clear()
    return keep_programs()


def refused(said: str) -> None:
    with pytest.warns(KeptProgramsWarning) as told:
        assert again() is None
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


def test_a_folder_that_jax_was_given_is_left(private, tmp_path):
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "mine"))
    assert keep_programs() is None
    assert jax.config.jax_compilation_cache_dir == str(tmp_path / "mine")
    assert not list(private.iterdir())


def test_a_folder_that_is_not_of_the_user_alone_is_refused(private, tmp_path, monkeypatch):
    folder = keep_programs()
    assert folder is not None
    for path, mode in ((private, 0o710), (folder, 0o777)):
        path.chmod(mode)
        refused(f"{path}: is open to others (mode {mode:04o}")
        path.chmod(0o700)
    (tmp_path / "link").symlink_to(private)
    (tmp_path / "file").write_text("")
    for name in ("link", "file"):
        monkeypatch.setenv(VARIABLE, str(tmp_path / name))
        refused(f"{tmp_path / name}: is no folder")
    monkeypatch.setenv(VARIABLE, str(private))
    (folder / "jit_f-0-cache").symlink_to(tmp_path / "file")
    refused("belongs to another user, or is a link")
    (folder / "jit_f-0-cache").unlink()
    mine = os.getuid()
    monkeypatch.setattr(os, "getuid", lambda: mine + 1)
    refused("belongs to another user")


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


def test_processor_compiler_and_flags_have_folders_of_their_own(private, monkeypatch):
    folders = set()

    def another():
        folders.add(again())
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
    assert again() == folder
    assert [entry.exists() for entry in entries] == [True, True, False, False]
    assert mine.exists(), "what is no kept program is not touched"
