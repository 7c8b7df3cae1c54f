"""Plans of inspections: views, way and time beside the bound on views, greed, and the nearest-view tour.

    python benchmarks/inspection_plans.py [--target intelsat30 ...] [--share 0.99 ...] [--objective time ...] [--json]

Stand-off 1.5 m, range 10 m (ISS 20 m), cone 60 degrees, incidence 60 degrees, turn 1 degree a second. `share` is of the
area that is proved to be seeable. `seconds` is of the plan alone; `seconds_seeable` of what comes once a target.
"""

import argparse
import dataclasses
import json
import time

import numpy as np

from keepout.geometry.target import Target
from keepout.inspecting.planning import plan
from keepout.inspecting.problem import Problem
from keepout.inspecting.tour import Objective
from keepout.mission.scenario import Scenario
from keepout.seeing.seeable import Verdict

FAR = {"iss": 20.0}
"""Camera ranges, m, of targets that need more than 10 m."""


def scenario_of(source: str) -> Scenario:
    """Give a scenario that starts 8 m off the target's box."""
    target = Target.load(source)
    start = 0.5 * (target.vertices.min(axis=0) + target.vertices.max(axis=0))
    start[1] = target.vertices[:, 1].max() + 8.0
    return Scenario.parse(
        {
            "duration": 20_000.0,
            "target": {"source": source},
            "start": {"position": start.tolist()},
            "camera": {"greatest_range": FAR.get(source, 10.0)},
        }
    )


def asked(scenario: Scenario, **inspect: object) -> Scenario:
    """Give a scenario with other entries of `inspect`."""
    return scenario.model_copy(update={"inspect": scenario.inspect.model_copy(update=inspect)})


def row(problem: Problem, scenario: Scenario, share: float) -> dict[str, object]:
    """Plan once and give the figures."""
    problem = dataclasses.replace(problem, scenario=scenario)
    wanted = problem.seeable.verdict == Verdict.SEEABLE
    began = time.perf_counter()
    found = plan(problem, position=np.array(scenario.start.position), time=0.0, wanted=wanted, share=share)
    seconds = time.perf_counter() - began
    areas = problem.patches.unit_areas()
    promised = np.unique(np.concatenate([np.zeros(0, int), *(view.units for view in found.views)]))
    return {
        "target": problem.target.name,
        "tour": scenario.inspect.tour,
        "objective": scenario.inspect.objective,
        "share": share,
        "coverage_of_seeable": float(areas[found.covered].sum() / areas[wanted].sum()),
        "coverage_by_views_alone": float(areas[promised].sum() / areas[wanted].sum()),
        "views": len(found.views),
        "views_at_least": found.fewest_views,
        "views_greedy": found.greedy_views,
        "candidates": found.candidates,
        "way_m": found.way_length,
        "duration_s": found.duration,
        "seconds": seconds,
    }


def rows(source: str, shares: list[float], objectives: list[Objective]) -> list[dict[str, object]]:
    """Give all rows of one target."""
    scenario = scenario_of(source)
    began = time.perf_counter()
    problem = Problem.of(scenario, Target.load(source))
    once = {
        "units": int(problem.patches.counted.sum()),
        "seeable": problem.seeable.lower,
        "coverage_upper_bound": problem.seeable.upper,
        "seconds_seeable": time.perf_counter() - began,
    }
    result = []
    for share in shares:
        for objective in objectives:
            result.append(row(problem, asked(scenario, objective=objective), share) | once)
        result.append(row(problem, asked(scenario, tour="nearest"), share) | once)
    return result


def main() -> None:
    """Print the rows as they come."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--target", nargs="+", default=["intelsat30", "tiangong", "iss"], help="built-ins or mesh files"
    )
    parser.add_argument("--share", nargs="+", type=float, default=[0.99, 1.0])
    parser.add_argument("--objective", nargs="+", default=["time"], choices=["time", "delta_v", "both"])
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    for source in given.target:
        for one in rows(source, given.share, given.objective):
            if given.json:
                print(json.dumps(one), flush=True)
                continue
            told = {key: round(value, 4) if isinstance(value, float) else value for key, value in one.items()}
            print("  ".join(f"{key} {value}" for key, value in told.items()), flush=True)


if __name__ == "__main__":
    main()
