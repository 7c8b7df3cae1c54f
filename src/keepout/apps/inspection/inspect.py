"""Inspect: see all of a target that can be seen, in light, without touching it."""

import dataclasses
import time
from pathlib import Path

from keepout.apps.inspection.circling import circle
from keepout.apps.inspection.frames import Camera
from keepout.apps.inspection.inspection import Inspection
from keepout.apps.inspection.leading import AroundMesh
from keepout.apps.inspection.light import ever_lit
from keepout.apps.inspection.plan import InspectionPlan
from keepout.apps.inspection.problem import (
    Problem,
    Wanted,
    require_inspectable,
    require_light,
    require_something_to_see,
    rules_of,
)
from keepout.apps.inspection.under_way import UnderWay
from keepout.apps.inspection.views_ahead import ViewsAhead
from keepout.core.compiled.kept_programs import keep_programs
from keepout.core.errors import InspectionError
from keepout.core.fields.model import FieldModel
from keepout.core.geometry.target import Target
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.target import load_target
from keepout.core.progress import Progress, part_of, silent

_OF_LIGHT = ("light", "epoch", "orbit", "attitude", "sun")
"""Entries that the light follows from."""


def inspect(
    scenario: Scenario | str | Path,
    *,
    target: Target | None = None,
    model: FieldModel | None = None,
    problem: Problem | None = None,
    first: InspectionPlan | None = None,
    progress: Progress = silent,
) -> Inspection:
    """Inspect a target: see all of it that can be seen, in light, without touching it.

    The plan is made from the mesh. On board a patch counts as taken by the state that the law is told; the coverage of
    the result is that of the true positions of the audited record.

    Args:
        scenario: or the path of its TOML file. Its entries `camera`, `light` and `inspect` beside those of any flight;
            `goal` does not count.
        target: the mesh, already loaded; else the scenario's.
        model: the field that the law flies by, already loaded; else the scenario's.
        problem: what is to be seen, already worked out for this target, camera and light, as for the flights of a
            campaign; else worked out here.
        first: the first plan, already made; else made here.
        progress: called as the work goes on.

    Raises:
        KeepoutError: something cannot be flown or seen; the message names the entry, and nothing has been flown.

    """
    scenario = Scenario.of(scenario)
    if scenario.inspect.tour == "circumnavigation":
        return _circled(scenario, target, problem, progress)
    return _under_way(scenario, target, model, problem, first, progress).flown(part_of(progress, 0.5, 1.0))


def _circled(scenario: Scenario, target: Target | None, problem: Problem | None, progress: Progress) -> Inspection:
    """Inspect by natural motion, which has neither plan nor way to be led along."""
    if target is None:
        target = load_target(scenario.target) if problem is None else problem.target
    if problem is None:
        problem = Problem.of(scenario, target, progress=part_of(progress, 0.0, 0.5))
    else:
        _require_of(problem, scenario, target)
    require_light(scenario, problem.light, problem.patches)
    return circle(dataclasses.replace(problem, scenario=scenario), progress=part_of(progress, 0.5, 1.0))


def _under_way(
    scenario: Scenario,
    target: Target | None,
    model: FieldModel | None,
    problem: Problem | None,
    first: InspectionPlan | None,
    progress: Progress,
) -> UnderWay:
    """Build all that is flown with, refuse what cannot be flown or seen, and make the first plan."""
    began = time.perf_counter()
    keep_programs()
    if target is None:
        target = load_target(scenario.target) if problem is None else problem.target
    if problem is not None:
        _require_of(problem, scenario, target)
    room = require_inspectable(scenario, target, room=None if problem is None else problem.room)
    leading = AroundMesh.of(scenario, target, model=model, progress=part_of(progress, 0.0, 0.1))
    if problem is None:
        problem = Problem.of(scenario, target, room=room, progress=part_of(progress, 0.1, 0.4))
    camera = Camera(problem.patches, problem.sight, problem.rules, problem.light)
    require_light(scenario, problem.light, problem.patches)
    lit = ever_lit(camera, problem.seeable.possible, scenario.duration)
    require_something_to_see(scenario, problem.seeable, lit)
    wanted = Wanted.of(problem.patches, lit, scenario.inspect.coverage)
    ahead = ViewsAhead.of(scenario, problem, leading, camera, wanted, first=first, progress=part_of(progress, 0.4, 0.5))
    return UnderWay(scenario, problem, leading, camera, ahead, began)


def _require_of(problem: Problem, scenario: Scenario, target: Target) -> None:
    """Refuse what was worked out for another target, camera, light or stand-off."""
    made = problem.light.scenario
    same = {
        "target": problem.target.sha256 == target.sha256,
        "camera or light": problem.rules == rules_of(scenario),
        "inspect.stand_off": problem.scenario.inspect.stand_off == scenario.inspect.stand_off,
        "light": all(getattr(made, name) == getattr(scenario, name) for name in _OF_LIGHT),
    }
    others = [name for name, is_same in same.items() if not is_same]
    if others:
        raise InspectionError(f"problem: worked out for another {', '.join(others)} than the scenario's")
