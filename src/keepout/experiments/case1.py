"""The paper's Case 1 (section VI.C.1) without and with circulation, and the recommended law on the same mission."""

import json
from pathlib import Path
from typing import Any

from keepout.mission import Flight, fly, load_target
from keepout.progress import Progress, silent
from keepout.report.folder import write_flights
from keepout.scenario import Scenario

LAWS: dict[str, dict[str, Any]] = {
    "paper without circulation": {
        "control": {"profile": "paper", "circulation": "none"},
        "guard": {"enabled": False},
    },
    "paper with circulation": {
        "control": {"profile": "paper", "circulation": "printed"},
        "guard": {"enabled": False},
    },
    "default law": {"control": {"profile": "default"}, "guard": {"enabled": True}},
}

INTRODUCTION = (
    "Start [0, 10, 6] m, goal [0, −10, −4] m around the built-in communications satellite: 20 kg, 0.1 N per axis, "
    "0.1 m/s, one control step a second, the paper's disturbance. The first two flights use the constants printed in "
    "the paper, without and with its circulation inequality; the third uses Keepout's default law with the guard. "
    "Clearances are those of the chaser's ball to the exact mesh, bounded between samples."
)


def case1_scenarios(seed: int) -> dict[str, Scenario]:
    """Give one scenario for each law; all else is equal."""
    base = Scenario().replace(seed=seed, duration=600.0)
    return {law: base.replace(name=law.replace(" ", "-"), **changes) for law, changes in LAWS.items()}


def reproduce_case1(out: Path, *, seed: int = 0, progress: Progress = silent) -> list[dict[str, Any]]:
    """Fly Case 1 under three laws; write flights, figures, page and `summary.json` into `out`."""
    scenarios = case1_scenarios(seed)
    target = load_target(next(iter(scenarios.values())).target)
    flights: dict[str, Flight] = {}
    for place, (law, scenario) in enumerate(scenarios.items()):

        def part(fraction: float, message: str, place: int = place, law: str = law) -> None:
            progress((place + fraction) / (len(scenarios) + 1), f"{law} {message}")

        flights[law] = fly(scenario, target=target, progress=part)
    progress(len(scenarios) / (len(scenarios) + 1), "figures")
    summaries = write_flights(
        out, flights, title="Case 1 of the paper, under three control laws", introduction=INTRODUCTION
    )
    (out / "summary.json").write_text(json.dumps(summaries, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    progress(1.0, "")
    return summaries
