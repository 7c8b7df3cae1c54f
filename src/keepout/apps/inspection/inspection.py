"""What an inspection leaves: the flight, every frame, what was seen and the verdict; and what became of each unit."""

import enum
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Int8

from keepout.apps.inspection.circumnavigation import Transfer
from keepout.apps.inspection.frames import Frame, Shot, as_flown
from keepout.apps.inspection.limits import LimitsKept, limits_kept
from keepout.apps.inspection.passive import DriftsFlown
from keepout.apps.inspection.plan import InspectionPlan
from keepout.apps.inspection.problem import Problem
from keepout.apps.inspection.seeing.patches import Marks, Patches
from keepout.apps.inspection.seeing.seeable import Hidden, Seeable, Verdict
from keepout.apps.inspection.seeing.visible import SeeingRules
from keepout.apps.led.driver import Ended, Led
from keepout.core.mission.flight import Flight
from keepout.core.progress import Progress, silent

_DIGITS = 4
"""Decimals of the lengths in a list for people: tenths of a millimetre."""


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
        field_sha256: digest of the field that the law flew by; empty of a circumnavigation, which has none.

    """

    patches: Patches
    rules: SeeingRules
    seeable: Seeable
    possible: Marks
    plan: InspectionPlan
    plans: int
    frames: tuple[Frame, ...]
    seen: Marks
    limits: LimitsKept | None = None
    drifts: DriftsFlown | None = None
    transfer: Transfer | None = None
    field_sha256: str = ""

    @classmethod
    def of(
        cls,
        problem: Problem,
        flight: Flight,
        shots: Sequence[Shot],
        ended: Ended,
        began: float,
        *,
        progress: Progress = silent,
        **found: Any,
    ) -> "Inspection":
        """Say what each frame of a flight truly showed, and how the operator's limits were kept.

        Args:
            problem: what was to be seen.
            flight: at its end.
            shots: frames as the camera was told to take them.
            ended: how it ended.
            began: when the computation began, s by `time.perf_counter`.
            progress: called as the work goes on.
            **found: further entries of the inspection.

        """
        frames, seen = as_flown(flight.record, shots, problem.camera, progress=progress)
        scenario, entry, limits = flight.scenario, flight.scenario.inspect, None
        if entry.hold_points or entry.no_thrust_towards or entry.passive_safety:
            ticks = round(scenario.camera.period / scenario.control.period)
            limits = limits_kept(scenario, flight.record, problem.target.distance.distance, every=ticks)
        known = {"patches": problem.patches, "rules": problem.rules, "seeable": problem.seeable, "limits": limits}
        seconds = time.perf_counter() - began
        return cls(flight, ended.outcome, ended.why, seconds, frames=frames, seen=seen, **known, **found)

    @property
    def coverage(self) -> float:
        """Share of the area counted that was seen."""
        return self.patches.coverage(self.seen)

    @property
    def delta_v(self) -> float:
        """Of the flight, with the burns that come before it, m/s."""
        return float(self.flown.delta_v) + (0.0 if self.transfer is None else self.transfer.delta_v)

    @property
    def lit(self) -> Marks:
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

    def _share_of(self, units: Marks) -> float:
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
            **self.flight.zone_figures(),
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


class Fate(enum.IntEnum):
    """What became of a unit.

    Attributes:
        words: for people.
        colour: told apart by colour-blind readers, on light paper and on a dark ground.

    """

    words: str
    colour: str

    SEEN = 0, "seen", "#2fa77d"
    """Wholly, in a frame of the flight."""
    MISSED = 1, "could be seen, was not", "#d9722e"
    """Not seen, though it can be, and is lit at some time of the mission."""
    SHADOWED = 2, "never lit", "#3f5fa8"
    """Not seen, and never lit in the mission's time, though there is a place to see it from."""
    ENCLOSED_BY_RAYS = 3, "hidden: enclosed, by rays", "#5b616b"
    """Proved hidden. Measured: each of many rays from its middle meets the mesh."""
    NARROW_BY_RAYS = 4, "hidden: too narrow, by rays", "#b76aa4"
    """Proved hidden. Measured: some of these rays gets out, so that incidence, range, stand-off or width forbid it."""
    UNDECIDED = 5, "undecided", "#e8d44a"
    """Not seen, and neither a place to see it from is known nor a proof that there is none."""
    NOT_COUNTED = 6, "not counted", "#c9ced6"
    """Nobody asks for it: the inner side of a closed part."""

    def __new__(cls, number: int, words: str, colour: str) -> "Fate":
        """Make one of the kinds above."""
        self = int.__new__(cls, number)
        self._value_, self.words, self.colour = number, words, colour
        return self


def fates(inspection: Inspection) -> Int8[np.ndarray, " units"]:
    """Give what became of each unit, a `Fate`; what was seen counts as seen, whatever the verdict on it was."""
    seeable = inspection.seeable
    found = np.full(inspection.patches.units, Fate.UNDECIDED, np.int8)
    hidden = seeable.verdict == Verdict.HIDDEN
    found[hidden] = Fate.NARROW_BY_RAYS
    found[hidden & (seeable.why == Hidden.ENCLOSED)] = Fate.ENCLOSED_BY_RAYS
    found[seeable.verdict == Verdict.SEEABLE] = Fate.SHADOWED
    found[inspection.lit] = Fate.MISSED
    found[inspection.seen] = Fate.SEEN
    found[~inspection.patches.counted] = Fate.NOT_COUNTED
    return found


def first_frames(inspection: Inspection) -> Int[np.ndarray, " units"]:
    """Give the frame that first saw each unit; -1 where none did."""
    first = np.full(inspection.patches.units, -1)
    for number in reversed(range(len(inspection.frames))):
        first[inspection.frames[number].units] = number
    return first


def shares(inspection: Inspection) -> dict[str, float]:
    """Give shares of the area counted: what can be seen and lit, what was, and the rest by its reason.

    `seen` and the reasons `missed`, `shadowed`, `enclosed_by_rays`, `narrow_by_rays` and `undecided` add up to 1.
    `hidden` is what is proved to be, seen or not; that it is enclosed or too narrow is measured by rays.
    `seen_beyond_proof` is what was seen though it is proved hidden from the room allowed, as from nearer than the
    stand-off.
    """
    patches, fate = inspection.patches, fates(inspection)
    beyond = inspection.seen & (inspection.seeable.verdict == Verdict.HIDDEN)
    return {
        "seeable": inspection.seeable.lower,
        "seeable_and_lit": patches.coverage(inspection.lit),
        "hidden": patches.coverage(inspection.seeable.verdict == Verdict.HIDDEN),
        **{kind.name.lower(): patches.coverage(fate == kind) for kind in Fate if kind is not Fate.NOT_COUNTED},
        "seen_beyond_proof": patches.coverage(beyond),
    }


def unseen(inspection: Inspection) -> list[dict[str, Any]]:
    """List the units counted that were not seen, and why: by reason, and the largest first.

    Returns:
        Of each its `patch` and `side` (0: the one that the patch's normal points to), the `reason` (a `Fate` in small
        letters), the `area` in m², `centre` in m and outward `normal` in the body frame.

    """
    patches, fate = inspection.patches, fates(inspection)
    areas, normals = patches.unit_areas(), patches.unit_normals()
    left = np.flatnonzero((fate != Fate.SEEN) & (fate != Fate.NOT_COUNTED))
    left = left[np.lexsort((left, -areas[left], fate[left]))]
    return [
        {
            "patch": int(unit // 2),
            "side": int(unit % 2),
            "reason": Fate(fate[unit]).name.lower(),
            "area": float(f"{areas[unit]:.6g}"),
            "centre": np.round(patches.centres[unit // 2], _DIGITS).tolist(),
            "normal": (np.round(normals[unit], _DIGITS) + 0.0).tolist(),
        }
        for unit in left
    ]
