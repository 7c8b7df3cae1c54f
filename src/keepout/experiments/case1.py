"""The paper's Case 1 (section VI.C.1) without and with circulation, and the recommended law on the same mission."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from keepout.mission.build import load_target
from keepout.mission.flight import fly
from keepout.mission.scenario import Scenario
from keepout.progress import Progress, silent
from keepout.report.folder import make_folder, write_flights, write_summary

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
    make_folder(out)
    scenarios = case1_scenarios(seed)
    target = load_target(next(iter(scenarios.values())).target)
    target.distance.distance(np.zeros((1, 3)))  # built and compiled once, before the laws share it
    done = dict.fromkeys(scenarios, 0.0)

    def reporter(law: str) -> Progress:
        def report(fraction: float, message: str) -> None:
            done[law] = fraction
            progress(sum(done.values()) / (len(done) + 1), f"{law} {message}")

        return report

    # Most of a single flight is compilation, which keeps one core busy: the laws are prepared side by side.
    with ThreadPoolExecutor(max_workers=2) as pool:
        flying = {
            law: pool.submit(fly, scenario, target=target, progress=reporter(law))
            for law, scenario in scenarios.items()
        }
        flights = {law: flight.result() for law, flight in flying.items()}
    progress(len(scenarios) / (len(scenarios) + 1), "figures")
    summaries = write_flights(
        out, flights, title="Case 1 of the paper, under three control laws", introduction=INTRODUCTION
    )
    write_summary(out, summaries)
    progress(1.0, "")
    return summaries
