"""What a flight that is led leg by leg leaves."""

from dataclasses import dataclass
from typing import Any

from keepout.core.audit.audit import Audit, Contact
from keepout.core.flight.loop import FlightOutcome
from keepout.core.flight.record import FlightRecord
from keepout.core.geometry.target import Target
from keepout.core.mission.flight import Flight
from keepout.core.mission.scenario import Scenario


@dataclass(frozen=True, eq=False)
class Led:
    """A flight that was led leg by leg, and how it ended.

    Attributes:
        flight: what was flown, and the audit's verdict.
        outcome: how it ended.
        why: in words.
        seconds: that the computation took.

    """

    flight: Flight
    outcome: str
    why: str
    seconds: float

    @property
    def scenario(self) -> Scenario:
        """As it was flown."""
        return self.flight.scenario

    @property
    def target(self) -> Target:
        """The true mesh."""
        return self.flight.target

    @property
    def record(self) -> FlightRecord:
        """Of the whole flight."""
        return self.flight.record

    @property
    def flown(self) -> FlightOutcome:
        """What became of it."""
        return self.flight.outcome

    @property
    def audit(self) -> Audit:
        """The verdict on the true mesh."""
        return self.flight.audit

    @property
    def start_certified(self) -> bool | None:
        """Whether the guard's theorem holds from the start; None without a guard."""
        return self.flight.start_certified

    @property
    def assumptions_broken(self) -> tuple[str, ...]:
        """What is flown beyond what the scenario declares."""
        return self.flight.assumptions_broken

    @property
    def guard(self) -> dict[str, Any] | None:
        """What the guard assumes and what follows, as numbers; None without a guard."""
        return self.flight.guard

    def contact_said(self, on: str = "") -> str:
        """Say what the audit says of contact, and how far the chaser stayed away `on` the mesh, in words."""
        words = {"no": "No contact, proved", "yes": "Contact", "undecided": "Contact not excluded"}
        said = words[str(self.audit.contact)]
        if self.audit.contact is Contact.NO:
            said += f": the clearance{on} is at least {self.audit.minimum_clearance:.3f} m"
        return said

    def contact_figures(self) -> dict[str, Any]:
        """Give what the audit says, as plain numbers: `contact` is true unless it proves that there was none."""
        return {
            "contact": self.audit.contact is not Contact.NO,
            "contact_verdict": str(self.audit.contact),
            "minimum_clearance_m": self.audit.minimum_clearance,
        }
