"""What an exploration leaves: the map, the flight, every view, and the verdict on the true mesh."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from keepout.apps.led.driver import Led
from keepout.apps.unknown.departures import Departures
from keepout.apps.unknown.known_free import KnownFreeMap
from keepout.apps.unknown.next_view import Ending
from keepout.apps.unknown.skin import Stage
from keepout.core.geometry.target import Target


@dataclass(frozen=True)
class TakenView:
    """One depth image of a flight, and what it opened.

    Attributes:
        time: of the image, s.
        position: (3,) of the sensor, m, map frame: the truth.
        direction: (3,) unit vector of the boresight, map frame.
        status: "seen", or why the map did not take it.
        opened: cubes that became free.
        free_volume: known-free room inside the declared ball after it, m³.
        why: what the planner wanted when it was taken.
        contradicting: returns in it that prove that a promise of ball or sensor is broken.

    """

    time: float
    position: Float[np.ndarray, "3"]
    direction: Float[np.ndarray, "3"]
    status: str
    opened: int
    free_volume: float
    why: str
    contradicting: int = 0


@dataclass(frozen=True, eq=False)
class Exploration(Led):
    """One exploration: a flight, and what was found.

    Attributes:
        outcome: how it ended.
        expected: the mesh that the mission believed in, or None.
        map: at the end.
        views: every image.
        stages: the skin of the map at some times.
        seen_share: of the true surface's reachable part, the share within `explore.explained` of a return.
        unknown: (m, 3) centres of the cubes that were in the way at the end, m.
        departures: where the seen surface is not what was expected; None where nothing was.
        keep: the distance from all that is not known free that ways of the chaser's centre were looked for with, m.

    """

    outcome: Ending
    expected: Target | None
    map: KnownFreeMap
    views: tuple[TakenView, ...]
    stages: tuple[Stage, ...]
    seen_share: float
    unknown: Float[np.ndarray, "m 3"]
    departures: Departures | None
    keep: float

    def summary(self) -> dict[str, Any]:
        """Give the figures as plain numbers for JSON.

        `contact` is true unless the audit proves that there was none; `contact_verdict` tells the cases apart.
        """
        refused = [view.status for view in self.views if view.status != "seen"]
        return {
            "outcome": self.outcome,
            "why": self.why,
            "reached": self.outcome == "reached goal",
            **self.contact_figures(),
            "seen_share": self.seen_share,
            "views": len(self.views),
            "refused_views": {status: refused.count(status) for status in sorted(set(refused))},
            "contradicting_returns": sum(view.contradicting for view in self.views),
            "opened_m3": sum(view.opened for view in self.views) * self.map.spacing**3,
            "duration_s": float(self.record.time[-1]),
            "delta_v_mps": float(self.flown.delta_v),
            "guard_interventions": int(self.flown.guard_interventions),
            "guard_flags": self.flight.guard_flags(),
            "start_certified": bool(self.start_certified),
            "assumptions_broken": list(self.assumptions_broken),
            "departures_largest_m": None if self.departures is None else self.departures.largest,
            "guard": self.guard or {},
            "seconds": self.seconds,
        }
