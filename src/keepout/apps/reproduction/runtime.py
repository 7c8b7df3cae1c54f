"""The paper's computation time (section VI.C.2), and flights of its law with a true cone.

How long each control step takes is measured in a process of its own. There JAX runs the compiled step on the calling
thread (`flights.on_board`), which has to be said before JAX starts, and nothing else of a reproduction takes the
processor.

Beside it the paper's law is timed as it is written the usual way: PyTorch for the field, CVXPY with Clarabel for the
program, else NumPy. That needs the extra `bench`. Every step builds nothing anew: the network and the program are made
once, the program with parameters.
"""

import functools
import gc
import importlib
import importlib.util
import itertools
import multiprocessing
import platform
import time
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from keepout.apps.reproduction.figures import draw_step_times
from keepout.apps.reproduction.fitted import PAPER_NETWORK, paper_network, target_of
from keepout.apps.reproduction.flown import kept_flight, trapped
from keepout.apps.reproduction.work import Part, Table, Work, side_by_side
from keepout.core.control.controller import Controller
from keepout.core.control.guidance import ComponentwiseGuidance
from keepout.core.control.observer import ContinuousObserver
from keepout.core.control.profiles import ControlWarning
from keepout.core.control.velocity import ConstantCirculation
from keepout.core.errors import ControlError
from keepout.core.fields.model import FieldModel
from keepout.core.fields.neural import NeuralField
from keepout.core.geometry.target import Target
from keepout.core.mission.build import Mission, load_target, prepare
from keepout.core.mission.flight import Flight
from keepout.core.mission.scenario import Scenario
from keepout.core.motion.relative import MotionState
from keepout.core.progress import Progress, silent
from keepout.flights.on_board import OnBoard

Vector = Float[np.ndarray, "3"]

PACKAGES = ("cvxpy", "torch")


def missing_extra() -> str | None:
    """Say how to get what is missing of the extra `bench`; None where nothing is."""
    missing = [name for name in PACKAGES if importlib.util.find_spec(name) is None]
    if not missing:
        return None
    return f"not run: {', '.join(missing)} not installed; pip install 'keepout-gnc[bench]'"


class TorchField:
    """A learned field's value and gradient by PyTorch's autograd on one thread, within the ball that it was learned on.

    Args:
        field: gives weights and units.
        idle: hidden layers and their width of a further network of random weights, which is evaluated for its cost
            only and changes nothing.

    """

    def __init__(self, field: NeuralField, *, idle: tuple[int, int] | None = None) -> None:
        self._torch: Any = importlib.import_module("torch")
        self._torch.set_num_threads(1)
        self._centre = np.asarray(field.continuation.centre)
        self._reach = float(field.continuation.target_radius)
        self._scale = float(field.scale)
        weights = [np.asarray(weight, np.float32) for weight in field.layers.weights]
        biases = [np.asarray(bias, np.float32) for bias in field.layers.biases]
        self._net = self._network(weights, biases, field.beta)
        self._idle = None
        if idle is not None:
            layers, width = idle
            draw = np.random.default_rng(0)
            sizes = [3, *[width] * layers, 1]
            random = [
                (draw.normal(size=(after, before)) / np.sqrt(before)).astype(np.float32)
                for before, after in itertools.pairwise(sizes)
            ]
            self._idle = self._network(random, [np.zeros(size, np.float32) for size in sizes[1:]], field.beta)

    def _network(self, weights: list[np.ndarray], biases: list[np.ndarray], beta: float) -> Any:
        torch, layers = self._torch, []
        for weight, bias in zip(weights, biases):
            layer = torch.nn.Linear(weight.shape[1], weight.shape[0])
            with torch.no_grad():
                layer.weight.copy_(torch.tensor(weight))
                layer.bias.copy_(torch.tensor(bias))
            layers += [layer, torch.nn.Softplus(beta)]
        return torch.nn.Sequential(*layers[:-1])

    def value_and_gradient(self, position: Vector) -> tuple[float, Vector]:
        """Return the distance, m, and its gradient.

        Raises:
            ControlError: the position lies outside the ball that the network was learned on.

        """
        away = position - self._centre
        if np.linalg.norm(away) > self._reach:
            raise ControlError(
                f"usual way: {position.tolist()} m lies more than {self._reach:.3g} m from the target's centre, where "
                "the network was not learned"
            )
        if self._idle is not None:
            self._differentiated(self._idle, away / self._scale)
        value, gradient = self._differentiated(self._net, away / self._scale)
        return value * self._scale, gradient

    def _differentiated(self, network: Any, at: Vector) -> tuple[float, Vector]:
        point = self._torch.tensor(at, dtype=self._torch.float32, requires_grad=True)
        value = network(point)[0]
        (gradient,) = self._torch.autograd.grad(value, point)
        return float(value.detach()), gradient.numpy().astype(float)


class UsualWay:
    """The law of `profiles.paper` in NumPy, with the numbers of a law built there.

    The change of the safe velocity is its difference over the last period, where the law here has its derivative.

    Args:
        law: gives every constant; it must be of the paper's profile, on a target fixed to a circular orbit.
        field: distance and gradient.
        period: s.
        orbital_rate: of the target, rad/s.

    """

    def __init__(self, law: Controller, field: TorchField, *, period: float, orbital_rate: float) -> None:
        guidance, circulation = law.velocity.guidance, law.velocity.circulation
        if (
            not isinstance(guidance, ComponentwiseGuidance)
            or not isinstance(circulation, ConstantCirculation)
            or not isinstance(law.observer, ContinuousObserver)
            or law.velocity.box is None
        ):
            raise ControlError("usual way: only the paper's profile, with its own guidance, circulation and observer")
        self._field, self._period, self._rate = field, period, orbital_rate
        self._goal, self._speed = np.asarray(guidance.goal), float(guidance.speed)
        self._length = float(guidance.slowing_length)
        self._offset, self._alpha = float(law.velocity.offset), float(law.velocity.class_k.rate)
        self._omega = np.asarray(circulation.omega)
        self._level, self._slope = float(circulation.level), float(circulation.slope)
        self._tracking = {
            name: np.asarray(value) for name, value in vars(law.tracking).items() if name != "acceleration_limit"
        }
        self._observer = {name: np.asarray(value) for name, value in vars(law.observer).items()}
        self._mass, self._limit = float(law.mass), np.asarray(law.force_limit)
        error = law.velocity.gradient_error
        self._pose(float(law.velocity.box), float(circulation.weight), 0.0 if error is None else float(error))
        self._estimate: Float[np.ndarray, " q"] | None = None
        self._before: tuple[Vector, Vector, Vector, Vector] | None = None
        self.unsolved = 0

    def _pose(self, box: float, weight: float, error: float) -> None:
        cvxpy: Any = importlib.import_module("cvxpy")
        self._clarabel = cvxpy.CLARABEL
        self._velocity, relaxation = cvxpy.Variable(3), cvxpy.Variable()
        self._desired, self._normal, self._tangent = (cvxpy.Parameter(3) for _ in range(3))
        self._barrier_rate, self._turn = cvxpy.Parameter(), cvxpy.Parameter()
        barrier = self._normal @ self._velocity + self._barrier_rate
        constraints = [
            barrier >= (error * cvxpy.norm(self._velocity) if error else 0.0),
            self._tangent @ self._velocity - self._turn >= relaxation,
            self._velocity <= box,
            self._velocity >= -box,
        ]
        cost = 0.5 * cvxpy.sum_squares(self._desired - self._velocity) + weight * cvxpy.square(relaxation)
        self._program = cvxpy.Problem(cvxpy.Minimize(cost), constraints)

    def safe_velocity(self, position: Vector) -> tuple[float, Vector, Vector]:
        """Return h (m), ∇f̃ and the safe velocity (m/s); where the solver finds none, zero, counted in `unsolved`."""
        value, normal = self._field.value_and_gradient(position)
        barrier = value - self._offset
        self._desired.value = -self._speed * np.tanh((position - self._goal) / self._length)
        self._normal.value = normal
        self._tangent.value = self._omega @ normal
        self._barrier_rate.value = self._alpha * barrier
        self._turn.value = self._level - self._slope * barrier
        self._program.solve(solver=self._clarabel)
        if self._velocity.value is None:
            self.unsolved += 1
            return barrier, normal, np.zeros(3)
        return barrier, normal, np.asarray(self._velocity.value)

    def drift(self, position: Vector, velocity: Vector) -> Vector:
        """Return the acceleration without force, m/s²: Clohessy and Wiltshire's, in the paper's axes."""
        n = self._rate
        return np.array(
            [
                2.0 * n * velocity[2],
                -n * n * position[1],
                3.0 * n * n * position[2] - 2.0 * n * velocity[0],
            ]
        )

    def step(self, time: float, position: Vector, velocity: Vector) -> Vector:
        """Return the force to hold over the coming period, N."""
        position, velocity = np.asarray(position, float), np.asarray(velocity, float)
        drift = self.drift(position, velocity)
        disturbance = self._observe(velocity, drift)
        barrier, normal, safe = self.safe_velocity(position)
        change = np.zeros(3) if self._before is None else (safe - self._before[3]) / self._period
        force = self._tracked(barrier, normal, safe, change, position, velocity, drift) - disturbance
        force = np.clip(force, -self._limit, self._limit)
        self._before = velocity, drift, force, safe
        return force

    def _observe(self, velocity: Vector, drift: Vector) -> Vector:
        o = self._observer
        gain = o["gain"]
        if self._before is None or self._estimate is None:
            self._estimate = -gain @ velocity
        else:
            before, drift_before, force, _ = self._before
            error = o["generator"] - gain @ o["output"] / self._mass
            constant = error @ gain @ before - gain @ (0.5 * (drift_before + drift) + force / self._mass)
            self._estimate = (
                o["transition"] @ self._estimate
                + o["held"] @ constant
                + o["ramp"] @ (error @ gain @ (velocity - before))
            )
        return o["output"] @ (self._estimate + gain @ velocity)

    def _tracked(
        self,
        barrier: float,
        normal: Vector,
        safe: Vector,
        change: Vector,
        position: Vector,
        velocity: Vector,
        drift: Vector,
    ) -> Vector:
        """Return u, N: the tracking layer with the smooth safety filter (paper, section V-B)."""
        t = self._tracking
        error = velocity - safe
        feedback = -t["lyapunov_ratio"] * (t["position_weight"] @ (position - self._goal)) - 0.5 * t["gain"] * error
        reference = self._mass * (change - drift + feedback)
        gradient = -error / (self._mass * t["barrier_ratio"])
        b = float(gradient @ gradient)
        if b <= 1e-24:
            return reference
        a = (
            -error @ feedback / t["barrier_ratio"]
            + normal @ velocity
            - t["gradient_error"] * np.linalg.norm(velocity)
            + t["barrier_rate"] * (barrier - error @ error / (2.0 * t["barrier_ratio"]))
            - b / (2.0 * t["estimation_weight"] * (2.0 * t["estimation_rate"] - t["barrier_rate"]))
        )
        return reference + np.logaddexp(0.0, -t["sharpness"] * a / b) / t["sharpness"] * gradient


PAPER = (
    "A control step, the cone program and the neural field's inference, stays below 10 ms throughout the flight, with "
    "CVXPY on an Intel Core i7-12700F and an NVIDIA GeForce RTX 2080 SUPER. The cone's e_∇h is not printed."
)
LIMIT = 10.0
"""The paper's, ms."""

TIMED_ERROR = 0.2
"""e_∇h of the flights whose steps are timed: a true cone program, as the paper solves."""
NETWORK = (10, 512)
"""The paper's: hidden layers and their width."""

_NO_FIELD = "no such field: give --fields with one of the paper's network"

Step = Callable[[float, Float[np.ndarray, "3"], Float[np.ndarray, "3"]], Float[np.ndarray, "3"]]


@dataclass(frozen=True)
class Contender:
    """A way to run a law: what flies, and by what.

    Attributes:
        name: of its row.
        scenario: what it flies.
        usual: whether it runs the usual way (`usual_way`), else on board as Keepout does.
        field: a field file instead of the scenario's.
        idle: a further network that is evaluated for its cost only; see `TorchField`.
        missing: why it cannot run here; None where it can.

    """

    name: str
    scenario: Scenario
    usual: bool = False
    field: Path | None = None
    idle: tuple[int, int] | None = None
    missing: str | None = None


@dataclass(frozen=True)
class Timed:
    """What a contender's flight gave: seconds of each control step, the positions, and steps without a solution."""

    seconds: Float[np.ndarray, "steps"]
    position: Float[np.ndarray, "rows 3"]
    unsolved: int = 0


def runtime(work: Work) -> Part:
    """Time control steps over a flight, and fly the law with a true cone."""
    target = target_of("intelsat30")
    network = paper_network(work, target)
    timed = step_rows(work.within(0.1, 0.5), network)
    cone = cone_rows(work.within(0.5, 0.95), target, network)
    times = [row for row, _ in timed]
    drawn = {
        row["contender"]: (np.arange(float(len(seconds))), 1e3 * seconds)
        for row, seconds in timed
        if seconds is not None
    }
    draw_step_times(work.folder / "step-times.png", drawn, limit=LIMIT)
    return Part(
        name="runtime",
        title="Computation time, and the law with a true cone",
        paper=PAPER,
        ours=found(times, cone),
        rows=[{"table": "step times", **row} for row in times] + [{"table": "true cone", **row} for row in cone],
        tables=[
            Table("step-times", "One control step, one thread, over Case 1's flight at 1 Hz", times),
            Table(
                "true-cone",
                "Case 1, printed constants, 1 Hz, 0.1 N, by e_∇h; trapped: at rest outside the tolerance; clearance by "
                "the audit on the exact mesh",
                cone,
            ),
        ],
        drawings={"step-times": "Time of each control step over the flight; thick: its median"},
    )


def contenders(work: Work, network: FieldModel | None) -> list[Contender]:
    """Give what is timed: Keepout's step and the usual way, on the same mission."""
    flown = Scenario().replace(seed=work.seed, duration=600.0)
    printed = flown.replace(
        name="printed", control={"profile": "paper", "paper": {"gradient_error": TIMED_ERROR}}, guard={"enabled": False}
    )
    missing = missing_extra()
    usual = functools.partial(Contender, scenario=printed, usual=True, missing=missing)
    made = [
        Contender("Keepout: default law and guard, shipped field", flown.replace(name="default")),
        Contender("Keepout: printed constants, shipped field", printed),
    ]
    if not work.quick:
        made.append(usual("usual way: printed constants, shipped field"))
    if network is not None:
        # With its certificate, for the process that times; a folder that was named is not written to.
        file = PAPER_NETWORK.path(work.folder / "fields", network.target_name)
        file.parent.mkdir(parents=True, exist_ok=True)
        network.save(file)
        made.append(Contender("Keepout: printed constants, 10 x 512", printed, field=file))
        return [*made, usual("usual way: printed constants, 10 x 512", field=file)]
    made.append(usual("usual way: printed constants, 10 x 512", idle=NETWORK))
    if not work.quick:
        made.append(Contender("Keepout: printed constants, 10 x 512", printed, missing=_NO_FIELD))
    return made


def step_rows(work: Work, network: FieldModel | None) -> list[tuple[dict[str, Any], np.ndarray | None]]:
    """Time every contender; one that cannot run here has a row whose note says why, and no times."""
    every = contenders(work, network)
    run = [contender for contender in every if contender.missing is None]

    def make() -> dict[str, np.ndarray]:
        answers = enumerate(time_apart(run))
        return {f"{place}-{name}": value for place, timed in answers for name, value in vars(timed).items()}

    made_of = {
        "contenders": [
            {
                **{key: str(value) for key, value in vars(contender).items() if key != "scenario"},
                "scenario": contender.scenario.model_dump(mode="json"),
            }
            for contender in run
        ],
        "network": None if network is None else network.sha256,
        "machine": platform.machine(),
    }
    arrays = work.arrays("step-times", made_of, make)
    work.progress(1.0, "steps timed")
    answers = {
        contender.name: Timed(arrays[f"{place}-seconds"], arrays[f"{place}-position"], int(arrays[f"{place}-unsolved"]))
        for place, contender in enumerate(run)
    }
    timed = [(contender, answers.get(contender.name)) for contender in every]
    return [(_step_row(contender, of), None if of is None else of.seconds) for contender, of in timed]


def _step_row(contender: Contender, timed: Timed | None) -> dict[str, Any]:
    figures = ("steps", "median_ms", "p99_ms", "max_ms", "above_10_ms", "final_error_m", "unsolved")
    if timed is None:
        return {"contender": contender.name, **dict.fromkeys(figures), "note": contender.missing}
    taken = 1e3 * timed.seconds
    error = np.linalg.norm(timed.position[-1] - np.asarray(contender.scenario.goal.position))
    note = ""
    if contender.idle is not None:
        note = "10 x 512 network of random weights evaluated for its cost; values by the shipped field"
    values = (
        *(len(taken), float(np.median(taken)), float(np.quantile(taken, 0.99)), float(taken.max())),
        *(int((taken > LIMIT).sum()), float(error), timed.unsolved),
    )
    return {"contender": contender.name, **dict(zip(figures, values)), "note": note}


def cone_rows(work: Work, target: Target, network: FieldModel | None) -> list[dict[str, Any]]:
    """Fly Case 1 with the printed constants for several e_∇h."""
    errors = (TIMED_ERROR,) if work.quick else (0.0, 0.1, 0.2, 0.3, 0.4)
    base = Scenario().replace(seed=work.seed, duration=600.0 if work.quick else 1500.0, guard={"enabled": False})
    jobs: dict[str, Callable[[Progress], Flight]] = {}
    for kind, model in (("shipped", None), ("network", network)):
        if kind == "network" and model is None:
            continue
        for error in errors:
            control = {"profile": "paper", "paper": {"gradient_error": error}}
            scenario = base.replace(name=f"cone-{kind}-{error:g}", control=control)
            jobs[scenario.name] = functools.partial(kept_flight, work, scenario, target, model=model)
    flights = side_by_side(jobs, work.progress)
    return [_cone_row(flight) for flight in flights.values()]


def _cone_row(flight: Flight) -> dict[str, Any]:
    goal, record, summary = flight.scenario.goal, flight.record, flight.summary()
    return {
        "field": "10 x 512" if flight.scenario.name.startswith("cone-network") else "shipped",
        "gradient_error": flight.scenario.control.paper.gradient_error,
        "reached": bool(summary["reached"]),
        "trapped": trapped(record.time, record.position, np.asarray(goal.position), goal.tolerance),
        "time_to_reach_s": summary["time_to_reach_s"],
        "final_error_m": summary["final_error_m"],
        "end_m": [round(float(x), 3) for x in record.position[-1]],
        "minimum_h_m": float(record.barrier.min()),
        "minimum_clearance_m": summary["minimum_clearance_m"],
        "contact": summary["contact_verdict"],
    }


def found(times: Sequence[dict[str, Any]], cone: Sequence[dict[str, Any]]) -> list[str]:
    """Say in plain sentences what the rows show."""
    said = [
        f"Timed is the whole step from the estimate to the force, on one thread of this machine's processor, with "
        f"e_∇h = {TIMED_ERROR:g} so that the printed law solves a true cone program. The usual way is the same law in "
        "NumPy, with CVXPY and Clarabel for the program and PyTorch's autograd for the field, program and network made "
        "once."
    ]
    for row in times:
        if row["median_ms"] is None:
            said.append(f"{row['contender']}: {row['note']}.")
            continue
        said.append(
            f"{row['contender']}: {row['median_ms']:.3g} ms in the median, {row['p99_ms']:.3g} ms at the 99th "
            f"percentile, {row['max_ms']:.3g} ms at most; {row['above_10_ms']} of {row['steps']} steps above "
            f"{LIMIT:g} ms; {row['final_error_m']:.2g} m from the goal at the end."
        )
    for field in dict.fromkeys(row["field"] for row in cone):
        own = [row for row in cone if row["field"] == field]
        arrived = ", ".join(f"{row['gradient_error']:g}" for row in own if row["reached"]) or "none"
        stuck = ", ".join(f"{row['gradient_error']:g}" for row in own if row["trapped"]) or "none"
        moving = [f"{row['gradient_error']:g}" for row in own if not row["reached"] and not row["trapped"]]
        said.append(
            f"Case 1 with the printed constants at 1 Hz and 0.1 N by the {field} field: it arrives with e_∇h = "
            f"{arrived}; it is trapped with {stuck}"
            + (f"; it neither arrives nor rests with {', '.join(moving)}." if moving else ".")
        )
    return said


def time_apart(contenders: Sequence[Contender]) -> list[Timed]:
    """Fly contenders one after another in a new process, and time their steps."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(time_here, list(contenders)).result()


def time_here(contenders: Sequence[Contender]) -> list[Timed]:
    """Make contenders ready side by side, then fly one after another; to be called before JAX has started."""
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    # The same law is flown in the process that asked, which says what its constants violate.
    warnings.simplefilter("ignore", ControlWarning)

    jobs = {contender.name: lambda _, contender=contender: ready(contender) for contender in contenders}
    flights = side_by_side(jobs, silent)
    return [fly() for fly in flights.values()]


def ready(contender: Contender) -> Callable[[], Timed]:
    """Build and compile what a contender needs; the answer flies it in a closed loop and times its steps."""
    target = load_target(contender.scenario.target)
    model = None if contender.field is None else FieldModel.load(contender.field, target=target)
    mission = prepare(contender.scenario, target=target, model=model)
    start, setup = mission.initial, mission.setup
    advance = eqx.filter_jit(
        lambda state, force: setup.motion.step(
            state, setup.thrusters.apply(force), setup.disturbance, setup.period, setup.mass
        )
    )
    jax.block_until_ready(advance(start, jnp.zeros(3)))
    if contender.usual:
        usual = usual_way(mission, idle=contender.idle)
        usual.safe_velocity(np.asarray(start.position))  # CVXPY compiles its problem
        usual.unsolved = 0
        return lambda: replace(_flown(usual.step, mission, advance), unsolved=usual.unsolved)
    on_board = OnBoard(setup, start)
    on_board.step(0.0, np.asarray(start.position), np.asarray(start.velocity))

    def flown() -> Timed:
        on_board.restart(start)
        return _flown(on_board.step, mission, advance)

    return flown


def usual_way(mission: Mission, *, idle: tuple[int, int] | None = None) -> UsualWay:
    """Write a mission's law the usual way.

    Raises:
        ControlError: not the paper's profile by a neural field.

    """
    law, field = mission.setup.controller, mission.model.field
    if not isinstance(law, Controller) or not isinstance(field, NeuralField):
        raise ControlError("usual way: only the paper's profile, by a neural field")
    orbit = mission.setup.motion.orbit
    rate = float(np.sqrt(orbit.gravitational_parameter / orbit.semi_major_axis**3))
    return UsualWay(law, TorchField(field, idle=idle), period=mission.scenario.control.period, orbital_rate=rate)


def _flown(step: Step, mission: Mission, advance: Callable[[MotionState, Array], MotionState]) -> Timed:
    state, seconds, positions = mission.initial, np.empty(mission.steps), []
    gc.collect()
    gc.disable()
    try:
        for k in range(mission.steps):
            now, position, velocity = float(state.time), np.asarray(state.position), np.asarray(state.velocity)
            positions.append(position)
            begin = time.perf_counter()
            force = step(now, position, velocity)
            seconds[k] = time.perf_counter() - begin
            state = advance(state, jnp.asarray(force))
    finally:
        gc.enable()
    return Timed(seconds, np.stack([*positions, np.asarray(state.position)]))
