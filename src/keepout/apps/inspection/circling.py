"""An inspection by natural-motion circumnavigation: a drift about the target, frames on the way, and nothing else.

The flight begins on the ellipse. What the burns onto it cost, from the scenario's start, counts in its Δv and is told
apart. The camera looks where most of what is still wanted is seen from; law and guard only bring the chaser back to the
drift.
"""

import time

import jax
import numpy as np
from jaxtyping import Bool, Float

from keepout.apps.inspection.circumnavigation import Circumnavigation, circumnavigations, transfer
from keepout.apps.inspection.frames import Camera, Shot
from keepout.apps.inspection.inspection import Inspection
from keepout.apps.inspection.light import ever_lit
from keepout.apps.inspection.plan import InspectionPlan
from keepout.apps.inspection.problem import Problem, boresight_of
from keepout.apps.inspection.seeing.visible import visible
from keepout.apps.led.driver import Ended, judged
from keepout.core.errors import InspectionError
from keepout.core.flight.loop import fly
from keepout.core.mission.build import build_guard, require_navigation
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.core.progress import Progress, part_of, silent
from keepout.flights.navigation.suites import navigation

_MOST_FRAMES = 1500
"""Frames of a circumnavigation, at most: those of a day would differ by millimetres."""
_TRIED = 60
"""Places along each ellipse by which the ellipses are compared."""


def circle(problem: Problem, *, progress: Progress = silent) -> Inspection:
    """Inspect a target by the ellipse that sees most of it.

    Args:
        problem: what there is to be seen. The flight begins on the ellipse, and lasts as long as the scenario; from its
            start the burns onto the ellipse are made.
        progress: called as the work goes on.

    Raises:
        InspectionError: no ellipse keeps the stand-off, or it is faster than the chaser may be.

    """
    begun, scenario, target = time.perf_counter(), problem.scenario, problem.target
    if scenario.inspect.hold_points:
        raise InspectionError(
            f"inspect.hold_points: {len(scenario.inspect.hold_points)}; a circumnavigation is held nowhere: leave them "
            'out, or give inspect.tour = "plan"'
        )
    possible = problem.seeable.possible
    camera = Camera(problem.sight, problem.rules, problem.light)
    lit = ever_lit(camera, possible, scenario.duration)
    ellipses = circumnavigations(scenario, target.distance.distance)
    progress(0.1, f"{len(ellipses)} ellipses")
    shares = []
    for done, ellipse in enumerate(ellipses):
        shares.append(_promised(problem, camera, ellipse, lit))
        progress(0.1 + 0.3 * (done + 1) / len(ellipses), f"an ellipse of height {ellipse.height:.1f} m")
    best = int(np.argmax([problem.patches.coverage(share) for share in shares]))
    ellipse = ellipses[best]
    fastest = float(np.linalg.norm(ellipse.velocity, axis=1).max())
    if fastest > scenario.chaser.speed_limit:
        raise InspectionError(
            f"circumnavigation: {fastest:.3g} m/s is needed on the ellipse; chaser.speed_limit "
            f"{scenario.chaser.speed_limit:g} m/s must be at least that"
        )
    onto = transfer(scenario, target.distance.distance, ellipse)
    scenario = _begun_on(scenario, ellipse)
    around = Surroundings(scenario, target)
    motion, suite = around.motion, scenario.navigation.suite
    require_navigation(scenario)
    guard = build_guard(around) if scenario.guard.enabled else None
    sensed = None if suite == "none" else navigation(scenario, motion, around.guard_assumptions)
    setup = around.setup(ellipse.law(scenario), guard=guard, navigation=sensed)
    initial = motion.initial_state(ellipse.position[0], ellipse.velocity[0])
    log = fly(setup, initial, scenario.steps, jax.random.key(scenario.seed))
    progress(0.6, "flown")
    time_flown, position = np.asarray(log.time), np.asarray(log.position)
    way = float(np.linalg.norm(np.diff(position, axis=0), axis=1).sum())
    certified = None if guard is None else bool(guard.certified_start(initial))
    why = (
        f"{ellipse.turns:.2f} turns on an ellipse {ellipse.height:.2f} m high and {ellipse.across:.2f} m across, "
        f"onto which two burns of {onto.first:.4f} and {onto.second:.4f} m/s lead from the start, "
        f"{onto.seconds:.0f} s apart" + ("" if onto.keeps_stand_off else ", not proved to keep the stand-off")
    )
    flown = judged(scenario, target, setup, log, certified)
    shots = _shots(problem, np.asarray(log.estimated_position), lit)
    plan = InspectionPlan((), shares[best], way, float(time_flown[-1]), len(ellipses), 0, 0)
    found, told = {"possible": lit, "plan": plan, "plans": 1, "transfer": onto}, part_of(progress, 0.7, 1.0)
    return Inspection.of(problem, flown, camera, shots, Ended("out of time", why), begun, progress=told, **found)


def _begun_on(scenario: Scenario, ellipse: Circumnavigation) -> Scenario:
    """Give the scenario with its start on the ellipse, and its goal there too: both bound how far the flight is."""
    start = {"position": tuple(ellipse.position[0].tolist()), "velocity": tuple(ellipse.velocity[0].tolist())}
    far = ellipse.position[int(np.argmax(np.linalg.norm(ellipse.position, axis=1)))]
    return scenario.replace(start=start, goal={"position": tuple(far.tolist())})


def _promised(
    problem: Problem, camera: Camera, ellipse: Circumnavigation, wanted: Bool[np.ndarray, " units"]
) -> Bool[np.ndarray, " units"]:
    """Say which units are visible from some places along an ellipse, in light, whichever way the camera looks."""
    seen = np.zeros_like(wanted)
    for index in np.unique(np.linspace(0, len(ellipse.times) - 1, _TRIED).astype(int)):
        units = visible(problem.sight, problem.rules, ellipse.position[index], among=wanted & ~seen).units
        if problem.light.matters:
            sun = camera.light.sun(float(ellipse.times[index]))
            units = units[:0] if sun is None else units[camera.lit(sun, units)]
        seen[units] = True
    return seen


def _shots(problem: Problem, estimated: Float[np.ndarray, "rows 3"], wanted: Bool[np.ndarray, " units"]) -> list[Shot]:
    """Turn the camera as on board: by the estimated positions, towards the middle of what is still to be seen."""
    scenario, target = problem.scenario, problem.target
    ticks = round(scenario.camera.period / scenario.control.period)
    every = ticks * max(1, -(-(len(estimated) - 1) // (ticks * _MOST_FRAMES)))
    boresight, left, shots = boresight_of(scenario, target), wanted.copy(), []
    areas, middle = problem.patches.unit_areas(), 0.5 * (target.vertices.min(axis=0) + target.vertices.max(axis=0))
    for row in range(0, len(estimated), every):
        place = estimated[row]
        shots.append(Shot(row, boresight.direction))
        shown = visible(problem.sight, problem.rules, place, among=left)
        if len(shown.units):
            off = np.arccos(np.clip(shown.directions @ boresight.direction, -1.0, 1.0)) + shown.spread
            left[shown.units[off <= problem.rules.half_angle]] = bool(problem.light.matters)
        towards = areas[shown.units] @ shown.directions
        aimed = towards if np.linalg.norm(towards) > 1e-9 else middle - place
        for _ in range(every):
            boresight = boresight.step(aimed, scenario.control.period)
    return shots
