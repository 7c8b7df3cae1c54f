"""One inspection under way: led from view to view, the camera's turns and frames, and what was flown put together."""

import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from keepout.apps.inspection.candidates import aim
from keepout.apps.inspection.frames import Camera, Shot, as_flown
from keepout.apps.inspection.inspection import Inspection
from keepout.apps.inspection.leading import AroundMesh
from keepout.apps.inspection.limits import limits_kept
from keepout.apps.inspection.problem import Problem, boresight_of
from keepout.apps.inspection.views_ahead import ViewsAhead
from keepout.apps.led.driver import Ended, Leader, LedFlight, lead
from keepout.apps.led.leading import Point
from keepout.core.flight.setup import FlightSetup
from keepout.core.guard.safety_layer import mode
from keepout.core.mission.flight import Flight, Standing, recorded
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings, broken_assumptions
from keepout.core.progress import Progress, part_of, silent


class UnderWay(Leader):
    """An inspection from the first frame to the last: a frame is taken at a segment's last row.

    Args:
        scenario: as flown.
        problem: what is to be seen.
        leading: law and guard.
        camera: what it sees.
        ahead: the views to fly to.
        began: when the computation began, s by `time.perf_counter`.

    """

    fewest = 2

    def __init__(
        self,
        scenario: Scenario,
        problem: Problem,
        leading: AroundMesh,
        camera: Camera,
        ahead: ViewsAhead,
        began: float,
    ) -> None:
        self.scenario, self.problem, self.leading = scenario, problem, leading
        self.camera, self.ahead, self.began = camera, ahead, began
        self.ticks = round(scenario.camera.period / scenario.control.period)
        self.estimate = np.asarray(scenario.start.position, dtype=float)
        self.boresight = boresight_of(scenario, problem.target)
        self.shots: list[Shot] = []
        self.over: Ended | None = None

    def flown(self, progress: Progress = silent) -> Inspection:
        """Fly until the end, and judge."""
        flight = LedFlight(self.scenario, self.leading.initial, self.ticks)
        ended = lead(self, flight, progress)
        assert flight.setup is not None
        progress(0.9, "audit")
        # The scenario as it was given: the one that leads has another goal and a wider margin.
        scenario, ahead, target = self.scenario, self.ahead, self.problem.target
        standing = Standing.of(self.leading.start_certified, broken_assumptions(scenario, target))
        bounds = Surroundings(scenario).flight_bounds
        return inspected(
            self.problem,
            recorded(scenario, target, flight.setup, flight.log(), bounds, standing),
            self.camera,
            self.shots,
            ended,
            self.began,
            progress=part_of(progress, 0.93, 1.0),
            possible=ahead.wanted.possible,
            plan=ahead.first,
            plans=ahead.plans,
            drifts=ahead.safe_speeds.flown,
        )

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
                units = self.camera.units(row * period, estimate, self.boresight.direction, wanted.left)
                wanted.take(units)
                if leg is not None:
                    leg.noted(row * period, estimate, self.boresight, self._aimed(), wanted, len(units))
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


def inspected(
    problem: Problem,
    flight: Flight,
    camera: Camera,
    shots: Sequence[Shot],
    ended: Ended,
    began: float,
    *,
    progress: Progress = silent,
    **found: Any,
) -> Inspection:
    """Say what each frame of a flight truly showed, and how the operator's limits were kept.

    Args:
        problem: what was to be seen.
        flight: at its end.
        camera: what it sees.
        shots: frames as the camera was told to take them.
        ended: how it ended.
        began: when the computation began, s by `time.perf_counter`.
        progress: called as the work goes on.
        **found: further entries of the inspection.

    """
    frames, seen = as_flown(flight.record, shots, camera, progress=progress)
    scenario, entry, limits = flight.scenario, flight.scenario.inspect, None
    if entry.hold_points or entry.no_thrust_towards or entry.passive_safety:
        ticks = round(scenario.camera.period / scenario.control.period)
        limits = limits_kept(scenario, flight.record, problem.target.distance.distance, every=ticks)
    return Inspection(
        flight=flight,
        outcome=ended.outcome,
        why=ended.why,
        seconds=time.perf_counter() - began,
        patches=problem.patches,
        rules=problem.rules,
        seeable=problem.seeable,
        frames=frames,
        seen=seen,
        limits=limits,
        **found,
    )
