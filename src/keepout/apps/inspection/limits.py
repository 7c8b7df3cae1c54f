"""An operator's limits on a flight, judged on its record: hold points, plumes, passive safety."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from keepout.apps.inspection.passive import PassiveSafety, passive_safety, states_of_record
from keepout.apps.inspection.plume import Protected, plume_violations
from keepout.core.flight.record import FlightRecord
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.task_entries import HoldPointEntry


@dataclass(frozen=True)
class Hold:
    """What became of a hold point.

    Attributes:
        position: (3,) m, body frame.
        asked: seconds for which the chaser is to be held there.
        begun: when the longest stay began that comes after the holds before it, s; nan without one.
        lasted: how long it was, s.

    """

    position: tuple[float, float, float]
    asked: float
    begun: float
    lasted: float

    @property
    def kept(self) -> bool:
        """Whether it lasted as long as asked."""
        return self.lasted >= self.asked - 1e-9


def holds(record: FlightRecord, points: tuple[HoldPointEntry, ...], tolerance: float) -> tuple[Hold, ...]:
    """Judge whether a flight was held at each point, one after the other.

    A stay is an unbroken run of samples within `tolerance` m of the point. The first stay that is long enough counts;
    the next point is looked for after it. Where none is long enough the longest is told.

    Args:
        record: true positions.
        points: in their order.
        tolerance: m.

    """
    found, since = [], 0
    for point in points:
        near = np.linalg.norm(record.position - np.asarray(point.position), axis=1) <= tolerance
        near[:since] = False
        edges = np.flatnonzero(np.diff(np.concatenate([[False], near, [False]])))
        begins, ends = edges[::2], edges[1::2] - 1
        lasted = record.time[ends] - record.time[begins]
        if not lasted.size:
            found.append(Hold(point.position, point.seconds, math.nan, 0.0))
            continue
        enough = np.flatnonzero(lasted >= point.seconds - 1e-9)
        best = int(enough[0]) if enough.size else int(np.argmax(lasted))
        found.append(Hold(point.position, point.seconds, float(record.time[begins[best]]), float(lasted[best])))
        if enough.size:
            since = int(np.searchsorted(record.time, record.time[begins[best]] + point.seconds - 1e-9))
    return tuple(found)


@dataclass(frozen=True, eq=False)
class LimitsKept:
    """How a flight kept an operator's limits.

    Attributes:
        holds: at each hold point.
        plume_steps: steps in which a plume can have reached a protected part; None where none is declared.
        steps: of the flight.
        passive: of drifts from the samples, with no push beyond the motion; None where not asked.
        passive_pushed: likewise, with the disturbance's bound as a push that never turns round.

    """

    holds: tuple[Hold, ...]
    plume_steps: int | None
    steps: int
    passive: PassiveSafety | None
    passive_pushed: PassiveSafety | None

    @property
    def kept(self) -> bool:
        """Whether all limits were kept: drifts are judged without the push."""
        held = all(hold.kept for hold in self.holds)
        return held and not self.plume_steps and (self.passive is None or bool(self.passive.safe.all()))

    def summary(self) -> dict[str, Any]:
        """Give the figures as plain numbers for JSON; without those that were not asked for."""
        told: dict[str, Any] = {"limits_kept": self.kept}
        if self.holds:
            told["holds_kept"] = sum(hold.kept for hold in self.holds)
            told["holds"] = len(self.holds)
        if self.plume_steps is not None:
            told["plume_steps"] = self.plume_steps
        for name, passive in (("passive", self.passive), ("passive_pushed", self.passive_pushed)):
            if passive is not None:
                least = float(passive.clearance.min())
                told[f"{name}_safe_share"] = float(passive.safe.mean())
                told[f"{name}_clearance_m"] = least if math.isfinite(least) else None
                told[f"{name}_spread_m"] = passive.spread
        return told


def limits_kept(
    scenario: Scenario,
    record: FlightRecord,
    distance: Callable[[Float[np.ndarray, "points 3"]], Float[np.ndarray, "points"]],
    *,
    every: int = 1,
) -> LimitsKept:
    """Judge a flight by a scenario's hold points, protected parts and passive safety.

    Args:
        scenario: as it was flown.
        record: of the flight.
        distance: exact and unsigned, to the target's mesh, m.
        every: samples from one drift to the next.

    """
    inspect, protected = scenario.inspect, Protected.of(scenario)
    passive = pushed = None
    if inspect.passive_safety > 0.0:
        states = states_of_record(record, every)
        passive, pushed = (
            passive_safety(scenario, distance, states, inspect.passive_safety, push=push, enough=1.0)
            for push in (0.0, None)
        )
    return LimitsKept(
        holds(record, inspect.hold_points, scenario.goal.tolerance),
        None if protected is None else int(plume_violations(record, protected, scenario).sum()),
        record.steps,
        passive,
        pushed,
    )
