"""How long each control step of a flight takes, in a process of its own.

There JAX runs the compiled step on the calling thread (`flight.on_board`), which has to be said before JAX starts, and
nothing else of a reproduction takes the processor.
"""

import gc
import multiprocessing
import time
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from keepout.apps.reproduction.side_by_side import side_by_side
from keepout.apps.reproduction.usual_way import TorchField, UsualWay
from keepout.core.control.controller import Controller
from keepout.core.control.profiles import ControlWarning
from keepout.core.errors import ControlError
from keepout.core.fields.model import FieldModel
from keepout.core.fields.neural import NeuralField
from keepout.core.flight.on_board import OnBoard
from keepout.core.mission.build import Mission, load_target, prepare
from keepout.core.mission.scenario import Scenario
from keepout.core.motion.relative import MotionState
from keepout.core.progress import Progress, silent

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

    """

    name: str
    scenario: Scenario
    usual: bool = False
    field: Path | None = None
    idle: tuple[int, int] | None = None


@dataclass(frozen=True)
class Timed:
    """What a contender's flight gave: seconds of each control step, the positions, and steps without a solution."""

    seconds: Float[np.ndarray, "steps"]
    position: Float[np.ndarray, "rows 3"]
    unsolved: int


def time_apart(contenders: Sequence[Contender]) -> list[Timed]:
    """Fly contenders one after another in a new process, and time their steps."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(time_here, list(contenders)).result()


def time_here(contenders: Sequence[Contender]) -> list[Timed]:
    """Make contenders ready side by side, then fly one after another; to be called before JAX has started."""
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    # The same law is flown in the process that asked, which says what its constants violate.
    warnings.simplefilter("ignore", ControlWarning)

    def job(contender: Contender) -> Callable[[Progress], Callable[[], Timed]]:
        return lambda _: ready(contender)

    flights = side_by_side({contender.name: job(contender) for contender in contenders}, silent)
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
        return lambda: _flown(usual.step, mission, advance, lambda: usual.unsolved)
    on_board = OnBoard(setup, start)
    on_board.step(0.0, np.asarray(start.position), np.asarray(start.velocity))

    def flown() -> Timed:
        on_board.restart(start)
        return _flown(on_board.step, mission, advance, lambda: 0)

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


def _flown(
    step: Step, mission: Mission, advance: Callable[[MotionState, Array], MotionState], unsolved: Callable[[], int]
) -> Timed:
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
    return Timed(seconds, np.stack([*positions, np.asarray(state.position)]), unsolved())
