"""Flight: one step shared by single flights and campaigns, and an independent audit."""

from keepout.flight.loop import FlightLog, LoopState, fly
from keepout.flight.outcome import FlightOutcome, outcome
from keepout.flight.setup import Faults, FlightSetup, NoFaults

__all__ = ["Faults", "FlightLog", "FlightOutcome", "FlightSetup", "LoopState", "NoFaults", "fly", "outcome"]
