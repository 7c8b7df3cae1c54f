"""Campaign folders written from numbers that a test chooses, without flying."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from keepout.core.kept import digest
from keepout.core.mission.scenario import Scenario
from keepout.flights.campaign import table
from keepout.flights.campaign.bands import Bands
from keepout.flights.campaign.plan import FORMAT

DISPERSIONS = {
    "chaser.mass": {"uniform": [18.0, 22.0]},
    "start.position": {"uniform": [[-15.0, -5.0, -4.0], [15.0, 5.0, -4.0]]},
    "disturbance.kind": {"choice": ["constant", "resonant", "rotating"]},
}


def scenario(runs: int, *, sampling: str = "random", seed: int = 0, dispersions: Mapping[str, Any] | None = None):
    """A scenario whose campaign varies a number, a vector and a choice."""
    given = DISPERSIONS if dispersions is None else dispersions
    return Scenario.parse({"seed": seed, "campaign": {"runs": runs, "sampling": sampling, "dispersions": given}})


def drawn(runs: int, seed: int = 0) -> dict[str, np.ndarray]:
    """What such a campaign may have drawn."""
    generator = np.random.default_rng(seed)
    return {
        "chaser.mass": generator.uniform(18.0, 22.0, runs),
        "disturbance.kind": generator.choice(["constant", "resonant", "rotating"], runs),
        "start.position.x": generator.uniform(-15.0, 15.0, runs),
        "start.position.y": generator.uniform(-5.0, 5.0, runs),
        "start.position.z": np.full(runs, -4.0),
    }


def flown(runs: int, **columns: Any) -> dict[str, np.ndarray]:
    """Flights that all reach the goal without contact, but for the columns given."""
    plain = {
        "status": "flown",
        "reason": "",
        "contact": "no",
        "reached": True,
        "minimum_clearance": 1.0,
        "delta_v": 2.0,
        "time_to_reach": 300.0,
        "final_error": 0.01,
        "guard_interventions": 0,
        "remarks": "",
    }
    return {name: np.broadcast_to(np.asarray(columns.get(name, value)), runs).copy() for name, value in plain.items()}


def write_campaign(
    folder: Path, of: Scenario, columns: Mapping[str, np.ndarray], *, chunk: int = 512, done: int | None = None
) -> Path:
    """Write a campaign's folder; figures of refused runs become null.

    Args:
        folder: to write.
        of: what was flown.
        columns: one entry a run.
        chunk: runs in a part.
        done: parts that are done; by default all.

    """
    runs = of.campaign.runs
    known = {
        "format": FORMAT,
        "scenario": json.loads(of.model_dump_json()),
        "batch": 128,
        "chunk": chunk,
        "versions": {"keepout": "0"},
    }
    (folder / "flights").mkdir(parents=True)
    (folder / "bands").mkdir()
    (folder / "campaign.json").write_text(json.dumps(known, indent=1))
    plan = digest(json.dumps(known, sort_keys=True))
    sketch = Bands.empty(of.duration, of.control.period).to_bytes()
    refused = np.asarray(columns["status"]) == "refused"
    figures = set(flown(1)) - {"status", "reason"}
    for number in range(-(-runs // chunk) if done is None else done):
        rows = slice(number * chunk, min((number + 1) * chunk, runs))
        made = {"run": pa.array(np.arange(runs)[rows])}
        for name, values in columns.items():
            made[name] = pa.array(values[rows], mask=refused[rows] if name in figures else None)
        marks = {"plan": plan, "chunk": str(number), "bands": digest(np.frombuffer(sketch, np.uint8))}
        (folder / "flights" / f"part-{number:05d}.parquet").write_bytes(table.to_bytes(pa.table(made), marks))
        (folder / "bands" / f"part-{number:05d}.npz").write_bytes(sketch)
    return folder
