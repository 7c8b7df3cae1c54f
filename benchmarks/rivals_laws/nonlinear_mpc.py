"""Nonlinear MPC (`casadi`, IPOPT): every second the coming 80 s are planned by multiple shooting, the first one flown.

Dynamics: the flight loop's relative motion linearised about the target in its body frame (Clohessy–Wiltshire), exact
for forces held over an interval. Cost: the distance to the goal, rounded within a metre of it so that it is quadratic
there, summed over the nodes, ten times at the last, and a little effort. Bounds: each axis' acceleration within what
disturbance and drift leave; speed limit and keep-out zone at the nodes (never between them), both softened by an exact
penalty so that a state a millimetre inside has a plan; at rest at the last node, so that each plan ends where the
chaser can wait and the next has one too. The keep-out zone is the learned field, or the smallest ellipsoid, as a cubic
B-spline on a grid (`field_spline.py`), with IPOPT's exact second derivatives.

The first guess is a straight line at rest, or Keepout's geodesic; after that each solve begins at the last answer,
moved on by a period, with its multipliers. An answer counts where IPOPT succeeded or its constraints hold to
`violation_m`; otherwise the last plan that counted is flown on, to its end at rest, and the failure is counted by
IPOPT's own status.
"""

import dataclasses
import threading
import time
from collections import Counter
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Float, Int

from keepout.core.control.barrier_grid import require_free
from keepout.core.fields.field import values
from keepout.core.motion.relative import MotionState
from rivals_laws.envelopes import shape_to_keep_out_of
from rivals_laws.field_spline import FieldSpline
from rivals_laws.geodesic_way import geodesic_way
from rivals_laws.observed import ObservedLaw, Plant, linearised
from rivals_laws.rival import Rival
from rivals_laws.rival_case import Point, RivalCase

Vector = Float[Array, "3"]

GOOD = ("Solve_Succeeded", "Solved_To_Acceptable_Level")
PENALTY = 1000.0
"""Of a metre inside, or of ten centimetres a second too fast: above any multiplier of the rounded distances' sum."""


class Memory(eqx.Module):
    """The last answer and its multipliers, and the accelerations of the last that counted with its age in steps."""

    answer: Float[Array, " w"]
    bound_multipliers: Float[Array, " w"]
    multipliers: Float[Array, " g"]
    accelerations: Float[Array, "nodes 3"]
    age: Int[Array, ""]


class PredictiveLaw(ObservedLaw):
    """Asks `solver`, on the host, for each step's acceleration."""

    plant: Plant
    towards: Vector
    guess: Float[Array, " w"]
    by_position: Float[Array, "3 3"]
    by_velocity: Float[Array, "3 3"]
    solver: "Solver" = eqx.field(static=True)

    @property
    def goal(self) -> Vector:
        """Where it leads, m."""
        return self.towards

    def initial_memory(self, state: MotionState) -> Memory:
        """Start from the guess."""
        nodes, rows = self.solver.nodes, self.solver.rows
        zeros = (jnp.zeros_like(self.guess), jnp.zeros(rows), jnp.zeros((nodes, 3)))
        return Memory(self.guess, *zeros, jnp.zeros((), jnp.int32))

    def acceleration(self, own: Memory, estimate: MotionState):
        """Solve and give the first acceleration, with the drift that the base takes off again."""
        shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), own)
        own, pushed = jax.pure_callback(
            self.solver.step,
            (shapes, jax.ShapeDtypeStruct((3,), jnp.float64)),
            own,
            jnp.concatenate([estimate.position, estimate.velocity]),
            self.towards,
            vmap_method="sequential",
        )
        return own, pushed + self.by_position @ estimate.position + self.by_velocity @ estimate.velocity


class Solver:
    """The program, built once a case, and the count of what became of its solves."""

    def __init__(self, case: RivalCase, rival: "NonlinearMPC"):
        import casadi

        plant, self.nodes = Plant.of(case), rival.nodes
        self.shape, operation = shape_to_keep_out_of(case, rival.shape)
        self.keep_out, self.violation = operation.keep_out, rival.violation_m
        self.every = round(rival.interval_s / operation.period)
        self.limit, self.speed = float(plant.authority), float(plant.speed_limit)
        lower, upper = case.lower - 3.0, case.upper + 3.0
        self.spline = FieldSpline.interpolating(lambda p: values(self.shape, p), lower, upper, rival.spacing_m)
        self.by_position, self.by_velocity = linearised(operation.motion)
        self._lock, self._statuses, self._seconds = threading.Lock(), Counter(), []
        self._program(casadi, rival, lower, upper)

    def _program(self, casadi: Any, rival: "NonlinearMPC", lower: np.ndarray, upper: np.ndarray) -> None:
        n = self.nodes
        block = np.zeros((9, 9))
        block[:3, 3:6] = np.eye(3)
        block[3:6, :3], block[3:6, 3:6], block[3:6, 6:] = self.by_position, self.by_velocity, np.eye(3)
        moved = scipy.linalg.expm(rival.interval_s * block)[:6]
        knots = [list(axis) for axis in self.spline.knots]
        coefficients = self.spline.coefficients.ravel(order="F")
        distance = casadi.Function.bspline("distance", knots, coefficients, [3, 3, 3], 1, {})

        states, pushes = casadi.MX.sym("x", 6, n), casadi.MX.sym("u", 3, n)
        inside, speeding = casadi.MX.sym("s", 1, n), casadi.MX.sym("z", 1, n)
        first, goal = casadi.MX.sym("x0", 6), casadi.MX.sym("goal", 3)
        before = casadi.horzcat(first, states[:, :-1])
        defects = states - (moved[:, :6] @ before + moved[:, 6:] @ pushes)
        off = states[:3, :] - casadi.repmat(goal, 1, n)
        rounded = casadi.sqrt(casadi.sum1(off**2) + 1.0) - 1.0
        away = distance.map(n)(states[:3, :]) + inside
        fast = casadi.sum1(states[3:, :] ** 2) / self.speed - speeding
        cost = casadi.sum2(rounded) + 9.0 * rounded[-1] + rival.effort * casadi.sumsqr(pushes / self.limit)
        cost += PENALTY * (casadi.sum2(inside) + casadi.sum2(speeding) / 0.1)
        flat = [casadi.reshape(part, -1, 1) for part in (states, pushes, inside, speeding)]
        rows = [casadi.reshape(part, -1, 1) for part in (defects, away, fast)]
        program = {"x": casadi.vertcat(*flat), "g": casadi.vertcat(*rows), "p": casadi.vertcat(first, goal), "f": cost}
        quiet = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes"}
        warm = {"ipopt.warm_start_init_point": "yes", "ipopt.mu_init": 1e-3, "ipopt.warm_start_bound_push": 1e-6}
        limits = {"ipopt.tol": 1e-5, "ipopt.max_iter": rival.iterations}
        self._solve = casadi.nlpsol("nmpc", "ipopt", program, quiet | warm | limits)

        infinite = np.full(3, np.inf)
        low, high = np.tile(np.concatenate([lower, -infinite]), n), np.tile(np.concatenate([upper, infinite]), n)
        low[-3:] = high[-3:] = 0.0  # at rest at the last node
        thrust, slack = np.full(3 * n, self.limit), np.zeros(2 * n)
        self._bounds = {
            "lbx": np.concatenate([low, -thrust, slack]),
            "ubx": np.concatenate([high, thrust, np.full(2 * n, np.inf)]),
            "lbg": np.concatenate([np.zeros(6 * n), np.full(n, self.keep_out), np.full(n, -np.inf)]),
            "ubg": np.concatenate([np.zeros(6 * n), np.full(n, np.inf), np.full(n, self.speed)]),
        }
        self.rows = 8 * n

    def answer_of(self, positions: Float[np.ndarray, "nodes 3"]) -> np.ndarray:
        """Give a guess: these positions, at rest."""
        states = np.hstack([positions, np.zeros_like(positions)])
        return np.concatenate([states.ravel(), np.zeros(5 * self.nodes)])

    def step(self, own: Memory, state: np.ndarray, goal: np.ndarray) -> tuple[Memory, np.ndarray]:
        """Solve from a state; give the memory for the next step and the acceleration (m/s²) for this one."""
        own = jax.tree.map(np.asarray, own)
        parameters = np.concatenate([np.asarray(state), np.asarray(goal)])
        with self._lock:
            began = time.perf_counter()
            found = self._solve(
                x0=own.answer,
                lam_x0=own.bound_multipliers,
                lam_g0=own.multipliers,
                p=parameters,
                **self._bounds,
            )
            status = self._solve.stats()["return_status"]
            self._seconds.append(time.perf_counter() - began)
            counts = status in GOOD or self._holds(found)
            said = "" if status in GOOD else " but feasible" if counts else ": last plan flown on"
            self._statuses[status + said] += 1
        if not counts:
            # The next solve begins anew from the last answer, without the multipliers that led nowhere.
            age = own.age + 1
            index = int(age) // self.every
            pushed = own.accelerations[index] if index < self.nodes else np.zeros(3)
            zeros = (np.zeros_like(own.bound_multipliers), np.zeros_like(own.multipliers))
            return Memory(own.answer, *zeros, own.accelerations, np.asarray(age, np.int32)), pushed
        answer = np.asarray(found["x"]).ravel()
        pushes = answer[6 * self.nodes : 9 * self.nodes].reshape(self.nodes, 3)
        multipliers = (np.asarray(found[name]).ravel() for name in ("lam_x", "lam_g"))
        return Memory(self._moved(answer), *multipliers, pushes, np.zeros((), np.int32)), pushes[0].copy()

    def _holds(self, found: dict) -> bool:
        """Say whether an answer's constraints hold."""
        answer, rows = np.asarray(found["x"]).ravel(), np.asarray(found["g"]).ravel()
        bounds = self._bounds
        broken = [bounds["lbx"] - answer, answer - bounds["ubx"], bounds["lbg"] - rows, rows - bounds["ubg"]]
        return bool(np.all(np.isfinite(answer)) and max(part.max() for part in broken) <= self.violation)

    def _moved(self, answer: np.ndarray) -> np.ndarray:
        """Move an answer on by one period: a share of an interval."""
        n, share = self.nodes, 1.0 / self.every
        parts = np.split(answer, [6 * n, 9 * n, 10 * n])
        shifted = []
        for part in parts:
            rows = part.reshape(n, -1)
            shifted.append(((1.0 - share) * rows + share * np.vstack([rows[1:], rows[-1:]])).ravel())
        return np.concatenate(shifted)

    def tell(self) -> str:
        """Say how the solves since the last telling ended and how long they took; begins a new count."""
        with self._lock:
            statuses, seconds = self._statuses, self._seconds
            self._statuses, self._seconds = Counter(), []
        if not seconds:
            return ""
        said = ", ".join(f"{count} {status}" for status, count in statuses.most_common())
        median, worst = (1e3 * np.quantile(seconds, share) for share in (0.5, 0.99))
        return f"{len(seconds)} solves ({said}), {median:.0f} ms median, {worst:.0f} ms at the 99th percentile"


@dataclasses.dataclass(frozen=True)
class NonlinearMPC(Rival):
    """On Keepout's field, first guess straight."""

    name: ClassVar[str] = "NMPC"
    choices: ClassVar[dict[str, tuple[float, ...]]] = {"nodes": (12, 20, 30), "effort": (0.02, 0.1)}
    swept: ClassVar[int] = 8
    packages: ClassVar[tuple[str, ...]] = ("casadi",)
    batch: ClassVar[int] = 10
    shape: str = "field"
    guess: str = "straight"
    nodes: int = 20
    interval_s: float = 4.0
    effort: float = 0.02
    spacing_m: float = 0.25
    iterations: int = 60
    violation_m: float = 1e-3

    def flights(self, target: str) -> int | None:
        """Give few: every control step is a nonlinear program."""
        return 5 if target == "iss" else 10

    def solver(self, case: RivalCase) -> Solver:
        """Give the program, built once a case."""
        return case.once(("nmpc", self), lambda: Solver(case, self))

    def note(self, case: RivalCase) -> str:
        """Say how the solves went, and how near the spline is to the field where it matters."""
        solver = self.solver(case)
        error, count = case.once(("nmpc spline", self), lambda: self._spline_error(case))
        spline = f"spline {solver.spline.spacing:.2f} m, at most {error:.3f} m off at {count} points near the zone"
        return ", ".join(filter(None, (solver.tell(), spline)))

    def _spline_error(self, case: RivalCase) -> tuple[float, int]:
        """Measure the spline against the shape within half a metre of the zone's edge."""
        import scipy.interpolate

        solver = self.solver(case)
        points = np.random.default_rng(0).uniform(case.lower, case.upper, (400_000, 3))
        truth = values(solver.shape, points)
        near = np.abs(truth - solver.keep_out) < 0.5
        spline = scipy.interpolate.NdBSpline(solver.spline.knots, solver.spline.coefficients, 3)
        return float(np.abs(spline(points[near]) - truth[near]).max()), int(near.sum())

    def law(self, case: RivalCase, start: Point, goal: Point) -> PredictiveLaw:
        """Make the first guess; all else happens in flight."""
        solver, plant = self.solver(case), Plant.of(case)
        for name, end in (("start", start), ("goal", goal)):
            require_free(solver.shape, solver.keep_out, end, name)
        way = geodesic_way(case, start, goal) if self.guess == "geodesic" else np.stack([start, goal])
        lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))])
        along = 0.7 * solver.speed * self.interval_s * np.arange(1, self.nodes + 1)
        ahead = np.stack([np.interp(along, lengths, column) for column in way.T], axis=1)
        drift = case.once(
            ("nmpc drift", self), lambda: (jnp.asarray(solver.by_position), jnp.asarray(solver.by_velocity))
        )
        return PredictiveLaw(plant, jnp.asarray(goal), jnp.asarray(solver.answer_of(ahead)), *drift, solver)


@dataclasses.dataclass(frozen=True)
class NonlinearMPCGeodesic(NonlinearMPC):
    """On Keepout's field, first guess along its geodesic."""

    name: ClassVar[str] = "NMPC (geodesic guess)"
    choices: ClassVar[dict[str, tuple[float, ...]]] = {}
    guess: str = "geodesic"


@dataclasses.dataclass(frozen=True)
class NonlinearMPCEllipsoid(NonlinearMPC):
    """Round the smallest ellipsoid."""

    name: ClassVar[str] = "NMPC (ellipsoid)"
    choices: ClassVar[dict[str, tuple[float, ...]]] = {}
    shape: str = "ellipsoid"


RIVALS = (NonlinearMPC(), NonlinearMPCGeodesic(), NonlinearMPCEllipsoid())
