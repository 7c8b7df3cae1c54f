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
import threading
import time
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Float, Int

from keepout.control.guidance.geodesic import require_free
from keepout.control.guidance.guidance import GeodesicGuidance
from keepout.errors import ControlError
from keepout.motion.relative import MotionState, RelativeMotion
from rivals_laws.convexified_plan import Nodes, Plan, Planner, Task, guess_along, integrated, straight_guess
from rivals_laws.envelopes import ellipsoid_field
from rivals_laws.observed import ObservedLaw, Plant
from rivals_laws.rival import Rival
from rivals_laws.rival_case import Point, RivalCase

Vector = Float[Array, "3"]
Reference = Float[Array, "steps 9"]
"""Position (m), velocity (m/s) and mean acceleration over the coming period (m/s²), a row a control step."""


class Tracker(eqx.Module):
    """LQR feedback of position and velocity errors: 1/s² and 1/s."""

    position: Float[Array, ""]
    velocity: Float[Array, ""]

    @classmethod
    def tuned(cls, period: float, authority: float) -> "Tracker":
        """Tune it by Bryson's rule: 5 cm, 1 cm/s and the authority (m/s²) weigh alike."""
        transition, push = np.array([[1.0, period], [0.0, 1.0]]), np.array([[0.5 * period**2], [period]])
        weights, effort = np.diag([0.05**-2, 0.01**-2]), np.array([[authority**-2]])
        cost = scipy.linalg.solve_discrete_are(transition, push, weights, effort)
        gain = np.linalg.solve(effort + push.T @ cost @ push, push.T @ cost @ transition)[0]
        return cls(*(jnp.asarray(number) for number in gain))

    def acceleration(self, row: Float[Array, "9"], estimate: MotionState) -> Vector:
        """Follow one row of a reference."""
        off, slip = row[:3] - estimate.position, row[3:6] - estimate.velocity
        return row[6:] + self.position * off + self.velocity * slip


class PlannedLaw(ObservedLaw):
    """Tracks a reference made before the flight; its last row is at rest at the goal."""

    plant: Plant
    tracker: Tracker
    towards: Vector
    reference: Reference
    wait: float

    @property
    def goal(self) -> Vector:
        """Where the plan ends, m."""
        return self.towards

    def initial_memory(self, state: MotionState) -> Int[Array, ""]:
        """Start at the first row."""
        return jnp.zeros((), jnp.int32)

    def acceleration(self, own, estimate: MotionState):
        """Follow the row of this step."""
        row = self.reference[jnp.minimum(own, len(self.reference) - 1)]
        near = jnp.sum((row[:3] - estimate.position) ** 2) < self.wait**2
        return own + near, self.tracker.acceleration(row, estimate)


class Memory(eqx.Module):
    """Of a `ReplannedLaw`: steps flown, the step at which the reference begins, the plan and its part flown now."""

    count: Int[Array, ""]
    begun: Int[Array, ""]
    nodes: Float[Array, "nodes 10"]
    reference: Reference


class ReplannedLaw(ObservedLaw):
    """Tracks a plan that is made anew as it flies; `replan` runs on the host."""

    plant: Plant
    tracker: Tracker
    towards: Vector
    nodes: Float[Array, "nodes 10"]
    reference: Reference
    replan: "Replanning" = eqx.field(static=True)

    @property
    def goal(self) -> Vector:
        """Where every plan ends, m."""
        return self.towards

    def initial_memory(self, state: MotionState) -> Memory:
        """Start on the first plan."""
        zero = jnp.zeros((), jnp.int32)
        return Memory(zero, zero, self.nodes, self.reference)

    def acceleration(self, own: Memory, estimate: MotionState):
        """Follow the plan, after asking for a new one where it is time."""
        kept = (own.begun, own.nodes, own.reference)
        begun, nodes, reference = jax.pure_callback(
            self.replan,
            jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), kept),
            own.count,
            estimate.position,
            estimate.velocity,
            self.towards,
            *kept,
            vmap_method="sequential",
        )
        own = Memory(own.count + 1, begun, nodes, reference)
        return own, self.tracker.acceleration(reference[own.count - 1 - begun], estimate)


class Book:
    """What planning did, for the row's note."""

    def __init__(self):
        self._lock, self._entries = threading.Lock(), []

    def add(self, seconds: float, converged: bool, refusal: str | None) -> None:
        """Note one plan."""
        with self._lock:
            self._entries.append((seconds, converged, refusal))

    def clear(self) -> None:
        """Begin a new page."""
        with self._lock:
            self._entries = []

    def tell(self, what: str) -> str:
        """Say how many plans there were, how they ended, and how long they took."""
        with self._lock:
            entries = list(self._entries)
        if not entries:
            return ""
        seconds, converged, refusals = zip(*entries, strict=True)
        failed = [refusal.partition(":")[0] for refusal in refusals if refusal is not None]
        said = f"{len(entries)} {what}: {sum(converged)} converged, {len(failed)} not flown"
        said += "".join(f" ({failed.count(kind)} {kind})" for kind in sorted(set(failed)))
        return f"{said}, {np.median(seconds):.1f} s each (median), {max(seconds):.0f} s at most"


class Planning:
    """Plans round one target: the solver's process, the check of its plans, and the book of both."""

    def __init__(self, case: RivalCase, rival: "Convexified"):
        plant, motion = Plant.of(case), case.operation.motion
        operation = case.operation
        if rival.shape == "ellipsoid":
            operation = dataclasses.replace(operation, error_bound=0.0)
            self.shape = ellipsoid_field(case.target.vertices)
        else:
            self.shape = case.model.field
        by_position, by_velocity = linearised(motion)
        diagonal = float(np.linalg.norm(case.upper - case.lower))
        self.task = Task(
            shape=jax.tree.map(np.asarray, self.shape),
            keep_out=operation.keep_out,
            lower=case.lower - 10.0,
            upper=case.upper + 10.0,
            by_position=by_position,
            by_velocity=by_velocity,
            acceleration=float(plant.authority),
            speed=float(plant.speed_limit),
            longest=float(case.seconds),
            nodes=int(np.clip(round(diagonal / rival.metres_a_node), 20, 40)),
            cost_weight=rival.time_weight,
            iterations=rival.iterations,
        )
        self.period, self.miss, self.dip = operation.period, rival.miss_m, rival.dip_m
        self.planner = Planner(self.task)
        self.tracker = Tracker.tuned(operation.period, float(plant.authority))

    def plan(self, book: Book, position: np.ndarray, velocity: np.ndarray, goal: np.ndarray, guess: Nodes) -> Nodes:
        """Plan and check.

        Raises:
            ControlError: the library failed, or its plan does not pass the check; the message begins with the kind.

        """
        began, converged, refusal = time.perf_counter(), False, None
        try:
            # A state a little beyond the speed limit has no plan within it.
            speed = float(np.linalg.norm(velocity))
            slowed = velocity * min(1.0, 0.999 * self.task.speed / max(speed, 1e-9))
            found = self.planner.plan(position, slowed, goal, guess)
            converged, refusal = found.converged, self._refusal(found, goal)
        except RuntimeError as failure:
            refusal = f"plan failed: {failure}"
        book.add(time.perf_counter() - began, converged, refusal)
        if refusal is not None:
            raise ControlError(refusal)
        return found.nodes

    def _refusal(self, found: Plan, goal: np.ndarray) -> str | None:
        if not np.all(np.isfinite(found.nodes)):
            return "plan not finite: the solver gave no numbers"
        _, position, _ = integrated(self.task, found.nodes)
        miss = float(np.linalg.norm(position[-1] - goal))
        if miss > self.miss:
            return f"plan misses the goal: by {miss:.3g} m when integrated, at most {self.miss:g} m are flown"
        inside = self.task.keep_out - found.lowest
        if not inside <= self.dip:
            return f"plan enters the zone: by {inside:.3g} m, at most {self.dip:g} m are flown"
        return None

    def reference(self, nodes: Nodes, goal: np.ndarray, first: int, steps: int) -> np.ndarray:
        """Sample a plan at `steps` control steps from the `first` on; beyond its end it rests at the goal."""
        times, position, velocity = integrated(self.task, nodes)
        wanted = self.period * (first + np.arange(steps + 1))
        beyond = wanted > times[-1]
        rows = [np.interp(wanted, times, column) for column in np.hstack([position, velocity]).T]
        sampled = np.stack(rows, axis=1)
        sampled[beyond] = np.concatenate([goal, np.zeros(3)])
        push = np.diff(sampled[:, 3:], axis=0) / self.period
        return np.hstack([sampled[:-1], push])


class Replanning:
    """The host's side of a `ReplannedLaw`."""

    def __init__(self, planning: Planning, every: int):
        self.planning, self.every, self.book = planning, every, Book()

    def __call__(self, count, position, velocity, goal, begun, nodes, reference):
        """Give the step at which the reference begins, the plan, and the reference: new ones where it is time."""
        if count - begun < self.every:
            return begun, nodes, reference
        planning = self.planning
        count, position, velocity, goal, nodes = map(np.asarray, (count, position, velocity, goal, nodes))
        now = float(count) * planning.period
        left = nodes[-1, 0] - now
        if left > self.every * planning.period:
            guess = shifted(planning.task, nodes, now)
            try:
                found = planning.plan(self.book, position, velocity, goal, guess)
                nodes = np.hstack([found[:, :1] + now, found[:, 1:]])
            except ControlError:  # counted in the book: the last plan stays in force
                pass
        return count, nodes, planning.reference(nodes, goal, int(count), self.every + 1)


def linearised(motion: RelativeMotion) -> tuple[np.ndarray, np.ndarray]:
    """Give the derivatives of the drift by position (1/s²) and velocity (1/s) at the target and the orbit's epoch."""
    rest = motion.initial_state(np.zeros(3), np.zeros(3))

    def drift(position, velocity):
        moved = eqx.tree_at(lambda s: (s.position, s.velocity), rest, (position, velocity))
        return motion.drift_acceleration(moved)

    by_position, by_velocity = jax.jacfwd(drift, argnums=(0, 1))(rest.position, rest.velocity)
    return np.asarray(by_position), np.asarray(by_velocity)


def shifted(task: Task, nodes: Nodes, now: float) -> Nodes:
    """Give the rest of a plan from the time `now` (s) on, on as many nodes, its time beginning at 0."""
    times, position, velocity = integrated(task, nodes)
    at = np.linspace(now, nodes[-1, 0], len(nodes))
    moved = np.stack([np.interp(at, times, column) for column in np.hstack([position, velocity]).T], axis=1)
    held = nodes[np.clip(np.searchsorted(nodes[:, 0], at, side="right") - 1, 0, len(nodes) - 1), 7:]
    return np.hstack([at[:, None] - now, moved, held])


@eqx.filter_jit
def _steps_along(guidance: GeodesicGuidance, start: Vector, step: float, count: int) -> Float[Array, "count 3"]:
    def advance(position, _):
        heading = guidance.desired_velocity(position)
        moved = position + step * heading / (jnp.sqrt(jnp.sum(heading**2)) + 1e-12)
        return moved, moved

    return jax.lax.scan(advance, start, length=count)[1]


def geodesic_way(case: RivalCase, start: Point, goal: Point) -> np.ndarray:
    """Give Keepout's geodesic from start to goal as points, m."""
    way = np.asarray(_steps_along(case.geodesic(start, goal), jnp.asarray(start), 0.1, 3000))
    near = np.linalg.norm(way - goal, axis=1)
    return np.vstack([start, way[: int(np.argmin(near)) + 1], goal])


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


@dataclasses.dataclass(frozen=True)
class PlannedOnceGeodesic(Convexified):
    """Keepout's field, and its geodesic as the guess."""

    name: ClassVar[str] = "SCvx once (geodesic guess)"
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
