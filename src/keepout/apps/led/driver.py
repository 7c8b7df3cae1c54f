"""A flight led leg by leg: look, take in, is it over, what next; then it is flown on for some rows, and looked again.

The loop is one for all applications; each gives what it does at every turn of it, as a `Leader`. The law and the guard
that fly from place to place, around a mesh or a map, are built once, as a `Leading`. What such a flight leaves is a
`Led`.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import numpy as np

from keepout.core.audit.audit import Audit, Contact
from keepout.core.control.barrier_grid import BarrierGrid
from keepout.core.control.controller import Controller
from keepout.core.control.geodesic import Geodesic
from keepout.core.control.law import Law
from keepout.core.fields.field import Field
from keepout.core.flight.loop import FlightLog, FlightOutcome, LoopState, begin, fly_segment, joined
from keepout.core.flight.navigation import Navigation
from keepout.core.flight.record import FlightRecord
from keepout.core.flight.setup import FlightSetup
from keepout.core.geometry.distance import Point
from keepout.core.geometry.target import Target
from keepout.core.guard.guard import Guard
from keepout.core.mission.flight import Flight, recorded
from keepout.core.mission.law import law_on
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings, broken_assumptions
from keepout.core.motion.arrays import as_float64
from keepout.core.motion.relative import MotionState
from keepout.core.progress import Progress
from keepout.flights.pages.page import contact_said


@dataclass(frozen=True, eq=False)
class Leading:
    """A scenario's law for any goal, and the guard that is the same for all goals.

    The grid of ways is made once; a goal costs the march over it. All laws have arrays of one shape, so one compiled
    program flies them all.

    Attributes:
        scenario: as the law is built for it; its start and goal do not matter.
        field: that the law flies by.
        error_bound: e_h, how far the field over-states the distance where the chaser touches, m.
        grid: of ways, which all goals share.
        reach: how far places to go to are from the body frame's origin, m; the law is tuned for it.
        nominal_offset: of the law beyond its keep-out zone, m.
        guard: or None.
        navigation: the sensors and both estimates, or None.
        initial: the true state at the start.
        start_certified: whether the guard's theorem holds from there; None without a guard.

    """

    scenario: Scenario
    field: Field
    error_bound: float
    grid: BarrierGrid
    reach: float
    nominal_offset: float
    guard: Guard | None
    navigation: Navigation | None
    initial: MotionState
    start_certified: bool | None

    @property
    def offset(self) -> float:
        """The field's value, m, below which the law does not lead."""
        scenario = self.scenario
        return self.error_bound + scenario.chaser.radius + scenario.safety.margin + self.nominal_offset

    def within_grid(self, position: Point) -> bool:
        """Whether a place (m) lies within the grid of ways: from beyond, the guidance leads back to it."""
        upper = self.grid.origin + self.grid.spacing * (np.array(self.grid.values.shape) - 1)
        return bool(np.all((position >= self.grid.origin) & (position <= upper)))

    def made(self, goal: Point, position: Point, *, from_start: bool, beyond: float = math.inf) -> Controller:
        """Make the scenario's law for a goal, without the scenario's delay and faults.

        Its design conditions are checked and not kept, as their numbers differ from goal to goal and would be part of
        the compiled program.

        Args:
            goal: (3,) m, where to go.
            position: (3,) m, where the chaser is.
            from_start: whether that must be free and connected to the goal.
            beyond: seconds of travel beyond which no way is made (`Geodesic`).

        Raises:
            ControlError: the goal is not free, or no way leads there; the message says what is missing.

        """
        law = law_on(
            moved(self.scenario, position, goal),
            self.field,
            self.error_bound,
            from_start=from_start,
            guidance=Geodesic(grid=self.grid, beyond=beyond),
            reach=self.reach,
            nominal_offset=self.nominal_offset,
        )
        return replace(law, checked=())

    def setup(self, law: Law) -> FlightSetup:
        """Give the setup of a flight's first segment, the law's field logged."""
        chosen = {"field": self.field, "guard": self.guard, "navigation": self.navigation, "goal": law.goal}
        return Surroundings(self.scenario).setup(law, **chosen)

    def led_on(self, setup: FlightSetup, law: Law) -> FlightSetup:
        """Give the setup of a segment that another law leads, by the field and guard of now."""
        goal = as_float64(law.goal)
        return replace(setup, field=self.field, controller=law, guard=self.guard, goal=goal)


def moved(scenario: Scenario, start: Point, goal: Point) -> Scenario:
    """Give the scenario with another start and goal, (3,) m each."""
    return scenario.model_copy(
        update={
            name: entry.model_copy(update={"position": tuple(float(x) for x in point)})
            for name, entry, point in (("start", scenario.start, start), ("goal", scenario.goal, goal))
        }
    )


_PATIENCE, _EXTRA = 3.0, 240.0
"""A place not reached after so many times the seconds that it should take, and so many seconds more, is given up."""


def given_up_at(begun: float, expected: float) -> float:
    """Say when a place is given up, s, that was begun to be flown to at a time (s) and should take so long (s)."""
    return begun + _PATIENCE * expected + _EXTRA


@dataclass(frozen=True, eq=False)
class Ended:
    """How a flight ended, and why in words."""

    outcome: str
    why: str


@dataclass(eq=False)
class LedFlight:
    """A flight as far as it was flown.

    Attributes:
        scenario: as flown.
        initial: the true state at the start.
        longest: segment, in control periods.
        setup: of the leg under way; None before the first.
        state: after the last row; None before the first leg.
        logs: of the segments flown.
        rows: flown.

    """

    scenario: Scenario
    initial: MotionState
    longest: int
    setup: FlightSetup | None = None
    state: LoopState | None = None
    logs: list[FlightLog] = field(default_factory=list)
    rows: int = 0

    def lead_on(self, setup: FlightSetup) -> None:
        """Let a setup lead from now on."""
        self.setup = setup
        if self.state is None:
            self.state = begin(setup, self.initial, jax.random.key(self.scenario.seed))

    def fly(self, rows: int) -> None:
        """Fly on."""
        self.state, log = self._segment(rows)
        self.logs.append(log)
        self.rows += rows

    def log(self, *, with_end: bool = False) -> FlightLog:
        """Give the rows flown, and one more of how it ended where that is asked for."""
        return joined([*self.logs, self._segment(1)[1]] if with_end else self.logs)

    def _segment(self, rows: int) -> tuple[LoopState, FlightLog]:
        assert self.setup is not None
        assert self.state is not None
        return fly_segment(self.setup, self.state, rows, longest=self.longest)

    @property
    def now(self) -> float:
        """Time of the state, s; 0 before the first leg."""
        return 0.0 if self.state is None else float(self.state.motion.time)

    @property
    def position(self) -> np.ndarray:
        """True position (3,) of the state, m."""
        return np.asarray((self.initial if self.state is None else self.state.motion).position)


def judged(scenario: Scenario, target: Target, setup: FlightSetup, log: FlightLog, certified: bool | None) -> Flight:
    """Give a setup's flight with the audit's verdict; its start is certified only where no assumption is broken."""
    standing = certified, broken_assumptions(scenario, target)
    return recorded(scenario, target, setup, log, Surroundings(scenario).flight_bounds, standing)


class Leader(ABC):
    """What an application does with a flight between its segments."""

    fewest = 1
    """Rows that are flown even where nothing is to be flown for: an audit needs a way."""

    @abstractmethod
    def look(self, flight: LedFlight) -> None:
        """Look, and take in what there is to see by the rows flown last, or from where the chaser is now."""

    @abstractmethod
    def ended(self, flight: LedFlight) -> Ended | None:
        """Say how the flight is over; None where it goes on."""

    @abstractmethod
    def onward(self, flight: LedFlight) -> FlightSetup | Ended | None:
        """Say what leads on, or that there is nothing more to fly for; None where the leg under way goes on."""

    @abstractmethod
    def resting(self) -> FlightSetup:
        """Give what the chaser rests by where there is nothing to fly for from the start."""

    @abstractmethod
    def next_rows(self, flight: LedFlight) -> int:
        """Say how many rows are flown before the next look."""

    @abstractmethod
    def told(self, flight: LedFlight) -> tuple[float, str]:
        """Give the share of the flight that is done, 0 to 1, and words for it."""


def lead(leader: Leader, flight: LedFlight, progress: Progress) -> Ended:
    """Lead a flight until it is over; give how it ended."""
    while True:
        leader.look(flight)
        ended = leader.ended(flight)
        if ended is None:
            onward = leader.onward(flight)
            if isinstance(onward, Ended):
                ended = onward
            elif onward is not None:
                flight.lead_on(onward)
        if ended is not None and flight.rows >= leader.fewest:
            return ended
        if flight.setup is None:
            flight.lead_on(leader.resting())
        flight.fly(leader.next_rows(flight))
        progress(*leader.told(flight))


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
        return contact_said(str(self.audit.contact), self.audit.minimum_clearance, f"the clearance{on}")

    def contact_figures(self) -> dict[str, Any]:
        """Give what the audit says, as plain numbers: `contact` is true unless it proves that there was none."""
        return {
            "contact": self.audit.contact is not Contact.NO,
            "contact_verdict": str(self.audit.contact),
            "minimum_clearance_m": self.audit.minimum_clearance,
            "measured_clearance_m": self.audit.measured_clearance,
        }
