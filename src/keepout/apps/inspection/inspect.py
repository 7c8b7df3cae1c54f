"""Inspect: see all of a target that can be seen, in light, without touching it.

By a plan of views the law leads from view to view, and what was lost is planned anew. By natural-motion
circumnavigation the chaser drifts about the target, with frames on the way and nothing else: the flight begins on the
ellipse; what the burns onto it cost, from the scenario's start, counts in its Δv and is told apart; the camera looks
where most of what is still wanted is seen from; law and guard only bring the chaser back to the drift.
"""

import dataclasses
import time

import jax
import numpy as np
from jaxtyping import Float

from keepout.apps.inspection.candidates import aim
from keepout.apps.inspection.circumnavigation import Circumnavigation, circumnavigations, transfer
from keepout.apps.inspection.frames import Shot
from keepout.apps.inspection.inspection import Inspection
from keepout.apps.inspection.leading import AroundMesh
from keepout.apps.inspection.light import ever_lit
from keepout.apps.inspection.plan import InspectionPlan
from keepout.apps.inspection.problem import (
    Problem,
    Wanted,
    boresight_of,
    require_inspectable,
    require_light,
    require_something_to_see,
    rules_of,
)
from keepout.apps.inspection.seeing.patches import Marks
from keepout.apps.inspection.seeing.visible import in_view, visible
from keepout.apps.inspection.views_ahead import ViewsAhead
from keepout.apps.inspection.ways import way_length
from keepout.apps.led.driver import Ended, Leader, LedFlight, judged, lead
from keepout.core.compiled.kept_programs import keep_programs
from keepout.core.errors import InspectionError
from keepout.core.fields.model import FieldModel
from keepout.core.flight.loop import fly
from keepout.core.flight.setup import FlightSetup
from keepout.core.geometry.distance import Point
from keepout.core.geometry.target import Target
from keepout.core.guard.safety_layer import mode
from keepout.core.mission.build import build_guard, require_navigation
from keepout.core.mission.scenario import Scenario, ScenarioLike
from keepout.core.mission.surroundings import Surroundings
from keepout.core.mission.target import load_target
from keepout.core.mission.zones import with_digests
from keepout.core.progress import Progress, part_of, silent
from keepout.flights.navigation.suites import navigation

_OF_LIGHT = ("light", "epoch", "orbit", "attitude", "sun")
"""Entries that the light follows from."""


def inspect(
    scenario: ScenarioLike,
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
        scenario: a `Scenario`, the path of its TOML file, or its tables as a dict. Its
            entries `camera`, `light` and `inspect` beside those of any flight; `goal` does not count.
        target: the mesh, already loaded; else the scenario's.
        model: the field that the law flies by, already loaded; else the scenario's.
        problem: what is to be seen, already worked out for this target, camera and light, as for the flights of a
            campaign; else worked out here.
        first: the first plan, already made; else made here.
        progress: called as the work goes on.

    Raises:
        KeepoutError: something cannot be flown or seen; the message names the entry, and nothing has been flown.

    """
    began = time.perf_counter()
    scenario = with_digests(Scenario.of(scenario))
    if target is None:
        target = load_target(scenario.target) if problem is None else problem.target
    if problem is not None:
        _require_of(problem, scenario, target)
    if scenario.inspect.tour == "circumnavigation":
        if problem is None:
            problem = Problem.of(scenario, target, progress=part_of(progress, 0.0, 0.5))
        require_light(scenario, problem.light, problem.patches)
        return circle(dataclasses.replace(problem, scenario=scenario), progress=part_of(progress, 0.5, 1.0))
    keep_programs()
    room = require_inspectable(scenario, target, room=None if problem is None else problem.room)
    leading = AroundMesh.of(scenario, target, model=model, progress=part_of(progress, 0.0, 0.1))
    if problem is None:
        problem = Problem.of(scenario, target, room=room, progress=part_of(progress, 0.1, 0.4))
    require_light(scenario, problem.light, problem.patches)
    lit = ever_lit(problem.camera, problem.seeable.possible, scenario.duration)
    require_something_to_see(scenario, problem.seeable, lit)
    wanted = Wanted(problem.patches, lit, scenario.inspect.coverage)
    ahead = ViewsAhead(scenario, problem, leading, wanted, first=first, progress=part_of(progress, 0.4, 0.5))
    if scenario.zone and not ahead.first.views:
        raise InspectionError(
            f"zone: {len(scenario.zone)}, and no way that keeps inspect.stand_off, {scenario.inspect.stand_off:g} m, "
            "from all of them leads from the start to a view of anything; smaller zones, or another start, would leave "
            "one"
        )
    return UnderWay(ahead, began).flown(part_of(progress, 0.5, 1.0))


def _require_of(problem: Problem, scenario: Scenario, target: Target) -> None:
    """Refuse what was worked out for another target, camera, light or stand-off."""
    made = problem.light.scenario
    same = {
        "target": problem.target.sha256 == target.sha256,
        "camera or light": problem.rules == rules_of(scenario),
        "inspect.stand_off": problem.scenario.inspect.stand_off == scenario.inspect.stand_off,
        "light": all(getattr(made, name) == getattr(scenario, name) for name in _OF_LIGHT),
        "zone": problem.scenario.zone == scenario.zone,
    }
    if scenario.zone:  # which may turn from step to step until the end
        same["duration"] = made.duration == scenario.duration
        same["control.period"] = made.control.period == scenario.control.period
    others = [name for name, is_same in same.items() if not is_same]
    if others:
        raise InspectionError(f"problem: worked out for another {', '.join(others)} than the scenario's")


class UnderWay(Leader):
    """An inspection from the first frame to the last: a frame is taken at a segment's last row.

    Args:
        ahead: the views to fly to, and what they are seen and flown to with.
        began: when the computation began, s by `time.perf_counter`.

    """

    fewest = 2

    def __init__(self, ahead: ViewsAhead, began: float) -> None:
        self.scenario, self.problem, self.leading = ahead.scenario, ahead.problem, ahead.leading
        self.ahead, self.began = ahead, began
        self.ticks = round(self.scenario.camera.period / self.scenario.control.period)
        self.estimate = np.asarray(self.scenario.start.position, dtype=float)
        self.boresight = boresight_of(self.scenario, self.problem.target)
        self.shots: list[Shot] = []
        self.over: Ended | None = None

    def flown(self, progress: Progress = silent) -> Inspection:
        """Fly until the end, and judge."""
        flight = LedFlight(self.scenario, self.leading.initial, self.ticks)
        ended = lead(self, flight, progress)
        assert flight.setup is not None
        progress(0.9, "audit")
        # The scenario as it was given: the one that leads has another goal and a wider margin.
        certified, ahead, target = self.leading.start_certified, self.ahead, self.problem.target
        flown, told = judged(self.scenario, target, flight.setup, flight.log(), certified), part_of(progress, 0.93, 1.0)
        found = {"possible": ahead.wanted.possible, "plan": ahead.first, "plans": ahead.plans, "drifts": ahead.drifts}
        found["field_sha256"] = self.leading.field_sha256
        return Inspection.of(self.problem, flown, self.shots, ended, self.began, progress=told, **found)

    def resting(self) -> FlightSetup:
        """Give what the chaser rests by: the law to where it is, or beside it."""
        start = np.asarray(self.scenario.start.position, dtype=float)
        place = self.leading.reachable(start)
        return self.leading.setup(self.leading.law(start if place is None else place, start))

    def look(self, flight: LedFlight) -> None:
        """Turn the camera over the rows flown last, and take its frame at the last of them."""
        if not flight.logs:
            return
        log, period, leg, wanted = flight.logs[-1], self.scenario.control.period, self.ahead.leg, self.ahead.wanted
        position = np.asarray(log.estimated_position)
        for row, estimate in enumerate(position, flight.rows - len(position)):
            self.estimate = estimate
            if row == flight.rows - 1:
                self.shots.append(Shot(row, self.boresight.direction))
                units = self.problem.camera.units(row * period, estimate, self.boresight.direction, wanted.left)
                wanted.take(units)
                if leg is not None:
                    leg.noted(row * period, estimate, self.boresight, self._aimed(), len(units))
            self.boresight = self.boresight.step(self._aimed(), period)
        if leg is not None:
            leg.held_up += int(np.count_nonzero(mode(log.guard_status)))

    def ended(self, flight: LedFlight) -> Ended | None:
        """Say how the flight is over: enough was seen, out of time, or nothing more to fly for."""
        scenario, wanted = self.scenario, self.ahead.wanted
        if self.over is None and wanted.enough and not self.ahead.holding:
            self.over = Ended(*wanted.ending)
        elif self.over is None and max(flight.rows - 1, 0) + self.ticks > scenario.steps:
            self.over = Ended("out of time", f"duration {scenario.duration:g} s is over")
        return self.over

    def onward(self, flight: LedFlight) -> FlightSetup | Ended | None:
        """Go on to the next view once that under way is done with."""
        now = max(flight.rows - 1, 0) * self.scenario.control.period
        if not self.ahead.is_over(now):
            return None
        law = self.ahead.next(now, self.estimate, self.boresight)
        if isinstance(law, Ended):
            self.over = law
            return law
        return self.leading.setup(law) if flight.setup is None else self.leading.led_on(flight.setup, law)

    def next_rows(self, flight: LedFlight) -> int:
        """Say how many rows there are to the next frame: the first, at the start, is a segment of its own."""
        return self.ticks if flight.logs else 1

    def told(self, flight: LedFlight) -> tuple[float, str]:
        """Give the share of time that is used up."""
        said = f"{self.ahead.wanted.reached:.1%} seen on board, {len(self.ahead.legs)} views ahead"
        return min(0.9 * flight.rows / self.scenario.steps, 0.9), said

    def _aimed(self) -> Point:
        """Give where the camera should look: at what is left of the view under way."""
        leg, patches = self.ahead.leg, self.problem.patches
        if leg is None or leg.boresight is None:
            vertices = self.problem.target.vertices
            return 0.5 * (vertices.min(axis=0) + vertices.max(axis=0)) - self.estimate
        left = leg.left(self.ahead.wanted)
        return aim(self.estimate, patches.corners_of(left), leg.boresight, self.problem.rules.half_angle)


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
    lit = ever_lit(problem.camera, problem.seeable.possible, scenario.duration)
    ellipses = circumnavigations(scenario, target.distance.distance)
    progress(0.1, f"{len(ellipses)} ellipses")
    shares = []
    for done, ellipse in enumerate(ellipses):
        shares.append(_promised(problem, ellipse, lit))
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
    motion = around.motion
    require_navigation(scenario)
    guard = build_guard(around) if scenario.guard.enabled else None
    sensed = navigation(scenario, motion, around.guard_assumptions)
    setup = around.setup(ellipse.law(scenario), guard=guard, navigation=sensed)
    initial = motion.initial_state(ellipse.position[0], ellipse.velocity[0])
    log = fly(setup, initial, scenario.steps, jax.random.key(scenario.seed))
    progress(0.6, "flown")
    certified = None if guard is None else bool(guard.certified_start(initial))
    why = (
        f"{ellipse.turns:.2f} turns on an ellipse {ellipse.height:.2f} m high and {ellipse.across:.2f} m across, "
        f"onto which two burns of {onto.first:.4f} and {onto.second:.4f} m/s lead from the start, "
        f"{onto.seconds:.0f} s apart" + ("" if onto.keeps_stand_off else ", not proved to keep the stand-off")
    )
    flown = judged(scenario, target, setup, log, certified)
    shots = _shots(problem, np.asarray(log.estimated_position), lit)
    way, lasts = way_length(np.asarray(log.position)), float(np.asarray(log.time)[-1])
    plan = InspectionPlan((), shares[best], way, lasts, len(ellipses), 0, 0)
    found, told = {"possible": lit, "plan": plan, "plans": 1, "transfer": onto}, part_of(progress, 0.7, 1.0)
    return Inspection.of(problem, flown, shots, Ended("out of time", why), begun, progress=told, **found)


def _begun_on(scenario: Scenario, ellipse: Circumnavigation) -> Scenario:
    """Give the scenario with its start on the ellipse, and its goal there too: both bound how far the flight is."""
    start = {"position": tuple(ellipse.position[0].tolist()), "velocity": tuple(ellipse.velocity[0].tolist())}
    far = ellipse.position[int(np.argmax(np.linalg.norm(ellipse.position, axis=1)))]
    return scenario.replace(start=start, goal={"position": tuple(far.tolist())})


def _promised(problem: Problem, ellipse: Circumnavigation, wanted: Marks) -> Marks:
    """Say which units are visible from some places along an ellipse, in light, whichever way the camera looks."""
    seen = np.zeros_like(wanted)
    for index in np.unique(np.linspace(0, len(ellipse.times) - 1, _TRIED).astype(int)):
        units = visible(problem.sight, problem.rules, ellipse.position[index], among=wanted & ~seen).units
        if problem.light.matters:
            sun = problem.light.sun(float(ellipse.times[index]))
            units = units[:0] if sun is None else units[problem.camera.lit(sun, units)]
        seen[units] = True
    return seen


def _shots(problem: Problem, estimated: Float[np.ndarray, "rows 3"], wanted: Marks) -> list[Shot]:
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
        left[shown.units[in_view(shown, boresight.direction, problem.rules.half_angle)]] = problem.light.matters
        towards = areas[shown.units] @ shown.directions
        aimed = towards if np.linalg.norm(towards) > 1e-9 else middle - place
        for _ in range(every):
            boresight = boresight.step(aimed, scenario.control.period)
    return shots
