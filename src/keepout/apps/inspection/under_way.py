"""One inspection under way: the flight segment by segment, the camera's turns and the frames it takes."""

from dataclasses import dataclass, field

import jax
import numpy as np
from jaxtyping import Float

from keepout.apps.inspection.aiming import aim
from keepout.apps.inspection.equipment import boresight_of
from keepout.apps.inspection.frames import Camera, Shot
from keepout.apps.inspection.inspection import Inspection
from keepout.apps.inspection.judging import judged
from keepout.apps.inspection.leading import Leading
from keepout.apps.inspection.problem import Problem
from keepout.apps.inspection.views_ahead import ViewsAhead
from keepout.apps.led.camera import Boresight
from keepout.core.control.law import Law
from keepout.core.flight.loop import FlightLog, begin, fly_segment, joined
from keepout.core.guard.safety_layer import mode
from keepout.core.mission.scenario import Scenario
from keepout.core.progress import Progress, part_of, silent

Point = Float[np.ndarray, "3"]


@dataclass(eq=False)
class UnderWay:
    """An inspection from the first frame to the last.

    Attributes:
        scenario: as flown.
        problem: what is to be seen.
        leading: law and guard.
        camera: what it sees.
        ahead: the views to fly to.
        began: when the computation began, s by `time.perf_counter`.

    """

    scenario: Scenario
    problem: Problem
    leading: Leading
    camera: Camera
    ahead: ViewsAhead
    began: float
    _estimate: Point = field(init=False)
    _boresight: Boresight = field(init=False)
    _shots: list[Shot] = field(default_factory=list)
    _logs: list[FlightLog] = field(default_factory=list)
    _rows: int = 0

    def __post_init__(self) -> None:
        self._estimate = np.asarray(self.scenario.start.position, dtype=float)
        self._boresight = boresight_of(self.scenario, self.problem.target)

    def flown(self, progress: Progress = silent) -> Inspection:
        """Fly until the end, and judge."""
        scenario, ticks = self.scenario, self._ticks
        setup, state, ending = None, None, None
        while True:
            now = max(self._rows - 1, 0) * scenario.control.period
            ending = self._ending() if ending is None else ending
            if ending is None and self.ahead.is_over(now):
                law = self.ahead.next(now, self._estimate, self._boresight)
                if isinstance(law, tuple):
                    ending = law
                else:
                    setup = self.leading.setup(law) if setup is None else self.leading.led_on(setup, law)
            # An audit needs a way: where nothing is to be flown, a frame's period is flown at rest.
            if ending is not None and self._rows > 1:
                break
            if setup is None:
                setup = self.leading.setup(self._resting())
            if state is None:
                state = begin(setup, self.leading.initial, jax.random.key(scenario.seed))
            # A frame is taken at a segment's last row; the first, at the start, is a segment of its own.
            count = ticks if self._logs else 1
            state, log = fly_segment(setup, state, count, longest=ticks)
            self._look(log, count)
            said = f"{self.ahead.wanted.reached:.1%} seen on board, {len(self.ahead.legs)} views ahead"
            progress(min(0.9 * self._rows / scenario.steps, 0.9), said)
        assert setup is not None
        return judged(
            # The scenario as it was given: the one that leads has another goal and a wider margin.
            scenario,
            self.problem,
            setup,
            joined(self._logs),
            self._shots,
            self.camera,
            guard=self.leading.guard,
            certified=self.leading.start_certified,
            possible=self.ahead.wanted.possible,
            plan=self.ahead.first,
            plans=self.ahead.plans,
            ending=ending,
            began=self.began,
            drifts=self.ahead.safe_speeds.flown,
            progress=part_of(progress, 0.9, 1.0),
        )

    @property
    def _ticks(self) -> int:
        """Control periods from frame to frame."""
        return round(self.scenario.camera.period / self.scenario.control.period)

    def _resting(self) -> Law:
        start = np.asarray(self.scenario.start.position, dtype=float)
        place = self.leading.reachable(start)
        return self.leading.law(start if place is None else place, start)

    def _look(self, log: FlightLog, ticks: int) -> None:
        """Turn the camera over a segment, and take its frame at the last row: it is looked at a period later."""
        period, leg, wanted = self.scenario.control.period, self.ahead.leg, self.ahead.wanted
        position = np.asarray(log.estimated_position)
        for tick in range(ticks):
            self._estimate = position[tick]
            if tick == ticks - 1:
                row = self._rows + tick
                self._shots.append(Shot(row, self._boresight.direction))
                units = self.camera.units(row * period, self._estimate, self._boresight.direction, wanted.left)
                wanted.take(units)
                if leg is not None:
                    leg.noted(row * period, self._estimate, self._boresight, self._aimed(), wanted, len(units))
            self._boresight = self._boresight.step(self._aimed(), period)
        if leg is not None:
            leg.held_up += int(np.count_nonzero(mode(log.guard_status)))
        self._logs.append(log)
        self._rows += ticks

    def _aimed(self) -> Point:
        """Give where the camera should look: at what is left of the view under way."""
        leg, patches = self.ahead.leg, self.problem.patches
        if leg is None or leg.boresight is None:
            vertices = self.problem.target.vertices
            return 0.5 * (vertices.min(axis=0) + vertices.max(axis=0)) - self._estimate
        left = leg.left(self.ahead.wanted)
        return aim(self._estimate, patches.corners_of(left), leg.boresight, self.problem.rules.half_angle)

    def _ending(self) -> tuple[str, str] | None:
        scenario, wanted = self.scenario, self.ahead.wanted
        if wanted.enough and not self.ahead.holding:
            return wanted.ending
        if max(self._rows - 1, 0) + self._ticks > scenario.steps:
            return "out of time", f"duration {scenario.duration:g} s is over"
        return None
