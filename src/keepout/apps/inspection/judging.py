"""What was flown put together: audited on the mesh, and each frame judged by where the camera truly was."""

import time
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool

from keepout.apps.inspection.frames import Camera, Shot, as_flown
from keepout.apps.inspection.inspection import Inspection
from keepout.apps.inspection.limits import LimitsKept, limits_kept
from keepout.apps.inspection.plan import InspectionPlan
from keepout.apps.inspection.problem import Problem
from keepout.apps.inspection.safe_speeds import DriftsFlown
from keepout.apps.inspection.transfer import Transfer
from keepout.core.flight.loop import FlightLog
from keepout.core.flight.record import FlightRecord
from keepout.core.flight.setup import FlightSetup
from keepout.core.guard.guard import Guard
from keepout.core.mission.flight import recorded
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings, broken_assumptions, guard_numbers
from keepout.core.progress import Progress, part_of, silent


def judged(
    scenario: Scenario,
    problem: Problem,
    setup: FlightSetup,
    log: FlightLog,
    shots: Sequence[Shot],
    camera: Camera,
    *,
    guard: Guard | None,
    certified: bool | None,
    possible: Bool[np.ndarray, " units"],
    plan: InspectionPlan,
    plans: int,
    ending: tuple[str, str],
    began: float,
    drifts: DriftsFlown | None = None,
    transfer: Transfer | None = None,
    progress: Progress = silent,
) -> Inspection:
    """Audit a flight on the mesh, and say what each of its frames truly showed.

    Args:
        scenario: as flown.
        problem: what was to be seen.
        setup: of the flight.
        log: of the whole flight.
        shots: frames as the camera was told to take them.
        camera: what it sees.
        guard: that it was flown with, or None.
        certified: whether the guard's theorem holds from the start; None without a guard.
        possible: (2 n,) what is not proved hidden and is lit at some time.
        plan: the first one.
        plans: how many were made.
        ending: how it ended, and why in words.
        began: when the computation began, s by `time.perf_counter`.
        drifts: what became of its legs by passive safety; None where that is not asked for.
        transfer: onto a circumnavigation, before the flight; None of any other.
        progress: called as the work goes on.

    """
    progress(0.0, "audit")
    bounds = Surroundings(scenario).flight_bounds
    flown, record, verdict = recorded(scenario, problem.target, setup, log, bounds)
    frames, seen = as_flown(record, shots, camera, progress=part_of(progress, 0.3, 1.0))
    broken = broken_assumptions(scenario, problem.target)
    return Inspection(
        scenario=scenario,
        target=problem.target,
        patches=problem.patches,
        rules=problem.rules,
        seeable=problem.seeable,
        possible=possible,
        plan=plan,
        plans=plans,
        record=record,
        flown=flown,
        audit=verdict,
        frames=frames,
        seen=seen,
        outcome=ending[0],
        why=ending[1],
        seconds=time.perf_counter() - began,
        start_certified=None if certified is None else certified and not broken,
        assumptions_broken=broken,
        guard=None if guard is None else guard_numbers(guard, scenario),
        limits=_limits_kept(scenario, problem, record),
        drifts=drifts,
        transfer=transfer,
    )


def _limits_kept(scenario: Scenario, problem: Problem, record: FlightRecord) -> LimitsKept | None:
    entry = scenario.inspect
    if not (entry.hold_points or entry.no_thrust_towards or entry.passive_safety):
        return None
    ticks = round(scenario.camera.period / scenario.control.period)
    return limits_kept(scenario, record, problem.target.distance.distance, every=ticks)
