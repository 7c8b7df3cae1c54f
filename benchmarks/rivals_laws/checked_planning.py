"""Asking `openscvx` for plans: the problem round a target, the check of every plan, what is counted, and replanning."""

import threading
import time
from typing import TYPE_CHECKING

import jax
import numpy as np

from keepout.core.errors import ControlError
from rivals_laws.convexified_plan import Nodes, Plan, Planner, Task, integrated
from rivals_laws.envelopes import shape_to_keep_out_of
from rivals_laws.observed import Plant, linearised
from rivals_laws.plan_tracking import Tracker
from rivals_laws.rival_case import RivalCase

if TYPE_CHECKING:
    from rivals_laws.convexified import Convexified


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
        self.shape, operation = shape_to_keep_out_of(case, rival.shape)
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


def shifted(task: Task, nodes: Nodes, now: float) -> Nodes:
    """Give the rest of a plan from the time `now` (s) on, on as many nodes, its time beginning at 0."""
    times, position, velocity = integrated(task, nodes)
    at = np.linspace(now, nodes[-1, 0], len(nodes))
    moved = np.stack([np.interp(at, times, column) for column in np.hstack([position, velocity]).T], axis=1)
    held = nodes[np.clip(np.searchsorted(nodes[:, 0], at, side="right") - 1, 0, len(nodes) - 1), 7:]
    return np.hstack([at[:, None] - now, moved, held])
