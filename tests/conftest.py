"""Settings shared by all tests."""

from hypothesis import HealthCheck, settings

# A shared or slow machine must not fail a property: only its truth may.
settings.register_profile("keepout", deadline=None, suppress_health_check=[HealthCheck.too_slow], print_blob=True)
settings.load_profile("keepout")
