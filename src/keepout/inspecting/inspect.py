"""Inspect: fly through the views of a plan, take what each frame shows, plan anew where views were lost, and judge."""

import dataclasses
import time
from collections import deque
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from keepout.audit.audit import audit
from keepout.compiled.kept_programs import keep_programs
from keepout.control.law import Law
from keepout.errors import ControlError, InspectionError
from keepout.fields.model import FieldModel
from keepout.flight import segment
from keepout.flight.loop import FlightLog
from keepout.flight.outcome import outcome
from keepout.flight.record import FlightRecord
from keepout.flight.setup import FlightSetup
from keepout.geometry.target import Target
from keepout.guard.safety_layer import mode
from keepout.inspecting.aiming import aim
from keepout.inspecting.circling import circle
from keepout.inspecting.equipment import (
    boresight_of,
    require_inspectable,
    require_light,
    require_something_to_see,
    rules_of,
)
from keepout.inspecting.frames import Camera, Shot, as_flown
from keepout.inspecting.inspection import Inspection
from keepout.inspecting.leading import Leading
from keepout.inspecting.leg import Leg, Lost
from keepout.inspecting.limits import LimitsKept, limits_kept
from keepout.inspecting.lit import ever_lit
from keepout.inspecting.plan import InspectionPlan
from keepout.inspecting.planning import plan
from keepout.inspecting.problem import Problem
from keepout.inspecting.safe_speeds import SafeSpeeds
from keepout.inspecting.wanted import Wanted
from keepout.mission import environment
from keepout.mission.assumptions import broken_assumptions, guard_numbers
from keepout.mission.scenario import Scenario
from keepout.mission.statuses import legend
from keepout.mission.target import load_target
from keepout.progress import Progress, part_of, silent
from keepout.seeing.seeable import Verdict

Point = Float[np.ndarray, "3"]

_OF_LIGHT = ("light", "epoch", "orbit", "attitude", "sun")
"""Entries that the light follows from."""
_WAITED = 0.1
"""Share of the time left for which the light is waited for where no view is in light, before a plan is made again."""
_REPLANS, _REPLANS_IN_SUN = 16, 48
"""Plans after the first, at most: each costs a tour that is mostly way. The sun asks for more."""
_LOST = 0.01
"""Share of what is possible that must be lost to the light before a plan is made again while views are left."""
_AGAIN = 15.0
"""Seconds for the choice of views in the sun when a plan is made again."""


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
    if not isinstance(scenario, Scenario):
        scenario = Scenario.load(scenario)
    if scenario.inspect.tour == "circumnavigation":
        return _circled(scenario, target, problem, progress)
    return _Inspector(scenario, target, model, problem, first, progress).flown(part_of(progress, 0.5, 1.0))


def _circled(scenario: Scenario, target: Target | None, problem: Problem | None, progress: Progress) -> Inspection:
    """Inspect by natural motion, which has neither plan nor way to be led along."""
    if target is None:
        target = load_target(scenario.target) if problem is None else problem.target
    if problem is None:
        problem = Problem.of(scenario, target, progress=part_of(progress, 0.0, 0.5))
    _require_of(problem, scenario, target)
    require_light(scenario, problem.light, problem.patches)
    return circle(dataclasses.replace(problem, scenario=scenario), progress=part_of(progress, 0.5, 1.0))


class _Inspector:
    """One inspection under way."""

    def __init__(
        self,
        scenario: Scenario,
        target: Target | None,
        model: FieldModel | None,
        problem: Problem | None,
        first: InspectionPlan | None,
        progress: Progress,
    ) -> None:
        self.began = time.perf_counter()
        keep_programs()
        self.scenario = scenario
        if target is None:
            target = load_target(scenario.target) if problem is None else problem.target
        self.target = target
        require_inspectable(scenario, target)
        self.leading = Leading.of(scenario, target, model=model, progress=part_of(progress, 0.0, 0.1))
        self.broken = broken_assumptions(scenario)
        if problem is None:
            problem = Problem.of(scenario, target, progress=part_of(progress, 0.1, 0.4))
        _require_of(problem, scenario, target)
        self.problem = problem
        self.camera = Camera(problem.patches, problem.sight, problem.rules, problem.light)
        possible = problem.seeable.verdict == Verdict.SEEABLE
        require_light(scenario, problem.light, problem.patches)
        self.lit = ever_lit(self.camera, possible, scenario.duration)
        require_something_to_see(scenario, problem.seeable, self.lit)
        self.wanted = Wanted.of(problem.patches, self.lit, scenario.inspect.coverage)
        self.estimate = np.asarray(scenario.start.position, dtype=float)
        self.boresight = boresight_of(scenario, target)
        self.safe_speeds = SafeSpeeds.of(problem, scenario)
        holds = scenario.inspect.hold_points
        begins = np.asarray(holds[-1].position, dtype=float) if holds else self.estimate
        self.first = self._planned(begins, 0.0, part_of(progress, 0.4, 0.5)) if first is None else first
        self.plans = 1
        self.legs: deque[Leg] = deque(
            [*Leg.holds(holds, scenario.goal.tolerance), *Leg.views(self.first, scenario.inspect.dwell)]
        )
        self.leg: Leg | None = None
        self.refused: list[str] = []
        self.taken_views = 0
        self.shots: list[Shot] = []
        self.logs: list[FlightLog] = []
        self.rows = 0
        self.ticks = round(scenario.camera.period / scenario.control.period)
        self.replan = False
        self.lost = np.zeros(problem.patches.units, dtype=bool)

    def flown(self, progress: Progress) -> Inspection:
        """Fly until the end, and judge."""
        scenario = self.scenario
        setup, state, ending = None, None, None
        while True:
            now = max(self.rows - 1, 0) * scenario.control.period
            ending = self._ending() if ending is None else ending
            if ending is None and (self.leg is None or self._is_over(now)):
                law = self._next(now)
                if isinstance(law, tuple):
                    ending = law
                else:
                    setup = self.leading.setup(law) if setup is None else self.leading.led_on(setup, law)
            # An audit needs a way: where nothing is to be flown, a frame's period is flown at rest.
            if ending is not None and self.rows > 1:
                break
            if setup is None:
                setup = self.leading.setup(self._resting())
            if state is None:
                state = segment.begin(setup, self.leading.initial, jax.random.key(scenario.seed))
            # A frame is taken at a segment's last row; the first, at the start, is a segment of its own.
            count = self.ticks if self.logs else 1
            state, log = segment.fly_segment(setup, state, count)
            self._look(log, count)
            progress(min(0.9 * self.rows / scenario.steps, 0.9), self._said())
        assert setup is not None
        return self._judged(segment.joined(self.logs), setup, ending, part_of(progress, 0.9, 1.0))

    def _said(self) -> str:
        return f"{self.wanted.reached:.1%} seen on board, {len(self.legs)} views ahead"

    def _middle(self) -> Point:
        return 0.5 * (self.target.vertices.min(axis=0) + self.target.vertices.max(axis=0))

    def _resting(self) -> Law:
        start = np.asarray(self.scenario.start.position, dtype=float)
        place = self.leading.reachable(start)
        return self.leading.law(start if place is None else place, start)

    def _planned(
        self, position: Point, now: float, progress: Progress = silent, *, again: bool = False
    ) -> InspectionPlan:
        return plan(
            self.problem,
            position=position,
            time=now,
            wanted=self.wanted.left,
            share=self.wanted.share_of_left,
            boresight=self.boresight.direction,
            seconds=_AGAIN if self._in_sun and again else None,
            progress=progress,
        )

    def _look(self, log: FlightLog, ticks: int) -> None:
        """Turn the camera over a segment, and take its frame at the last row: it is looked at a period later."""
        period = self.scenario.control.period
        position = np.asarray(log.estimated_position)
        for tick in range(ticks):
            self.estimate = position[tick]
            if tick == ticks - 1:
                row = self.rows + tick
                self.shots.append(Shot(row, self.boresight.direction))
                units = self.camera.units(row * period, self.estimate, self.boresight.direction, self.wanted.left)
                self.wanted.take(units)
                if self.leg is not None:
                    self.leg.noted(row * period, self.estimate, self.boresight, self._aimed(), self.wanted, len(units))
            self.boresight = self.boresight.step(self._aimed(), period)
        if self.leg is not None:
            self.leg.held_up += int(np.count_nonzero(mode(log.guard_status)))
        self.logs.append(log)
        self.rows += ticks

    def _aimed(self) -> Point:
        """Give where the camera should look: at what is left of the view under way."""
        if self.leg is None or self.leg.boresight is None:
            return self._middle() - self.estimate
        left = self.leg.left(self.wanted)
        counts = self.problem.patches.counts[left // 2]
        corners = self.problem.patches.corners[left // 2]
        points = corners[np.arange(corners.shape[1]) < counts[:, None]]
        return aim(self.estimate, points, self.leg.boresight, self.problem.rules.half_angle)

    def _ending(self) -> tuple[str, str] | None:
        if self.wanted.enough and not any(leg.boresight is None for leg in self.legs):
            share = self.scenario.inspect.coverage
            return "all seen", f"{self.wanted.reached:.2%} of what can be seen was taken, {share:.2%} were wanted"
        if max(self.rows - 1, 0) + self.ticks > self.scenario.steps:
            return "out of time", f"duration {self.scenario.duration:g} s is over"
        return None

    def _is_over(self, now: float) -> bool:
        """Whether the view under way is done with; notes why it was lost, if it was."""
        assert self.leg is not None
        ended = self.leg.ended(now, self.wanted)
        if ended is None:
            return False
        left = self.leg.left(self.wanted)
        if ended is Lost.LIGHT and self._in_sun and (lit := self._lit(now, left)).any():
            # A view goes on with what of it is still in light.
            self.lost[left[~lit]] = True
            self.leg.units = left[lit]
            return False
        if ended is Lost.NOT:
            self.taken_views += 1
            if len(left) and not self._lit(now, left).all():
                ended = Lost.LIGHT
        if ended is Lost.GUARD or (ended is Lost.LIGHT and not self._in_sun):
            self.replan = True
        elif ended is Lost.LIGHT:
            self.lost[left] = True
        else:
            self.wanted.failed(left)
        return True

    @property
    def _in_sun(self) -> bool:
        """Whether the light may change, so that what is lost to it is what every tour loses a little of."""
        return self.scenario.light.kind == "sun"

    def _lost_much(self) -> bool:
        """Whether what was lost to the light since the last plan, and is still wanted, asks for another."""
        areas = self.problem.patches.unit_areas()
        return float(areas[self.lost & self.wanted.left].sum()) >= _LOST * float(areas[self.wanted.possible].sum())

    def _lit(self, now: float, units: Int[np.ndarray, " k"]) -> Bool[np.ndarray, " k"]:
        sun = self.camera.sun(now)
        if sun is None:
            return np.full(len(units), not self.camera.light.matters)
        return self.camera.lit(sun, units)

    def _next(self, now: float) -> Law | tuple[str, str]:
        """Go on to the next view that still has something to show, planning anew where that is due."""
        while True:
            if (self.replan or not self.legs or self._lost_much()) and not any(
                leg.boresight is None for leg in self.legs
            ):
                ending = self._replanned(now)
                if ending is not None:
                    return ending
            leg = self.legs.popleft()
            if leg.boresight is not None and not leg.waits and not len(leg.left(self.wanted)):
                continue
            if self._in_sun and now > leg.window[1] and not self._lit(now, left := leg.left(self.wanted)).any():
                self.lost[left] = True
                continue
            law = self._law_to(leg, now)
            if law is not None:
                self.leg = leg
                return law

    def _law_to(self, leg: Leg, now: float) -> Law | None:
        """Give the law that leads to a view; None where there is none, and then what it promised is noted as failed."""
        place = self.leading.reachable(leg.place)
        try:
            if place is None:
                raise ControlError(f"{leg.place.round(3).tolist()} m: the law finds no room beside it")
            way = float(np.linalg.norm(place - self.estimate))
            turn = 0.0 if leg.boresight is None else self.boresight.off(leg.boresight)
            slew = turn / self.boresight.greatest_rate
            most = self.safe_speeds.of_leg(leg, self.estimate, place, now)
            law = self.leading.law(
                place, self.estimate, speed=way / slew if slew > 0.0 else None, most=most, through=not leg.waits
            )
        except ControlError as refusal:
            self.refused.append(str(refusal))
            self.wanted.failed(leg.units)
            return None
        leg.begun(now, place, way / min(most, self.scenario.chaser.speed_limit) + slew)
        return law

    def _replanned(self, now: float) -> tuple[str, str] | None:
        """Plan anew for what is left; give how it ends where nothing is gained by that."""
        left = self.wanted.left
        nothing = ("nothing more to see", f"{self.wanted.reached:.2%} of what can be seen was taken")
        if not left.any() or self.plans > (_REPLANS_IN_SUN if self._in_sun else _REPLANS):
            return self._no_way() or nothing
        self.replan = False
        self.lost[:] = False
        again = self._planned(self.estimate, now, again=True)
        self.plans += 1
        self.legs = deque(leg for leg in Leg.views(again, self.scenario.inspect.dwell) if len(leg.left(self.wanted)))
        if not self.legs and self._in_sun:
            end = self.scenario.duration
            if ever_lit(self.camera, self.wanted.left, end, begin=now).any():
                self.legs.append(Leg.waiting(self.estimate, max(_WAITED * (end - now), self.scenario.camera.period)))
        if not self.legs:
            return self._no_way() or nothing
        return None

    def _no_way(self) -> tuple[str, str] | None:
        """Say that the law leads nowhere, where it led to no view."""
        if self.taken_views or not self.refused:
            return None
        return "no way", f"the law led to none of {len(self.refused)} views: {self.refused[-1]}"

    def _judged(self, log: FlightLog, setup: FlightSetup, ending: tuple[str, str], progress: Progress) -> Inspection:
        """Put together what was flown, audit it on the mesh, and say what each frame truly showed."""
        scenario = self.scenario
        flown = outcome(setup, log)
        record = FlightRecord.of_log(
            log,
            outcome=flown,
            scenario=scenario.model_dump_json(),
            seed=scenario.seed,
            target_sha256=self.target.sha256,
            statuses=legend(),
        )
        progress(0.0, "audit")
        verdict = audit(
            record,
            self.target,
            chaser_radius=scenario.chaser.radius,
            bounds=environment.flight_bounds(scenario),
            force_limit=scenario.chaser.force_limit,
            speed_limit=scenario.chaser.speed_limit,
        )
        frames, seen = as_flown(record, self.shots, self.camera, progress=part_of(progress, 0.3, 1.0))
        guard = self.leading.guard
        certified = self.leading.start_certified
        return Inspection(
            scenario=scenario,
            target=self.target,
            patches=self.problem.patches,
            rules=self.problem.rules,
            seeable=self.problem.seeable,
            lit=self.lit,
            plan=self.first,
            plans=self.plans,
            record=record,
            flown=flown,
            audit=verdict,
            frames=frames,
            seen=seen,
            outcome=ending[0],
            why=ending[1],
            seconds=time.perf_counter() - self.began,
            start_certified=None if certified is None else certified and not self.broken,
            assumptions_broken=self.broken,
            guard=None if guard is None else guard_numbers(guard),
            limits=self._limits_kept(record),
            drifts=self.safe_speeds.flown,
        )

    def _limits_kept(self, record: FlightRecord) -> LimitsKept | None:
        entry = self.scenario.inspect
        if not (entry.hold_points or entry.no_thrust_towards or entry.passive_safety):
            return None
        return limits_kept(self.scenario, record, self.target.distance.distance, every=self.ticks)


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
