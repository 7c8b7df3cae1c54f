"""A simulation under way as a file, so that one that was stopped goes on from its last level, bit for bit."""

import hashlib
import io
import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from keepout.core.errors import ScenarioError
from keepout.core.whole_file import write_whole
from keepout.flights.rare_events.subset import Level, Simulation

_PARTS = ("seeds", "seed_values", "next_threshold", "next_probability", "lowest", "lowest_value")
_OF_LEVEL = ("values", "threshold", "probability", "acceptance", "step")


def digest(identity: Mapping[str, Any]) -> str:
    """Give a short name of everything that a simulation's bits depend on."""
    return hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()[:16]


def save(path: Path, simulation: Simulation) -> None:
    """Write a simulation to a file, whole or not at all."""
    arrays = {name: np.asarray(getattr(simulation, name)) for name in _PARTS}
    for name in _OF_LEVEL:
        arrays[f"level_{name}"] = np.stack([np.asarray(getattr(level, name)) for level in simulation.levels])
    stream = io.BytesIO()
    np.savez(stream, ended=np.asarray(simulation.ended), **arrays)  # pyright: ignore[reportArgumentType]
    write_whole(path, stream.getvalue(), refusal=ScenarioError)


def load(path: Path) -> Simulation:
    """Read a simulation.

    Raises:
        ScenarioError: the file cannot be read, or is not one of `save`.

    """
    try:
        with np.load(path, allow_pickle=False) as file:
            read = {name: file[name] for name in (*_PARTS, *(f"level_{name}" for name in _OF_LEVEL), "ended")}
    except (OSError, ValueError, KeyError, zipfile.BadZipFile, EOFError) as error:
        raise ScenarioError(
            f"{path}: not a simulation that can go on ({type(error).__name__}); remove it to begin anew"
        ) from None
    levels = tuple(
        Level(values, float(threshold), probability, float(acceptance), float(step))
        for values, threshold, probability, acceptance, step in zip(
            *(read[f"level_{name}"] for name in _OF_LEVEL), strict=True
        )
    )
    return Simulation(
        levels,
        read["seeds"],
        read["seed_values"],
        float(read["next_threshold"]),
        read["next_probability"],
        read["lowest"],
        float(read["lowest_value"]),
        str(read["ended"]),
    )
