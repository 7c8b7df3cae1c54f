"""Settings shared by all tests."""

import atexit
import contextlib
import ctypes
import gc
import os
import shutil
import tempfile
from importlib.metadata import version
from pathlib import Path

# What one test compiles, the workers and the commands that tests start need not compile again. The folder is new for
# every run, so that nothing of an earlier version is taken for today's. Before JAX is imported, which reads it once.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    _compiled = tempfile.mkdtemp(prefix="keepout-compiled-")
    atexit.register(shutil.rmtree, _compiled, ignore_errors=True)
    os.environ |= {
        "JAX_COMPILATION_CACHE_DIR": _compiled,
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "0",
    }
# Likewise the fields that guards stand on, and what one worker builds for all.
if "KEEPOUT_CACHE" not in os.environ:
    os.environ["KEEPOUT_CACHE"] = tempfile.mkdtemp(prefix="keepout-kept-")
    atexit.register(shutil.rmtree, os.environ["KEEPOUT_CACHE"], ignore_errors=True)
if "KEEPOUT_TESTS_BUILT" not in os.environ:
    os.environ["KEEPOUT_TESTS_BUILT"] = tempfile.mkdtemp(prefix="keepout-built-")
    atexit.register(shutil.rmtree, os.environ["KEEPOUT_TESTS_BUILT"], ignore_errors=True)
# XLA takes long over programs that then run faster than most tests need. A run that sets XLA_FLAGS, be it to nothing,
# keeps its own: so `make test` runs what is marked `as_used`, and `make test-all` everything.
# Programs are small enough that making them simpler takes longer than running them as they are.
# A jaxlib from 0.11 on has no emitters to switch off, and ends a process that is told of a flag that it does not know.
if "XLA_FLAGS" not in os.environ:
    _emitters = "--xla_cpu_use_fusion_emitters=false " if version("jaxlib").startswith("0.10.") else ""
    os.environ["XLA_FLAGS"] = (
        f"{_emitters}--xla_backend_optimization_level=0 --xla_cpu_parallel_codegen_split_count=1 "
        "--xla_cpu_multi_thread_eigen=false --xla_disable_hlo_passes=simplification"
    )
    # As many workers as cores: threads of their libraries would only wait for each other.
    os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}

import equinox as eqx
import jax
import pytest
from hypothesis import HealthCheck, settings
from truths import real_meshes

# Tests hold hundreds of thousands of objects (programs, cases), and Python looks through them all for circles each time
# that a few hundred more were made: a seventh of the processor time. Looked for more seldom, memory grows no further.
gc.set_threshold(200_000, 20, 100)

# A shared or slow machine must not fail a property: only its truth may.
# The examples of a property are few and the same in every run, so that a commit which passes passes again;
# `make test-all` draws many, and new ones.
settings.register_profile(
    "random", deadline=None, suppress_health_check=[HealthCheck.too_slow], print_blob=True, max_examples=200
)
settings.register_profile("fixed", parent=settings.get_profile("random"), derandomize=True, max_examples=15)
settings.load_profile("fixed")

MOST_MEMORY = 2.3e9
"""A process that holds more (bytes) after a test forgets what it compiled: it stays on disk."""
GROWN = 0.4e9
"""... and does so again once it holds so much more (bytes) than was left."""


def held_memory() -> float:
    """Return the memory (bytes) that this process holds, 0 where the system does not say."""
    with contextlib.suppress(OSError):
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return 0.0


@pytest.fixture(autouse=True)
def _forgetful(_left=[0.0]):  # noqa: B006
    yield
    if held_memory() > max(MOST_MEMORY, _left[0] + GROWN):
        eqx.clear_caches()
        jax.clear_caches()
        gc.collect()
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL("libc.so.6").malloc_trim(0)
        _left[0] = held_memory()


@pytest.fixture(scope="session")
def box():
    """The built-in box of 4 x 3 x 2 m."""
    from keepout.core.geometry.target import Target

    return Target.load("box")


@pytest.fixture(scope="module")
def coarse_surfaces():
    """Level surfaces are cut and drawn with a quarter of the triangles that a page has: by all that a module shows."""
    from keepout.flights.pages import drawn

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(drawn, "_CELLS_ALONG", drawn._CELLS_ALONG // 2)
        yield


FIRST = (
    "test_commands.py",
    "test_inspect.py",
    "test_certificate.py",
    "test_campaign.py",
    "test_navigation.py",
    "test_by_map.py",
    "test_planning.py",
    "test_cone.py",
    "test_invariance.py",
    "test_relative.py",
    "test_on_board.py",
)
"""What a user runs first is tested first. The others take longest: no worker ends with one while another waits."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the files named in `FIRST` before all others."""
    items.sort(key=lambda item: FIRST.index(item.path.name) if item.path.name in FIRST else len(FIRST))


def pytest_report_header() -> str:
    """Say once which real meshes the tests find; those that are absent make lists of cases shorter, nothing else."""
    absent = [mesh.name for mesh in real_meshes.REAL_MESHES if mesh not in real_meshes.present()]
    said = f"absent: {', '.join(absent)} (KEEPOUT_MESHES names their folder)" if absent else "all there"
    return f"real meshes in {real_meshes.FOLDER}: {said}"
