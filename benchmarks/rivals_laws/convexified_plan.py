"""Successive convexification by `openscvx`, in a process of its own: a plan from a state to rest at the goal.

The library asks for two settings of the whole process: its default `float_dtype="float32"` switches JAX's 64 bits off,
and its integrators only export if `EQX_ON_ERROR` is "nan" before equinox is imported. A process of its own keeps both
away from the flight loop; it also runs JAX while the loop waits in a callback, where JAX must not be called.

Controls are held between nodes: the library's own default, first-order hold (0.5.2), interpolates by τN over an
interval of 1/(N - 1), so that each interval ends beyond the next node's control and its plans, integrated, miss the
goal by decimetres. Its default tolerance of integration, 1e-3, is coarser than the 1e-4 that it bounds a violation by.

Units inside: metres and hundreds of seconds. The library scales a variable by half its range but never by less than
one, so metres a second and newtons would stay unscaled beside metres.
"""

import contextlib
import dataclasses
import itertools
import multiprocessing
import os
import threading
import time
from typing import Any

import numpy as np
from jaxtyping import Float

TIME = 100.0
"""One unit of time, s."""
SUBSTEPS = 40
"""Between two nodes, where a plan is integrated by itself."""
STRICTNESS = 10.0
"""The library bounds ∫ max(0, g)² between nodes by 1e-4; g in decimetres makes that a centimetre or two."""

Nodes = Float[np.ndarray, "nodes 10"]
"""Time (s), position (m) and velocity (m/s) of each node, and the thrusters' acceleration (m/s²) held from it on."""


@dataclasses.dataclass(frozen=True)
class Task:
    """What is the same for all plans round a target, in SI units.

    Attributes:
        shape: a field or envelope, with `value(points)`.
        keep_out: value of the shape, m, to stay above.
        lower, upper: of the positions, m.
        by_position, by_velocity: the linearised drift: 1/s² and 1/s.
        acceleration: limit of each axis, m/s².
        speed: limit, m/s.
        longest: of a plan, s.
        nodes: of a plan.
        cost_weight: the library's `lam_cost`.
        iterations: the library's `k_max`.

    """

    shape: Any
    keep_out: float
    lower: np.ndarray
    upper: np.ndarray
    by_position: np.ndarray
    by_velocity: np.ndarray
    acceleration: float
    speed: float
    longest: float
    nodes: int
    cost_weight: float
    iterations: int


@dataclasses.dataclass(frozen=True)
class Plan:
    """A solution: its nodes, whether the library calls it converged, and the least value of the shape on it, m.

    The value is of the plan as integrated, and is asked here: the flight loop must not, inside a callback.
    """

    nodes: Nodes
    converged: bool
    lowest: float


def straight_guess(task: Task, position: np.ndarray, velocity: np.ndarray, goal: np.ndarray) -> Nodes:
    """Give the guess of the library's examples: states on a straight line, no control."""
    return guess_along(task, np.linspace(position, goal, task.nodes), velocity)


def guess_along(task: Task, way: Float[np.ndarray, "n 3"], velocity: np.ndarray) -> Nodes:
    """Give a guess along a way, at 0.7 of the speed limit; no control."""
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))])
    total = max(lengths[-1], 1e-3)
    along = np.linspace(0.0, total, task.nodes)
    position = np.stack([np.interp(along, lengths, way[:, i]) for i in range(3)], axis=1)
    duration = total / (0.7 * task.speed) + 30.0
    speeds = np.gradient(position, np.linspace(0.0, duration, task.nodes), axis=0)
    speeds[0], speeds[-1] = velocity, 0.0
    time = np.linspace(0.0, duration, task.nodes)[:, None]
    return np.hstack([time, position, speeds, np.zeros((task.nodes, 3))])


def integrated(task: Task, nodes: Nodes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Integrate a plan from its first node by Runge–Kutta, with none of its later states.

    Returns times (n,) s, positions and velocities (n, 3).
    """

    def slope(state, acceleration):
        drift = task.by_position @ state[:3] + task.by_velocity @ state[3:]
        return np.concatenate([state[3:], drift + acceleration])

    state, kept, times = nodes[0, 1:7], [nodes[0, 1:7]], [nodes[:1, 0]]
    for before, after in itertools.pairwise(nodes):
        h = (after[0] - before[0]) / SUBSTEPS
        for _ in range(SUBSTEPS):
            k1 = slope(state, before[7:])
            k2 = slope(state + 0.5 * h * k1, before[7:])
            k3 = slope(state + 0.5 * h * k2, before[7:])
            k4 = slope(state + h * k3, before[7:])
            state = state + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
            kept.append(state)
        times.append(before[0] + h * np.arange(1, SUBSTEPS + 1))
    flown = np.array(kept)
    return np.concatenate(times), flown[:, :3], flown[:, 3:]


class Solver:
    """The library's problem, compiled once; lives in the planner's process."""

    def __init__(self, task: Task):
        import jax
        import jax.numpy as jnp
        import openscvx as ox

        self.task = task
        n, speed, longest = task.nodes, task.speed * TIME, task.longest / TIME
        thrust = task.acceleration * TIME**2
        shape = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), task.shape)

        def state(name, lower, upper):
            made = ox.State(name, shape=(3,))
            made.min, made.max = np.broadcast_to(lower, 3).copy(), np.broadcast_to(upper, 3).copy()
            # Until the first plan the library compiles here: not at the middle, where a distance may have no slope.
            made.initial = made.final = 0.25 * made.min + 0.75 * made.max
            made.guess = np.tile(made.initial, (n, 1))
            return made

        self.position = state("position", task.lower, task.upper)
        self.velocity = state("velocity", -speed, speed)
        self.acceleration = ox.Control("acceleration", shape=(3,), parameterization="ZOH")
        self.acceleration.min, self.acceleration.max = np.full(3, -thrust), np.full(3, thrust)
        self.acceleration.guess = np.zeros((n, 3))
        self.time = ox.Time(
            initial=0.0,
            final=ox.Minimize(0.5 * longest),
            min=0.0,
            max=longest,
            time_dilation_min=0.01,
            time_dilation_max=3.0 * longest,
        )
        drift = ox.Constant(task.by_position * TIME**2) @ self.position
        drift = drift + ox.Constant(task.by_velocity * TIME) @ self.velocity

        def keep_out(x, u, node, parameters):
            return STRICTNESS * (task.keep_out - shape.value(x[self.position.slice][None])[0])

        def too_fast(x, u, node, parameters):
            v = x[self.velocity.slice]
            return STRICTNESS * 0.5 * (v @ v / speed - speed)

        self.problem = ox.Problem(
            dynamics={"position": self.velocity, "velocity": drift + self.acceleration},
            constraints=[],
            states=[self.position, self.velocity],
            controls=[self.acceleration],
            N=n,
            time=self.time,
            byof={"ctcs_constraints": [{"constraint_fn": keep_out}, {"constraint_fn": too_fast}]},
            algorithm={"k_max": task.iterations, "lam_cost": task.cost_weight},
            discretizer={"diffrax_kwargs": {"atol": 1e-6}},
            float_dtype="float64",
        )
        self._value = jax.jit(lambda points: shape.value(points))
        self.problem.settings.dev.printing = False
        self.problem.initialize()

    def solve(self, position: np.ndarray, velocity: np.ndarray, goal: np.ndarray, guess: Nodes) -> Plan:
        """Plan from a state to rest at the goal."""
        self.position.initial, self.position.final = position, goal
        self.velocity.initial, self.velocity.final = velocity * TIME, np.zeros(3)
        time = guess[:, 0] / TIME
        self.time.guess = time
        self.time.time_dilation_guess = (len(time) - 1) * np.diff(time, append=2.0 * time[-1] - time[-2])
        self.position.guess, self.velocity.guess = guess[:, 1:4], guess[:, 4:7] * TIME
        self.acceleration.guess = guess[:, 7:10] * TIME**2
        self.problem.reset()
        found = self.problem.solve()
        state = found.nodes
        columns = (state["time"] * TIME, state["position"], state["velocity"] / TIME, state["acceleration"] / TIME**2)
        nodes = np.hstack(columns).astype(float)
        lowest = float(self._value(integrated(self.task, nodes)[1]).min())
        return Plan(nodes, bool(found.converged), lowest)


def serve(connection, task: Task) -> None:
    """Answer requests until the other side is gone; an exception is an answer too."""
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
        try:
            solver = Solver(task)
        except Exception as failure:
            connection.send(_line(failure))
            return
        connection.send(None)
        while True:
            try:
                request = connection.recv()
            except EOFError:
                return
            try:
                answer = solver.solve(*request)
            except Exception as failure:
                answer = _line(failure)
            connection.send(answer)


def _line(failure: Exception) -> str:
    """Say it in one line: the library's messages may hold whole matrices."""
    return f"{type(failure).__name__}: {str(failure).partition(chr(10))[0][:200]}"


class Planner:
    """The other side of `serve`: one plan at a time, for as long as this process lives.

    Raises:
        RuntimeError: the library refused the problem; its message.

    """

    def __init__(self, task: Task):
        began = time.perf_counter()
        self.task = task
        self._lock = threading.Lock()
        context = multiprocessing.get_context("spawn")
        self._connection, other = context.Pipe()
        kept = os.environ.get("EQX_ON_ERROR")
        os.environ["EQX_ON_ERROR"] = "nan"
        try:
            context.Process(target=serve, args=(other, task), daemon=True).start()
        finally:
            if kept is None:
                del os.environ["EQX_ON_ERROR"]
            else:
                os.environ["EQX_ON_ERROR"] = kept
        other.close()
        failure = self._connection.recv()
        if failure is not None:
            raise RuntimeError(f"openscvx: {failure}")
        self.seconds = time.perf_counter() - began
        """To start the process and compile the problem."""

    def plan(self, position: np.ndarray, velocity: np.ndarray, goal: np.ndarray, guess: Nodes) -> Plan:
        """Plan; blocks until the answer is there.

        Raises:
            RuntimeError: the library raised; its message.

        """
        with self._lock:
            self._connection.send((position, velocity, goal, guess))
            answer = self._connection.recv()
        if isinstance(answer, str):
            raise RuntimeError(f"openscvx: {answer}")
        return answer
