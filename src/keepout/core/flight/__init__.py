"""Flight: one step shared by single flights and campaigns, and an independent audit."""

from keepout.core.flight.loop import FlightLog, FlightOutcome, LoopState, fly, outcome
from keepout.core.flight.setup import Faults, FlightSetup, NoFaults

__all__ = ["Faults", "FlightLog", "FlightOutcome", "FlightSetup", "LoopState", "NoFaults", "fly", "outcome"]
