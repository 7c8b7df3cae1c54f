"""Settings shared by all tests."""

import atexit
import os
import shutil
import tempfile

# What one test compiles, the workers and the commands that tests start need not compile again. The folder is new for
# every run, so that nothing of an earlier version is taken for today's. Before JAX is imported, which reads it once.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    _compiled = tempfile.mkdtemp(prefix="keepout-compiled-")
    atexit.register(shutil.rmtree, _compiled, ignore_errors=True)
    os.environ |= {
        "JAX_COMPILATION_CACHE_DIR": _compiled,
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.3",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "0",
    }

from hypothesis import HealthCheck, settings
from truths import real_meshes

# A shared or slow machine must not fail a property: only its truth may.
settings.register_profile("keepout", deadline=None, suppress_health_check=[HealthCheck.too_slow], print_blob=True)
settings.load_profile("keepout")


def pytest_report_header() -> str:
    """Say once which real meshes the tests find; those that are absent make lists of cases shorter, nothing else."""
    absent = [mesh.name for mesh in real_meshes.REAL_MESHES if mesh not in real_meshes.present()]
    said = f"absent: {', '.join(absent)} (KEEPOUT_MESHES names their folder)" if absent else "all there"
    return f"real meshes in {real_meshes.FOLDER}: {said}"
