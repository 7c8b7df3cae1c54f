"""Experiments: the source paper's cases and comparisons, each from scenario to result."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from keepout.errors import ScenarioError
from keepout.experiments.case1 import reproduce_case1
from keepout.progress import Progress, silent

EXPERIMENTS: dict[str, Callable[..., list[dict[str, Any]]]] = {"case1": reproduce_case1}


def run(name: str, out: Path, *, seed: int = 0, progress: Progress = silent) -> list[dict[str, Any]]:
    """Run one experiment into a folder and return a summary for each flight.

    Raises:
        ScenarioError: there is no experiment of this name.

    """
    if name not in EXPERIMENTS:
        raise ScenarioError(f"experiment: {name!r} is not known; valid: {', '.join(EXPERIMENTS)}")
    return EXPERIMENTS[name](out, seed=seed, progress=progress)
