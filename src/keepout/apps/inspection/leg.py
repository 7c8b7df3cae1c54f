"""One view of a tour as it is flown: when it is done with, and whether it was lost to the light or to the guard."""

import enum
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from keepout.apps.inspection.plan import InspectionPlan
from keepout.apps.inspection.wanted import Wanted
from keepout.apps.led.camera import Boresight
from keepout.core.mission.task_entries import HoldPointEntry

Point = Float[np.ndarray, "3"]

_NEAR = 0.15
"""Metres from its place at which a view is reached."""
_ALIGNED = np.radians(1.0)
"""Angle to the direction wanted within which the camera looks there, rad."""
_SETTLED = 3
"""Frames in a row at the place that show nothing more, after which the view is done with."""
_PATIENCE, _EXTRA = 3.0, 240.0
"""A place not reached after so many times the way at the speed limit and the turn, and so many seconds, is given up."""


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
    units: Int[np.ndarray, " k"]
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
    def holds(cls, points: Iterable[HoldPointEntry], tolerance: float) -> Iterator["Leg"]:
        """Give the legs of hold points, each held within `tolerance` (m)."""
        for point in points:
            place = np.asarray(point.position, dtype=float)
            yield cls(place, None, np.zeros(0, np.int64), stay=point.seconds, near=tolerance)

    @classmethod
    def waiting(cls, place: Point, seconds: float) -> "Leg":
        """Give a leg that waits at a place for the light."""
        return cls(place, None, np.zeros(0, np.int64), stay=seconds)

    @property
    def waits(self) -> bool:
        """Whether the chaser stays there, whatever was seen."""
        return self.stay > 0.0

    def left(self, wanted: Wanted) -> Int[np.ndarray, " k"]:
        """Give the units of the view that are still wanted."""
        return self.units[wanted.left[self.units]]

    def begun(self, now: float, place: Point, expected: float) -> None:
        """Note when the way to it began, the place that the law leads to, and the seconds that it should take."""
        self.place = place
        self._given_up = max(now, self.window[0]) + _PATIENCE * expected + _EXTRA + self.stay

    def noted(
        self, now: float, estimate: Point, boresight: Boresight, aimed: Point, wanted: Wanted, fresh: int
    ) -> None:
        """Note a frame: where it was taken, where it looked and how many units it showed that were wanted."""
        near = float(np.linalg.norm(estimate - self.place)) < self.near
        aligned = self.boresight is None or boresight.off(aimed) < _ALIGNED
        if not (near and aligned):
            self._idle = 0
            if not near:
                self._there_since = float("inf")
            return
        self._there_since = min(self._there_since, now)
        in_window = now >= self.window[0]
        self._idle = 0 if fresh or not in_window else self._idle + 1

    def ended(self, now: float, wanted: Wanted) -> Lost | None:
        """Say whether the view is done with, and how; None while it goes on."""
        stayed = not self.waits or now >= self._there_since + self.stay
        if self.boresight is None:
            return Lost.NOT if stayed else self._late(now)
        if not len(self.left(wanted)):
            return Lost.NOT if stayed else self._late(now)
        if self._idle >= _SETTLED and stayed:
            return Lost.NOT
        late = self._late(now)
        return Lost.LIGHT if late is None and now > self.window[1] else late

    def _late(self, now: float) -> Lost | None:
        if now <= self._given_up:
            return None
        return Lost.GUARD if self.held_up else Lost.LATE
