"""The views ahead of a flight: which is flown to next, which were lost and to what, and when a plan is made anew."""

import enum
import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Int

from keepout.apps.inspection.leading import AroundMesh
from keepout.apps.inspection.light import ever_lit
from keepout.apps.inspection.passive import Drifting, DriftsFlown
from keepout.apps.inspection.plan import InspectionPlan
from keepout.apps.inspection.planning import plan
from keepout.apps.inspection.problem import Problem, Wanted, boresight_of
from keepout.apps.inspection.seeing.patches import Units
from keepout.apps.led.camera import Boresight
from keepout.apps.led.driver import Ended, given_up_at
from keepout.core.control.law import Law
from keepout.core.errors import ControlError
from keepout.core.geometry.distance import Point
from keepout.core.mission.scenario import Scenario
from keepout.core.progress import Progress, silent

_NEAR = 0.15
"""Metres from its place at which a view is reached."""
_ALIGNED = np.radians(1.0)
"""Angle to the direction wanted within which the camera looks there, rad."""
_SETTLED = 3
"""Frames in a row at the place that show nothing more, after which the view is done with."""
_WAITED = 0.1
"""Share of the time left for which the light is waited for where no view is in light, before a plan is made again."""
_REPLANS, _REPLANS_IN_SUN = 16, 48
"""Plans after the first, at most: each costs a tour that is mostly way. The sun asks for more."""
_LOST = 0.01
"""Share of what is possible that must be lost to the light before a plan is made again while views are left."""
_AGAIN = 0.5
"""Of the usual work for the choice of views, what is spent in the sun when a plan is made again."""


class Lost(enum.Enum):
    """Why a view ended without all that was counted on."""

    NOT = "not lost, or there and without more to show"
    LIGHT = "light"
    GUARD = "guard"
    LATE = "not reached in time"


@dataclass(eq=False)
class Leg:
    """A place to fly to, and what is to be seen from there; without a boresight it is a place to hold at.

    Attributes:
        place: (3,) m, as planned, and once it is flown to as the law leads.
        boresight: (3,) unit vector, or None.
        units: that the view is counted on to show.
        window: (from, to) s in which the light is right.
        stay: how long to stay there, s.
        near: distance from the place within which the chaser is there, m.
        speed: at which it is flown to at most, m/s.
        held_up: steps of it in which the guard replaced the command.

    """

    place: Point
    boresight: Point | None
    units: Units
    window: tuple[float, float] = (0.0, float("inf"))
    stay: float = 0.0
    near: float = _NEAR
    speed: float = float("inf")
    held_up: int = 0
    _given_up: float = float("inf")
    _there_since: float = float("inf")
    _idle: int = 0

    @classmethod
    def views(cls, plan: InspectionPlan, dwell: float) -> Iterator["Leg"]:
        """Give the legs of a plan, each staying at least `dwell` (s)."""
        for view in plan.views:
            stay = max(view.dwell, dwell)
            yield cls(view.position, view.boresight, view.units, view.window, stay, speed=view.speed)

    @classmethod
    def waiting(cls, place: Point, seconds: float, near: float = _NEAR) -> "Leg":
        """Give a leg that waits within some metres of a place, as at a hold point or for the light."""
        return cls(place, None, np.zeros(0, np.int64), stay=seconds, near=near)

    @property
    def waits(self) -> bool:
        """Whether the chaser stays there, whatever was seen."""
        return self.stay > 0.0

    def left(self, wanted: Wanted) -> Units:
        """Give the units of the view that are still wanted."""
        return self.units[wanted.left[self.units]]

    def begun(self, now: float, place: Point, expected: float) -> None:
        """Note when the way to it began, the place that the law leads to, and the seconds that it should take."""
        self.place = place
        self._given_up = given_up_at(max(now, self.window[0]), expected) + self.stay

    def noted(self, now: float, estimate: Point, boresight: Boresight, aimed: Point, fresh: int) -> None:
        """Note a frame: where it was taken, where it looked and how many units it showed that were wanted."""
        near = float(np.linalg.norm(estimate - self.place)) < self.near
        aligned = self.boresight is None or boresight.off(aimed) < _ALIGNED
        if not (near and aligned):
            self._idle = 0
            if not near:
                self._there_since = float("inf")
            return
        self._there_since = min(self._there_since, now)
        self._idle = 0 if fresh or now < self.window[0] else self._idle + 1

    def ended(self, now: float, wanted: Wanted) -> Lost | None:
        """Say whether the view is done with, and how; None while it goes on."""
        stayed = not self.waits or now >= self._there_since + self.stay
        if self.boresight is None or not len(self.left(wanted)):
            return Lost.NOT if stayed else self._late(now)
        if self._idle >= _SETTLED and stayed:
            return Lost.NOT
        late = self._late(now)
        return Lost.LIGHT if late is None and now > self.window[1] else late

    def _late(self, now: float) -> Lost | None:
        if now <= self._given_up:
            return None
        return Lost.GUARD if self.held_up else Lost.LATE


class ViewsAhead:
    """What is to be flown to, and what is wanted from there: first the hold points, then views.

    Args:
        scenario: as flown.
        problem: what is to be seen.
        leading: the law's way to any place.
        wanted: what is still to be seen, as it is known on board.
        first: the first plan, already made; else made here.
        progress: told of that.

    Attributes:
        legs: ahead, in their order.
        leg: under way, or None.
        plans: made so far.
        drifts: legs as they were begun, judged by passive safety; None where that is not asked for.

    """

    def __init__(
        self,
        scenario: Scenario,
        problem: Problem,
        leading: AroundMesh,
        wanted: Wanted,
        *,
        first: InspectionPlan | None = None,
        progress: Progress = silent,
    ) -> None:
        self.scenario, self.problem, self.leading = scenario, problem, leading
        self.wanted, self.plans = wanted, 1
        holds, tolerance = scenario.inspect.hold_points, scenario.goal.tolerance
        if first is None:
            begin = np.asarray(holds[-1].position if holds else scenario.start.position, dtype=float)
            first = self._plan(begin, 0.0, boresight_of(scenario, problem.target), progress=progress)
        self.first, self.leg = first, None
        waits = (Leg.waiting(np.asarray(at.position, dtype=float), at.seconds, tolerance) for at in holds)
        self.legs = deque([*waits, *Leg.views(first, scenario.inspect.dwell)])
        self.drifting = Drifting.of(scenario, problem.target.distance.distance)
        self.drifts = None if self.drifting is None else DriftsFlown()
        self._taken, self._refused = False, list[str]()
        self._lost = np.zeros(problem.patches.units, dtype=bool)

    @property
    def holding(self) -> bool:
        """Whether hold points, or a wait for the light, are still ahead."""
        return any(leg.boresight is None for leg in self.legs)

    def is_over(self, now: float) -> bool:
        """Whether no view is under way, or that is done with; notes why it was lost, if it was."""
        if self.leg is None:
            return True
        ended = self.leg.ended(now, self.wanted)
        if ended is None:
            return False
        left = self.leg.left(self.wanted)
        if ended is Lost.LIGHT and self._in_sun and (lit := self._lit(now, left)).any():
            # A view goes on with what of it is still in light.
            self._lost[left[~lit]] = True
            self.leg.units = left[lit]
            return False
        if ended is Lost.NOT:
            self._taken = True
            if len(left) and not self._lit(now, left).all():
                ended = Lost.LIGHT
        if ended is Lost.LIGHT and self._in_sun:
            self._lost[left] = True
        elif ended in (Lost.GUARD, Lost.LIGHT):
            # The views planned are no longer worth their way: another plan is made once no hold point is ahead.
            self.legs = deque(leg for leg in self.legs if leg.boresight is None)
        else:
            self.wanted.failed(left)
        return True

    def next(self, now: float, estimate: Point, boresight: Boresight) -> Law | Ended:
        """Go on to the next view that still has something to show, planning anew where that is due.

        Args:
            now: s.
            estimate: (3,) m, where the chaser takes itself to be.
            boresight: of the camera.

        Returns:
            law: that leads there; or how the inspection ends, and why.

        """
        while True:
            if (not self.legs or self._lost_much()) and not self.holding:
                ending = self._replanned(now, estimate, boresight)
                if ending is not None:
                    return ending
            leg = self.legs.popleft()
            if leg.boresight is not None and not leg.waits and not len(leg.left(self.wanted)):
                continue
            if self._in_sun and now > leg.window[1] and not self._lit(now, left := leg.left(self.wanted)).any():
                self._lost[left] = True
                continue
            law = self._law_to(leg, now, estimate, boresight)
            if law is not None:
                self.leg = leg
                return law

    @property
    def _in_sun(self) -> bool:
        """Whether the light may change, so that what is lost to it is what every tour loses a little of."""
        return self.scenario.light.kind == "sun"

    def _lost_much(self) -> bool:
        """Whether what was lost to the light since the last plan, and is still wanted, asks for another."""
        areas = self.problem.patches.unit_areas()
        return float(areas[self._lost & self.wanted.left].sum()) >= _LOST * float(areas[self.wanted.possible].sum())

    def _lit(self, now: float, units: Int[np.ndarray, " k"]) -> Bool[np.ndarray, " k"]:
        light = self.problem.light
        sun = light.sun(now)
        return np.full(len(units), not light.matters) if sun is None else self.problem.camera.lit(sun, units)

    def _law_to(self, leg: Leg, now: float, estimate: Point, boresight: Boresight) -> Law | None:
        """Give the law that leads to a view; None where there is none, and then what it promised is noted as failed."""
        place = self.leading.reachable(leg.place)
        try:
            if place is None:
                raise ControlError(f"{leg.place.round(3).tolist()} m: the law finds no room beside it")
            way = float(np.linalg.norm(place - estimate))
            turn = 0.0 if leg.boresight is None else boresight.off(leg.boresight)
            slew = turn / boresight.greatest_rate
            most = self._safe_speed(leg.speed, estimate, place, now)
            turning = way / slew if slew > 0.0 else None
            law = self.leading.law(place, estimate, speed=turning, most=most, through=not leg.waits)
        except ControlError as refusal:
            self._refused.append(str(refusal))
            self.wanted.failed(leg.units)
            return None
        leg.begun(now, place, way / min(most, self.scenario.chaser.speed_limit) + slew)
        return law

    def _safe_speed(self, planned: float, position: Point, place: Point, now: float) -> float:
        """Give the greatest speed of a leg, m/s, and count it: no more than planned, and than is passively safe."""
        if self.drifting is None or self.drifts is None:
            return math.inf
        limit, course = self.scenario.chaser.speed_limit, self.problem.ways_from(position).path(position, place)
        if course is None:
            course = np.stack([position, place])
        until = now + float(np.linalg.norm(place - position)) / limit
        found = float(self.drifting.speeds([course], np.array([[now, until]]))[0])
        speed = min(planned, max(found, self.drifting.slowest))
        self.drifts.legs += 1
        self.drifts.unsafe += found == 0.0
        self.drifts.slowed += speed < limit
        return speed

    def _replanned(self, now: float, estimate: Point, boresight: Boresight) -> Ended | None:
        """Plan anew for what is left; give how it ends where nothing is gained by that."""
        if not self.wanted.left.any() or self.plans > (_REPLANS_IN_SUN if self._in_sun else _REPLANS):
            return self._nothing_more()
        self._lost[:] = False
        again = self._plan(estimate, now, boresight, effort=_AGAIN if self._in_sun else 1.0)
        self.plans += 1
        self.legs = deque(leg for leg in Leg.views(again, self.scenario.inspect.dwell) if len(leg.left(self.wanted)))
        if not self.legs and self._in_sun:
            end = self.scenario.duration
            if ever_lit(self.problem.camera, self.wanted.left, end, begin=now).any():
                self.legs.append(Leg.waiting(estimate, max(_WAITED * (end - now), self.scenario.camera.period)))
        return None if self.legs else self._nothing_more()

    def _plan(self, position: Point, time: float, boresight: Boresight, **options: Any) -> InspectionPlan:
        """Plan for what is left, from where the chaser then is and the camera then looks."""
        options |= {"wanted": self.wanted.left, "share": self.wanted.share_of_left}
        return plan(self.problem, position=position, time=time, boresight=boresight.direction, **options)

    def _nothing_more(self) -> Ended:
        """Say that nothing more is to be seen; or that the law leads nowhere, where it led to no view."""
        if self._taken or not self._refused:
            return Ended("nothing more to see", f"{self.wanted.reached:.2%} of what is not proved hidden was taken")
        return Ended("no way", f"the law led to none of {len(self._refused)} views: {self._refused[-1]}")
