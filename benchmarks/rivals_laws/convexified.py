"""Successive convexification (`openscvx`, penalised trust region): a whole way planned at once, then tracked.

The plan: least time from the start to rest at the goal. Dynamics: the flight loop's relative motion, linearised about
the target in its body frame (Clohessy–Wiltshire), forces held between nodes. The keep-out zone and the speed limit hold
continuously, by the library's own constraint states (`ctcs`). The thrust of each axis is what disturbance and drift
leave (the authority of `control/tuning.py`), so that the tracker has the rest. Weights, iterations and tolerances are
the library's, but for the weight of time, 0.1 as in its example `proxops_cw`: with the default 0.01 its iterations end
at 0.8 of the speed limit.

Each plan is integrated again by Runge–Kutta before it is flown. One that ends more than `miss_m` beside the goal, or
dips by more than `dip_m` (half the margin) into the zone, refuses the pair, as an operator would. Whether the library
called it converged decides nothing and is counted in the row's note.

The tracker: the plan's acceleration, and LQR feedback of a double integrator at the control period, weighted by
Bryson's rule (5 cm, 1 cm/s, the authority). The reference waits where the chaser is more than `wait_m` away from it (a
guard may hold it), else it would be chased beyond the speed limit. Drift and disturbance are compensated as in every
rival. After the plan's end the tracker holds the goal.

Replanned: every `every_s` seconds the same problem from the state at that time, the rest of the last plan as its guess.
A replan that fails or does not pass the check leaves the last plan in force, and is counted. Nothing is replanned in
the last `every_s` seconds of a plan.
"""

import dataclasses
import time
from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from keepout.core.control.barrier_grid import require_free
from keepout.core.errors import ControlError
from rivals_laws.checked_planning import Book, Planning, Replanning
from rivals_laws.convexified_plan import Nodes, guess_along, straight_guess
from rivals_laws.geodesic_way import geodesic_way
from rivals_laws.observed import Plant
from rivals_laws.plan_tracking import PlannedLaw, ReplannedLaw
from rivals_laws.rival import Rival
from rivals_laws.rival_case import Point, RivalCase


@dataclasses.dataclass(frozen=True)
class Convexified(Rival):
    """A plan a flight, tracked."""

    packages: ClassVar[tuple[str, ...]] = ("openscvx",)
    batch: ClassVar[int] = 32
    shape: str = "field"
    guess: str = "straight"
    metres_a_node: float = 2.5
    time_weight: float = 0.1
    iterations: int = 200
    miss_m: float = 0.05
    dip_m: float = 0.05
    wait_m: float = 0.3

    def planning(self, case: RivalCase) -> Planning:
        """Give the planning round a target: the solver is compiled once a case and shape."""
        name = ("planning", self.shape, self.metres_a_node, self.time_weight, self.iterations, self.miss_m, self.dip_m)
        return case.once(name, lambda: Planning(case, self))

    def book(self, case: RivalCase) -> Book:
        """Give the book of the plans from starts, which rows with and without guard share."""
        return case.once(("book", self), Book)

    def flights(self, target: str) -> int | None:
        """Give fewer than others: a plan takes seconds."""
        return 50

    def note(self, case: RivalCase) -> str:
        """Say how the planning went."""
        planning = self.planning(case)
        compiled = f"{planning.task.nodes} nodes, compiled once in {planning.planner.seconds:.0f} s"
        return ", ".join(filter(None, (compiled, self.book(case).tell("plans"))))

    def nodes(self, case: RivalCase, start: Point, goal: Point) -> Nodes:
        """Plan one pair, once for all rows.

        Raises:
            KeepoutError: an end lies in the zone, no geodesic leads to a guess, or there is no plan that can be flown.

        """
        planning = self.planning(case)
        for name, end in (("start", start), ("goal", goal)):
            require_free(planning.shape, planning.task.keep_out, end, name)
        began, rest = time.perf_counter(), np.zeros(3)

        def made() -> tuple[Nodes | ControlError, float]:
            guess = straight_guess(planning.task, start, rest, goal)
            if self.guess == "geodesic":
                guess = guess_along(planning.task, geodesic_way(case, start, goal), rest)
            try:
                found = planning.plan(self.book(case), start, rest, goal, guess)
            except ControlError as refusal:
                found = refusal
            return found, time.perf_counter() - began

        name = ("plan", self, start.tobytes(), goal.tobytes())
        found, seconds = case.once(name, made)
        case.seconds_spared += max(0.0, seconds - (time.perf_counter() - began))
        if isinstance(found, ControlError):
            raise found
        return found

    def law(self, case: RivalCase, start: Point, goal: Point) -> PlannedLaw:
        """Plan, and track the plan."""
        planning, nodes = self.planning(case), self.nodes(case, start, goal)
        steps = round(case.seconds / planning.period) + 1
        reference = planning.reference(nodes, goal, 0, steps)
        return PlannedLaw(Plant.of(case), planning.tracker, jnp.asarray(goal), jnp.asarray(reference), self.wait_m)


@dataclasses.dataclass(frozen=True)
class PlannedOnce(Convexified):
    """Keepout's field, and the straight guess of the library's examples."""

    name: ClassVar[str] = "SCvx once"
    choices: ClassVar[dict[str, tuple[float, ...]]] = {"metres_a_node": (2.5, 1.25), "time_weight": (0.03, 0.1, 0.3)}
    swept: ClassVar[int] = 16


@dataclasses.dataclass(frozen=True)
class PlannedOnceGeodesic(Convexified):
    """Keepout's field, and its geodesic as the guess."""

    name: ClassVar[str] = "SCvx once (geodesic guess)"
    choices: ClassVar[dict[str, tuple[float, ...]]] = PlannedOnce.choices
    swept: ClassVar[int] = 16
    guess: str = "geodesic"


@dataclasses.dataclass(frozen=True)
class PlannedOnceEllipsoid(Convexified):
    """The smallest ellipsoid."""

    name: ClassVar[str] = "SCvx once (ellipsoid)"
    shape: str = "ellipsoid"


@dataclasses.dataclass(frozen=True)
class Replanned(Convexified):
    """Keepout's field, planned anew as it flies."""

    name: ClassVar[str] = "SCvx replanned"
    batch: ClassVar[int] = 8
    every_s: float = 30.0

    def flights(self, target: str) -> int | None:
        """Give fewer still: every flight plans many times."""
        return 5 if target == "iss" else 10

    def replanning(self, case: RivalCase) -> Replanning:
        """Give the host's side, made once a case."""
        planning = self.planning(case)
        return case.once(("replanning", self), lambda: Replanning(planning, round(self.every_s / planning.period)))

    def note(self, case: RivalCase) -> str:
        """Say how the planning went before and in these flights, and begin a new page for the next row."""
        book = self.replanning(case).book
        said = ", ".join(filter(None, (super().note(case), book.tell("replans"))))
        book.clear()
        return said

    def law(self, case: RivalCase, start: Point, goal: Point) -> ReplannedLaw:
        """Plan, track, and plan again."""
        planning, nodes, replan = self.planning(case), self.nodes(case, start, goal), self.replanning(case)
        reference = planning.reference(nodes, goal, 0, replan.every + 1)
        arrays = (jnp.asarray(goal), jnp.asarray(nodes), jnp.asarray(reference))
        return ReplannedLaw(Plant.of(case), planning.tracker, *arrays, replan)


RIVALS = (PlannedOnce(), PlannedOnceGeodesic(), PlannedOnceEllipsoid(), Replanned())
