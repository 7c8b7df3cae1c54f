"""What a measurement was made on: a line for the tables that hold figures."""

import os
import platform
from pathlib import Path


def machine() -> str:
    """Name the processor, its number of cores, and the operating system."""
    cpus = Path("/proc/cpuinfo")
    lines = cpus.read_text(encoding="utf-8").splitlines() if cpus.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    name = names[0] if names else platform.processor() or platform.machine()
    return f"{name}, {os.cpu_count()} cores, {platform.system()}"
