"""Flights that nobody flew, for what reads flights: chosen columns, zeros in all others, and a chosen summary."""

from typing import Any

import numpy as np

from keepout.core.flight.loop import FlightLog
from keepout.core.flight.record import OPTIONAL_COLUMNS, FlightRecord
from keepout.core.mission.flight import Flight
from keepout.core.mission.scenario import Scenario

NUMBERS = ("time", "barrier", "backstepping_barrier", "lyapunov", "field_value")
KINDS = {"control_status": np.int32, "guard_status": np.int32, "saturated": np.bool_}
SHAPES = {"attitude": (4,)} | dict.fromkeys([*NUMBERS, *KINDS], ())


def record_of(header: dict[str, Any], **columns: np.ndarray) -> FlightRecord:
    """Give a record with these columns, one of which is the time, and zeros in all others."""
    zeros = {
        name: np.zeros((len(columns["time"]), *SHAPES.get(name, (3,))), KINDS.get(name, np.float64))
        for name in FlightLog.__annotations__
        if name not in OPTIONAL_COLUMNS
    }
    return FlightRecord(header, **{**zeros, **columns})


class Invented(Flight):
    """A flight whose summary is what it was given."""

    def __init__(self, scenario: Scenario, summary: dict[str, Any], **columns: np.ndarray):
        object.__setattr__(self, "scenario", scenario)
        object.__setattr__(self, "record", record_of({}, **columns))
        object.__setattr__(self, "told", summary)

    def summary(self) -> dict[str, Any]:
        """Give what it was given."""
        return self.told
