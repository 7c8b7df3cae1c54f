"""Settings shared by all tests."""

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
