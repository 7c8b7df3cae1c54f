"""Law and guard led from place to place, around a mesh or a map: what is built once, and what each place costs."""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from keepout.core.control.barrier_grid import BarrierGrid
from keepout.core.control.controller import Controller
from keepout.core.control.geodesic import Geodesic
from keepout.core.control.law import Law
from keepout.core.fields.field import Field
from keepout.core.flight.navigation import Navigation
from keepout.core.flight.setup import FlightSetup
from keepout.core.guard.guard import Guard
from keepout.core.mission.law import law_on
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.core.motion.arrays import as_float64
from keepout.core.motion.relative import MotionState

Point = Float[np.ndarray, "3"]


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
        return dataclasses.replace(law, checked=())

    def setup(self, law: Law) -> FlightSetup:
        """Give the setup of a flight's first segment, the law's field logged."""
        chosen = {"field": self.field, "guard": self.guard, "navigation": self.navigation, "goal": law.goal}
        return Surroundings(self.scenario).setup(law, **chosen)

    def led_on(self, setup: FlightSetup, law: Law) -> FlightSetup:
        """Give the setup of a segment that another law leads, by the field and guard of now."""
        goal = as_float64(law.goal)
        return dataclasses.replace(setup, field=self.field, controller=law, guard=self.guard, goal=goal)


def moved(scenario: Scenario, start: Point, goal: Point) -> Scenario:
    """Give the scenario with another start and goal, (3,) m each."""
    return scenario.model_copy(
        update={
            name: entry.model_copy(update={"position": tuple(float(x) for x in point)})
            for name, entry, point in (("start", scenario.start, start), ("goal", scenario.goal, goal))
        }
    )
