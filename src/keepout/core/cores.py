"""The processor cores that this process may use."""

import os


def allowed_cores() -> tuple[int, ...]:
    """Give the cores that this process may run on, by number; none where the system does not say."""
    return tuple(sorted(os.sched_getaffinity(0))) if hasattr(os, "sched_getaffinity") else ()


def available_cores() -> int:
    """Count the cores that this process may use, at least 1."""
    return len(allowed_cores()) or os.cpu_count() or 1
