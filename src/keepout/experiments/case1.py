"""The paper's Case 1 (section VI.C.1) without and with circulation, and the recommended law on the same mission."""

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from keepout.experiments.part import Drawing, Part
from keepout.experiments.work import Work
from keepout.mission.build import load_target
from keepout.mission.flight import fly
from keepout.mission.scenario import Scenario
from keepout.progress import Progress
from keepout.report import flight_view, target_view

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


def case1_scenarios(seed: int) -> dict[str, Scenario]:
    """Give one scenario for each law; all else is equal."""
    base = Scenario().replace(seed=seed, duration=600.0)
    return {law: base.replace(name=law.replace(" ", "-"), **changes) for law, changes in LAWS.items()}


def case1(work: Work) -> Part:
    """Fly Case 1 under three laws."""
    scenarios = case1_scenarios(work.seed)
    target = load_target(next(iter(scenarios.values())).target)
    target.distance.distance(np.zeros((1, 3)))  # built and compiled once, before the laws share it
    done = dict.fromkeys(scenarios, 0.0)

    def reporter(law: str) -> Progress:
        def report(fraction: float, message: str) -> None:
            done[law] = fraction
            work.progress(sum(done.values()) / (len(done) + 1), f"{law} {message}")

        return report

    # Most of a single flight is compilation, which keeps one core busy: the laws are prepared side by side.
    with ThreadPoolExecutor(max_workers=2) as pool:
        flying = {
            law: pool.submit(fly, scenario, target=target, progress=reporter(law))
            for law, scenario in scenarios.items()
        }
        flights = {law: flight.result() for law, flight in flying.items()}
    rows = []
    for law, flight in flights.items():
        path = work.folder / f"{flight.scenario.name}.parquet"
        flight.record.save(path)
        rows.append({"name": law, **flight.summary(), "flight": str(path)})
    paths = {law: flight.record.position for law, flight in flights.items()}
    goal = next(iter(scenarios.values())).goal.position
    target_view.draw_paths(work.folder / "paths.png", target.vertices, target.faces, paths, goal)
    flight_view.draw_clearance(work.folder / "clearance.png", flights)
    return Part(
        name="case1",
        title="Case 1: local minimum",
        paper="Without the circulation inequality the chaser is trapped in a local minimum; with it, it arrives.",
        ours=["…"],
        rows=rows,
        drawings=[Drawing("paths", "Paths around the target"), Drawing("clearance", "Clearance and barrier over time")],
        flights=flights,
    )
