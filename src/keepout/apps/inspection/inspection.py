"""What an inspection leaves: the flight, every frame, what was seen of the true mesh, and the audit's verdict."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from keepout.apps.inspection.circumnavigation import Transfer
from keepout.apps.inspection.frames import Frame
from keepout.apps.inspection.limits import LimitsKept
from keepout.apps.inspection.plan import InspectionPlan
from keepout.apps.inspection.safe_speeds import DriftsFlown
from keepout.apps.inspection.seeing.patches import Patches
from keepout.apps.inspection.seeing.seeable import Seeable, Verdict
from keepout.apps.inspection.seeing.visible import SeeingRules
from keepout.apps.led.result import Led


@dataclass(frozen=True, eq=False)
class Inspection(Led):
    """One inspection: a flight, and what was seen.

    It ended with "all seen", "50 % asked, seen" (or another share), "out of time", "nothing more to see" or "no way".

    Attributes:
        patches: of the target's mesh.
        rules: when a patch counts as seen.
        seeable: what can be seen at all.
        possible: (2 n,) units not proved hidden that are lit at some time of the mission; all of them without light.
        plan: the first one.
        plans: how many were made: replans are counted.
        frames: every image.
        seen: (2 n,) units seen in some frame.
        limits: how the operator's limits were kept; None where there are none.
        drifts: legs as they were begun, judged by passive safety; None where that is not asked for.
        transfer: how a circumnavigation comes onto its ellipse before the flight; None of any other.

    """

    patches: Patches
    rules: SeeingRules
    seeable: Seeable
    possible: Bool[np.ndarray, " units"]
    plan: InspectionPlan
    plans: int
    frames: tuple[Frame, ...]
    seen: Bool[np.ndarray, " units"]
    limits: LimitsKept | None = None
    drifts: DriftsFlown | None = None
    transfer: Transfer | None = None

    @property
    def coverage(self) -> float:
        """Share of the area counted that was seen."""
        return self.patches.coverage(self.seen)

    @property
    def delta_v(self) -> float:
        """Of the flight, with the burns that come before it, m/s."""
        return float(self.flown.delta_v) + (0.0 if self.transfer is None else self.transfer.delta_v)

    @property
    def lit(self) -> Bool[np.ndarray, " units"]:
        """The units of which it is known that they can be seen, and be lit in the mission's time."""
        return self.possible & (self.seeable.verdict == Verdict.SEEABLE)

    @property
    def coverage_possible(self) -> float:
        """Share of what is not proved hidden, and can be lit in the mission's time, that was seen."""
        return self._share_of(self.possible)

    @property
    def coverage_seeable(self) -> float:
        """Share of what surely can be seen, and be lit in the mission's time, that was seen; without the undecided."""
        return self._share_of(self.lit)

    def _share_of(self, units: Bool[np.ndarray, " units"]) -> float:
        whole = self.patches.coverage(units)
        return self.patches.coverage(self.seen & units) / whole if whole > 0.0 else 1.0

    def over_time(self) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
        """Give the time of each frame, s, and the coverage after it."""
        areas, seen, total = self.patches.unit_areas(), np.zeros(self.patches.units, bool), 0.0
        shares = []
        for frame in self.frames:
            fresh = frame.units[~seen[frame.units]]
            total += float(areas[fresh].sum())
            seen[fresh] = True
            shares.append(total / areas.sum())
        return np.array([frame.time for frame in self.frames]), np.array(shares)

    def summary(self) -> dict[str, Any]:
        """Give the figures as plain numbers for JSON.

        `contact` is true unless the audit proves that there was none; `contact_verdict` tells the cases apart.
        """
        return {
            "outcome": self.outcome,
            "why": self.why,
            "coverage": self.coverage,
            "coverage_possible": self.coverage_possible,
            "coverage_seeable": self.coverage_seeable,
            "coverage_upper_bound": self.seeable.upper,
            "coverage_lower_bound": self.seeable.lower,
            "coverage_lit": self.patches.coverage(self.lit),
            "coverage_planned": self.patches.coverage(self.plan.covered),
            "coverage_planned_in_time": self.patches.coverage(self.plan.seen_by(self.scenario.duration)),
            "plan_duration_s": self.plan.duration,
            "views": len(self.plan.views),
            "views_at_least": self.plan.fewest_views,
            "views_greedy": self.plan.greedy_views,
            "candidates": self.plan.candidates,
            "candidates_short_listed": self.plan.short_list,
            "proof_squares": self.seeable.squares,
            "proof_ended_by_clock": self.seeable.by_clock,
            "plans": self.plans,
            "frames": len(self.frames),
            "way_m": self.plan.way_length,
            **self.contact_figures(),
            "delta_v_mps": self.delta_v,
            **({} if self.transfer is None else self.transfer.summary()),
            "duration_s": float(self.record.time[-1]),
            "guard_interventions": int(self.flown.guard_interventions),
            "guard_flags": self.flight.guard_flags(),
            "start_certified": self.start_certified,
            "assumptions_broken": list(self.assumptions_broken),
            "guard": self.guard,
            **({} if self.plan.drifts is None else self.plan.drifts.summary()),
            **({} if self.drifts is None else self.drifts.summary()),
            **({} if self.limits is None else self.limits.summary()),
            "seconds": self.seconds,
        }
