"""Plans of inspections: views, way and time beside the bound on views, greed, and other tours; and full covers.

    python benchmarks/inspection_plans.py [PART ...] [--target intelsat30 ...] [--share 0.99 ...] [--places 4000]
        [--effort 10] [--out FILE] [--json]

Stand-off 1.5 m, range 10 m (ISS 20 m), cone 60 degrees, incidence 60 degrees, turn 1 degree a second.

Parts:
  plans       whole plans; `share` is of the area that is proved to be seeable, `seconds` of the plan alone. The bound
              on views is one on the short list that a plan is made from.
  full cover  the fewest views that see all that any candidate sees, by the camera's limits (`allowance` 0) and with a
              plan's room for a flight's errors (1). All candidates count. `seconds` is of the choice and its bound,
              until it is proved or --effort times the usual work is spent.

`seconds_seeable` is of what comes once a target. Rows are kept in the file as they come, and none is made twice.
"""

import dataclasses
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from kept_rows import Rows, command, tell
from nearest_views import nearest_views

from keepout.apps.inspection.cover import fewest_views
from keepout.apps.inspection.planning import candidates, plan
from keepout.apps.inspection.problem import Problem
from keepout.apps.inspection.seeing.seeable import Verdict
from keepout.apps.inspection.tour import Objective
from keepout.core.geometry.target import Target
from keepout.core.mission.scenario import Scenario

OUT = Path(__file__).with_name("results") / "inspection_plans.json"
PARTS = ("plans", "full cover")
PLACE = ("part", "target", "tour", "objective", "share", "allowance", "most_places")
SHOWN = (*PLACE, "coverage_of_seeable", "views", "views_at_least", "proved", "views_greedy", "candidates", "way_m")
SHOWN += ("duration_s", "seconds")
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


def planned(problem: Problem, place: dict[str, Any]) -> dict[str, Any]:
    """Plan once and give the figures."""
    scenario = problem.scenario
    objective = place["objective"] or scenario.inspect.objective
    scenario = asked(scenario, objective=objective, candidates=place["most_places"])
    problem = dataclasses.replace(problem, scenario=scenario)
    wanted = problem.seeable.verdict == Verdict.SEEABLE
    began = time.perf_counter()
    if place["tour"] == "nearest":
        found = nearest_views(problem, wanted, place["share"])
    else:
        found = plan(problem, position=np.array(scenario.start.position), time=0.0, wanted=wanted, share=place["share"])
    seconds = time.perf_counter() - began
    areas = problem.patches.unit_areas()
    promised = np.unique(np.concatenate([np.zeros(0, int), *(view.units for view in found.views)]))
    return {
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


def covered(problem: Problem, place: dict[str, Any], effort: float) -> dict[str, Any]:
    """Find the fewest of all candidates that see what all of them see, and the bound; `effort` is of the usual work."""
    problem = dataclasses.replace(problem, scenario=asked(problem.scenario, candidates=place["most_places"]))
    wanted = (problem.seeable.verdict == Verdict.SEEABLE) & problem.patches.counted
    areas = problem.patches.unit_areas() * wanted
    began = time.perf_counter()
    views, _ = candidates(problem, wanted, 0.0, within=None if place["allowance"] else problem.rules)
    seconds_candidates = time.perf_counter() - began
    seen = np.asarray(views.sees.sum(axis=0)).ravel() > 0.0
    began = time.perf_counter()
    cover = fewest_views(views.sees, areas, float(areas[seen].sum()), effort=effort)
    seconds = time.perf_counter() - began
    shown = np.asarray(views.sees[cover.chosen].sum(axis=0)).ravel() > 0.0
    return {
        "coverage_of_seeable": float(areas[shown].sum() / areas.sum()),
        "coverage_of_candidates": float(areas[shown].sum() / areas[seen].sum()),
        "views": len(cover.chosen),
        "views_at_least": cover.fewest,
        "proved": len(cover.chosen) == cover.fewest,
        "views_greedy": cover.greedy,
        "candidates": len(views.positions),
        "places": views.places,
        "seconds": seconds,
        "seconds_candidates": seconds_candidates,
    }


def places(parts: list[str], shares: list[float], objectives: list[Objective], most: int) -> list[dict[str, Any]]:
    """Give what says which row it is, but for the target."""
    none = dict.fromkeys(PLACE[2:]) | {"most_places": most}
    found = []
    for share in shares if "plans" in parts else []:
        plans = [("plan", objective) for objective in objectives] + [("nearest", None)]
        found += [
            none | {"part": "plans", "tour": tour, "objective": objective, "share": share} for tour, objective in plans
        ]
    if "full cover" in parts:
        found += [none | {"part": "full cover", "share": 1.0, "allowance": allowance} for allowance in (0, 1)]
    return found


def made(source: str, asked_for: list[dict[str, Any]], rows: Rows, effort: float) -> list[dict[str, Any]]:
    """Make the rows of one target that are not kept yet; give all that were asked for."""
    target, problem, once, shown = Target.load(source), None, {}, []
    for place in asked_for:
        place = place | {"target": target.name}
        row = rows.find(place)
        if row is None:
            if problem is None:
                began = time.perf_counter()
                problem = Problem.of(scenario_of(source), target)
                once = {
                    "units": int(problem.patches.counted.sum()),
                    "seeable": problem.seeable.lower,
                    "coverage_upper_bound": problem.seeable.upper,
                    "seconds_seeable": time.perf_counter() - began,
                }
            found = planned(problem, place) if place["part"] == "plans" else covered(problem, place, effort)
            row = place | found | once
            rows.keep(row)
            print(json.dumps({name: row[name] for name in SHOWN if name in row}), file=sys.stderr, flush=True)
        shown.append(row)
    return shown


def main() -> None:
    """Make what is asked for and print it."""
    parser = command(__doc__)
    parser.add_argument("parts", nargs="*", default=list(PARTS), help=f"of {', '.join(PARTS)}")
    parser.add_argument(
        "--target", nargs="+", default=["intelsat30", "tiangong", "iss"], help="built-ins or mesh files"
    )
    parser.add_argument("--share", nargs="+", type=float, default=[0.99, 1.0])
    parser.add_argument("--objective", nargs="+", default=["time"], choices=["time", "delta_v", "both"])
    parser.add_argument("--places", type=int, default=4000, help="drawn for candidates, at most")
    parser.add_argument("--effort", type=float, default=10.0, help="of the usual work, for a full cover and its proof")
    parser.add_argument("--out", type=Path, default=OUT, help="rows kept")
    given = parser.parse_args()
    for part in given.parts:
        if part not in PARTS:
            parser.error(f"no part {part!r}; it must be one of {', '.join(PARTS)}")
    rows, shown = Rows(given.out, PLACE, ()), []
    for source in given.target:
        shown += made(source, places(given.parts, given.share, given.objective, given.places), rows, given.effort)
    tell(shown, given, SHOWN)


if __name__ == "__main__":
    main()
