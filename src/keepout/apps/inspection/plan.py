"""An inspection's plan: the views in the order in which they are flown, and how far from the best it may be."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int

from keepout.apps.inspection.drifting import DriftsPlanned


@dataclass(frozen=True, eq=False)
class PlannedView:
    """A place and a direction from which a frame is to be taken.

    Attributes:
        position: (3,) of the camera, m, body frame.
        boresight: (3,) unit vector.
        units: those that this view is counted on to see, and no view before it.
        window: (from, to) s: when the light is right; (0, inf) where light does not matter.
        dwell: how long to stay, s.
        speed: at which it is flown to at most, m/s: below the chaser's limit where passive safety asks for it.
        at: when it is expected to be worth what it shows, s.
        way: from the view before it, m.
        on_the_way: units that frames on that way are counted on to show.

    """

    position: Float[np.ndarray, "3"]
    boresight: Float[np.ndarray, "3"]
    units: Int[np.ndarray, " k"]
    window: tuple[float, float] = (0.0, float("inf"))
    dwell: float = 0.0
    speed: float = float("inf")
    at: float = 0.0
    way: float = 0.0
    on_the_way: Int[np.ndarray, " j"] = field(default_factory=lambda: np.zeros(0, np.int64))


@dataclass(frozen=True, eq=False)
class InspectionPlan:
    """Views in order, what they cover, and bounds.

    Attributes:
        views: in the order in which they are flown.
        covered: (2 n,) units that the plan sees.
        way_length: from the start through all views by ways that keep the stand-off, m.
        duration: expected, s.
        candidates: views that were found.
        fewest_views: proved: no fewer of the short list see as much by themselves; frames on the way may
            spare some.
        greedy_views: how many the greedy choice needed.
        drifts: what passive safety made of it; None where it is not asked for.
        short_list: how many of the candidates the views were chosen from; the bound is about these.
        begin: when it begins, s.

    """

    views: tuple[PlannedView, ...]
    covered: Bool[np.ndarray, " units"]
    way_length: float
    duration: float
    candidates: int
    fewest_views: int
    greedy_views: int
    drifts: DriftsPlanned | None = None
    short_list: int = 0
    begin: float = 0.0

    def seen_by(self, time: float) -> Bool[np.ndarray, " units"]:
        """Give the units that the plan sees by a time, s: those of the views reached by then, and of the ways there."""
        if self.begin + self.duration <= time:
            return self.covered.copy()
        seen = np.zeros_like(self.covered)
        for view in self.views:
            if view.at <= time:
                seen[view.units] = seen[view.on_the_way] = True
        return seen
