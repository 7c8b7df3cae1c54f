"""Where in a flight the guard, its flags or the law spoke, and the two moments that everybody looks for."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from keepout.core.control.law import ControlStatus
from keepout.core.flight.record import FlightRecord
from keepout.core.guard.status import GuardFlag, GuardStatus, flag_names

_JOINED = 400
"""Runs of one kind that are nearer than this part of the flight are one mark."""


@dataclass(frozen=True)
class Mark:
    """A time, or a span of time, s from the flight's start; `times` says how many runs were joined into it."""

    kind: str
    words: str
    start: float
    end: float
    times: int = 1

    def plain(self) -> dict[str, Any]:
        """Give it as JSON holds it."""
        return asdict(self)


def marks(
    record: FlightRecord, clearance: Float[np.ndarray, "rows"], error: Float[np.ndarray, "rows"], tolerance: float
) -> list[Mark]:
    """Find the marks of a flight, in order of time.

    Args:
        record: the flight; what was done in its last row was not flown.
        clearance: m.
        error: distance to the goal, m.
        tolerance: within which the goal is reached, m.

    """
    time = record.time - record.time[0]
    guard, law = record.guard_status[:-1], record.control_status[:-1]
    action = guard & int(GuardStatus.ESCAPING)
    found: list[Mark] = []
    for status in GuardStatus:
        if status is not GuardStatus.CLEAR:
            found += _spans("guard", f"guard: {_said(status.name)}", action == status, time)
    for flag in GuardFlag:
        [name] = flag_names(flag)
        found += _spans("flag", f"flag: {_said(name)}", (guard & flag) != 0, time)
    for status in ControlStatus:
        if status != 0:
            found += _spans("law", f"law: {_said(status.name)}", law == status, time)
    if np.isfinite(clearance).any():
        nearest = int(np.nanargmin(clearance))
        found.append(Mark("nearest", "least clearance", float(time[nearest]), float(time[nearest])))
    away = np.flatnonzero(~(error < tolerance))
    arrived = int(away[-1]) + 1 if len(away) else 0
    if arrived < len(time):
        found.append(Mark("reached", "goal reached, to stay", float(time[arrived]), float(time[arrived])))
    return sorted(found, key=lambda mark: (mark.start, mark.end))


def _spans(kind: str, words: str, spoke: Bool[np.ndarray, "steps"], time: Float[np.ndarray, "rows"]) -> list[Mark]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], spoke, [False]]).astype(np.int8)))
    joined: list[Mark] = []
    for first, after in edges.reshape(-1, 2):
        start, end = float(time[first]), float(time[after])
        if joined and start - joined[-1].end < float(time[-1]) / _JOINED:
            joined[-1] = Mark(kind, words, joined[-1].start, end, joined[-1].times + 1)
        else:
            joined.append(Mark(kind, words, start, end))
    return joined


def _said(name: str) -> str:
    return name.lower().replace("_", " ")
