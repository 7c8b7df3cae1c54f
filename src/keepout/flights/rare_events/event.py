"""How probable it is that a scenario's flight comes nearer to the target than a number: measured, never proved.

Subset simulation drives down the least clearance of flights that are flown by their tapes. The tape of a flight holds
all its random numbers as standard normals in one vector. A scenario's faults, its random disturbance and the spread of
its start each take a stretch of it. Numbers that are not normal are made from normals: a probability by the normal
distribution function, a direction by dividing by the length.

The clearance of a flight is the audit's lower bound on the least distance from the chaser's surface to the mesh at any
instant (`audit.tube`), at most a millimetre and b T²/8 below the truth; so a flight counted as without contact has
none. A flight whose states are not all numbers, or that may have left the range where gravity is bounded, has no such
bound and counts as −∞.
"""

import itertools
import json
import math
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr
from jaxtyping import Array, Bool, Float, PRNGKeyArray, PyTree

from keepout.core.audit.tube import Tube, nearest
from keepout.core.cores import available_cores
from keepout.core.errors import ScenarioError
from keepout.core.fields.model import FieldModel
from keepout.core.flight.batches import BATCH
from keepout.core.flight.faults import CombinedFaults, DelayedCommands, StuckThruster
from keepout.core.flight.loop import FlightLog, trace
from keepout.core.flight.setup import Faults, FlightSetup
from keepout.core.geometry.target import Target
from keepout.core.guard.field import RECIPE
from keepout.core.kept import digest
from keepout.core.mission.build import Mission, prepare
from keepout.core.mission.flight import Flight, judged
from keepout.core.mission.scenario import Scenario, ScenarioLike
from keepout.core.mission.surroundings import RANDOM_BAND, Surroundings
from keepout.core.motion.arrays import Scalar, Vector
from keepout.core.motion.disturbance import BandLimitedNoise
from keepout.core.motion.relative import MotionState
from keepout.core.progress import Progress, part_of, silent
from keepout.flights.rare_events.subset import CONFIDENCE, Estimate, Question, Simulation, estimate, simulate

_TOLERANCE = 1e-3
"""How close to the truth the clearance bound is driven, m."""

_COLUMNS = ("time", "position", "velocity", "force")

Numbers = Float[Array, "numbers"]


class KnownErrors(Faults):
    """Estimates that are wrong by given errors.

    Attributes:
        position: one row an estimate, m.
        velocity: likewise, m/s.

    """

    position: Float[Array, "rows 3"]
    velocity: Float[Array, "rows 3"]

    def initial_state(self, key: PRNGKeyArray) -> PyTree:
        """Start with the first row."""
        return jnp.zeros((), jnp.int32)

    def estimate(self, fault_state: PyTree, true_state: MotionState) -> tuple[PyTree, MotionState]:
        """Add this row's errors."""
        return fault_state + 1, true_state.moved(self.position[fault_state], self.velocity[fault_state])


class KnownLosses(Faults):
    """Commands of which given ones are lost; the thrusters then go on as they were."""

    lost: Bool[Array, "rows"]

    def initial_state(self, key: PRNGKeyArray) -> PyTree:
        """Start with the first row and without force."""
        return jnp.zeros((), jnp.int32), jnp.zeros(3)

    def command(self, fault_state: PyTree, force: Vector, time: Scalar) -> tuple[PyTree, Vector]:
        """Give this command or the last one that arrived."""
        row, last = fault_state
        arrived = jnp.where(self.lost[row], last, force)
        return (row + 1, arrived), arrived


class KnownGain(Faults):
    """Thrusters that give their command times a given factor an axis."""

    factor: Vector

    def actuate(self, fault_state: PyTree, force: Vector, time: Scalar) -> tuple[PyTree, Vector]:
        """Scale the force."""
        return fault_state, self.factor * force


@dataclass(frozen=True, eq=False)
class Tape:
    """Where on a flight's tape each of its random numbers stands.

    Attributes:
        scenario: of the flights.
        layout: name and shape of each stretch of the tape, in their order.

    """

    scenario: Scenario
    layout: tuple[tuple[str, tuple[int, ...]], ...]

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """The shape of each stretch."""
        return dict(self.layout)

    @classmethod
    def of(cls, scenario: Scenario) -> "Tape":
        """Lay out the tape of a scenario.

        Raises:
            ScenarioError: nothing in the scenario is random, or a law that is.

        """
        faults, steps = scenario.faults, scenario.steps
        if faults.law in ("random", "bang-bang"):
            raise ScenarioError(
                f'faults.law: "{faults.law}" draws forces that are not on the tape of a flight; valid for rare events '
                'are "none", "into the body", "through" and "not a number"'
            )
        shapes: dict[str, tuple[int, ...]] = {}
        for kind in ("position", "velocity"):
            if getattr(scenario.rare, f"start_{kind}_std"):
                shapes[f"start {kind}"] = (3,)
            if getattr(faults, f"{kind}_bias"):
                shapes[f"{kind} bias"] = (3,)
            if getattr(faults, f"{kind}_noise"):
                shapes[f"{kind} noise"] = (steps + 1, 4)
            if getattr(faults, f"{kind}_noise_std"):
                shapes[f"gaussian {kind} noise"] = (steps + 1, 3)
        if faults.dropped:
            shapes["losses"] = (steps,)
        if faults.gain_error:
            shapes["gain"] = (3,)
        disturbance = Surroundings(scenario).disturbance
        if isinstance(disturbance, BandLimitedNoise):
            shapes["disturbance"] = (2, *disturbance.sinusoids.phase.shape)
        if not shapes:
            raise ScenarioError(
                f"{scenario.name}: nothing in it is random, so that every flight is the same; give it faults (noise, "
                'dropped, gain_error), disturbance.kind = "random" or a spread of the start (rare.start_position_std)'
            )
        return cls(scenario, tuple(shapes.items()))

    @property
    def numbers(self) -> int:
        """How many standard normals it holds."""
        return sum(int(np.prod(shape)) for shape in self.shapes.values())

    def stretches(self, tape: Numbers) -> dict[str, Float[Array, "..."]]:
        """Cut a tape into its stretches."""
        ends = list(itertools.accumulate(int(np.prod(shape)) for shape in self.shapes.values()))
        parts = jnp.split(tape, ends[:-1])
        return {name: part.reshape(shape) for (name, shape), part in zip(self.shapes.items(), parts)}

    def flown(self, setup: FlightSetup, numbers: Numbers) -> tuple[FlightSetup, MotionState]:
        """Give what a tape makes of the scenario's setup, and its start: all faults are known."""
        drawn = self.stretches(numbers)
        # Not `dataclasses.replace`, which would check numbers that are traced here.
        setup = eqx.tree_at(lambda s: s.faults, setup, self._faults(drawn), is_leaf=lambda x: x is setup.faults)
        if "disturbance" in drawn:
            share = ndtr(drawn["disturbance"])
            low, high = RANDOM_BAND
            wave = low + (high - low) * share[0], 2.0 * jnp.pi * share[1]
            setup = eqx.tree_at(
                lambda s: (s.disturbance.sinusoids.frequency, s.disturbance.sinusoids.phase), setup, wave
            )
        return setup, self._start(setup, drawn)

    def _start(self, setup: FlightSetup, drawn: dict[str, Float[Array, "..."]]) -> MotionState:
        entry, spread = self.scenario.start, self.scenario.rare
        position, velocity = jnp.asarray(entry.position), jnp.asarray(entry.velocity)
        if "start position" in drawn:
            position = position + spread.start_position_std * drawn["start position"]
        if "start velocity" in drawn:
            velocity = velocity + spread.start_velocity_std * drawn["start velocity"]
        return setup.motion.initial_state(position, velocity)

    def _faults(self, drawn: dict[str, Float[Array, "..."]]) -> Faults:
        """Build the faults in the order of `Surroundings.faults`."""
        entry = self.scenario.faults
        parts: list[Faults] = [KnownErrors(self._errors(drawn, "position"), self._errors(drawn, "velocity"))]
        if "losses" in drawn:
            parts.append(KnownLosses(ndtr(drawn["losses"]) < entry.dropped))
        if entry.delay:
            parts.append(DelayedCommands(entry.delay))
        if "gain" in drawn:
            parts.append(KnownGain(1.0 + entry.gain_error * (2.0 * ndtr(drawn["gain"]) - 1.0)))
        if entry.stuck is not None:
            sign, axis = (1 if entry.stuck[0] == "+" else -1), "xyz".index(entry.stuck[1])
            parts.append(StuckThruster(axis, sign, entry.stuck_force, start=entry.stuck_from))
        return CombinedFaults(tuple(parts))

    def _errors(self, drawn: dict[str, Float[Array, "..."]], kind: str) -> Float[Array, "rows 3"]:
        """Add up the errors of the estimate of a kind, one row an estimate: bias, bounded noise, Gaussian noise."""
        entry, rows = self.scenario.faults, self.scenario.steps + 1
        total = jnp.zeros((rows, 3))
        if f"{kind} bias" in drawn:
            total = total + getattr(entry, f"{kind}_bias") * _direction(drawn[f"{kind} bias"])
        if f"{kind} noise" in drawn:
            noise = drawn[f"{kind} noise"]
            radius = getattr(entry, f"{kind}_noise") * jnp.cbrt(ndtr(noise[:, 3:]))
            total = total + radius * _direction(noise[:, :3])
        if f"gaussian {kind} noise" in drawn:
            memory = Surroundings(self.scenario).noise_memory
            noise = getattr(entry, f"{kind}_noise_std") * drawn[f"gaussian {kind} noise"]
            fresh = noise.at[1:].multiply(np.sqrt(1.0 - memory**2))
            total = total + (_fading(fresh, memory) if memory else fresh)
        return total


def _direction(normals: Float[Array, "*rows 3"]) -> Float[Array, "*rows 3"]:
    return normals / jnp.linalg.norm(normals, axis=-1, keepdims=True)


def _fading(fresh: Float[Array, "rows 3"], memory: float) -> Float[Array, "rows 3"]:
    """Add to each row what is left of those before it."""

    def onward(error: Float[Array, "3"], row: Float[Array, "3"]) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        error = memory * error + row
        return error, error

    return jax.lax.scan(onward, jnp.zeros(3), fresh)[1]


class TapedFlights:
    """Flies tapes of one mission, in batches of one size, so that a flight's bits do not depend on its company.

    Args:
        mission: what to fly.

    Raises:
        ScenarioError: the mission's scenario has no tape (`Tape.of`), or no bounds.

    """

    def __init__(self, mission: Mission) -> None:
        self.mission = mission
        self.tape = Tape.of(mission.scenario)
        self._bounds = Surroundings(mission.scenario).flight_bounds

    def clearance(self, tapes: Float[np.ndarray, "flights numbers"]) -> Float[np.ndarray, "flights"]:
        """Fly tapes; give the clearance of each, m."""
        begins = range(0, len(tapes), BATCH)
        with ThreadPoolExecutor(available_cores()) as pool:
            return np.concatenate(list(pool.map(lambda begin: self._cleared(tapes[begin : begin + BATCH]), begins)))

    def _cleared(self, tapes: Float[np.ndarray, "flights numbers"]) -> Float[np.ndarray, "flights"]:
        filled = np.resize(tapes, (BATCH, tapes.shape[1]))
        columns = _flown(self.mission.setup, jnp.asarray(filled), self.tape, self.mission.steps)
        flown = {name: np.asarray(column)[: len(tapes)] for name, column in zip(_COLUMNS, columns)}
        finite = np.all([np.isfinite(flown[name]).all(axis=(1, 2)) for name in _COLUMNS[1:]], axis=0)
        known = {name: np.where(finite[:, None, None], flown[name], 0.0) for name in _COLUMNS[1:]}
        tube = Tube.of(flown["time"][0], known["position"], known["velocity"], known["force"], self._bounds)
        target, radius = self.mission.target, self.mission.scenario.chaser.radius
        lower = nearest(tube, target.distance.distance, tolerance=_TOLERANCE).lower - radius
        return np.where(finite & ~tube.beyond.any(axis=1), lower, -np.inf)

    def fly(self, tape: Float[np.ndarray, "numbers"]) -> Flight:
        """Fly one tape with everything recorded, and audit it."""
        log = _logged(self.mission.setup, jnp.asarray(tape), self.tape, self.mission.steps)
        return judged(self.mission, log)


def _log(setup: FlightSetup, numbers: Float[Array, "numbers"], tape: Tape, steps: int) -> FlightLog:
    # No key is asked for: everything random is on the tape.
    setup, initial = tape.flown(setup, numbers)
    return trace(setup, initial, steps, jax.random.key(0))


_logged = eqx.filter_jit(_log)


@eqx.filter_jit
def _flown(
    setup: FlightSetup, tapes: Float[Array, "flights numbers"], tape: Tape, steps: int
) -> tuple[Float[Array, "flights ..."], ...]:
    def one(numbers: Float[Array, "numbers"]) -> tuple[Float[Array, "..."], ...]:
        log = _log(setup, numbers, tape, steps)
        return tuple(getattr(log, name) for name in _COLUMNS)

    return jax.vmap(one)(tapes)


FLIGHTS = 1024
"""Flights of a level and run."""

RUNS = 8

MOST_LEVELS = 16
"""Beyond so many the probability is said to be below what was reached: 8⁻¹⁵ is 3e-14."""


@dataclass(frozen=True)
class RareEvent:
    """A clearance below a number, and how probable it is: a measurement.

    Attributes:
        scenario: what was flown.
        below: the clearance, m; 0 is contact.
        estimate: the probability with its interval.
        simulation: all levels.
        worst: the flight with the least clearance of all, as it was flown.
        worst_tape: its random numbers, from which `TapedFlights.fly` flies it again.
        assumptions_broken: what is flown beyond what the guard's theorem assumes; None without a guard.
        seconds: that this took, without what was flown before it went on.

    """

    scenario: Scenario
    below: float
    estimate: Estimate
    simulation: Simulation
    worst: Flight
    worst_tape: np.ndarray
    assumptions_broken: tuple[str, ...] | None
    seconds: float

    @property
    def said(self) -> str:
        """The answer in words."""
        event = "a contact" if self.below == 0.0 else f"a clearance below {self.below:g} m"
        found = self.estimate
        if found.bounded_only:
            return f"Measured, not proved: the probability of {event} is below {found.upper:.2g}, with 95 %."
        return (
            f"Measured, not proved: the probability of {event} is {found.mean:.3g}, "
            f"between {found.lower:.2g} and {found.upper:.2g} with 95 %."
        )

    def summary(self) -> dict[str, Any]:
        """Give the figures as plain numbers for JSON."""
        levels = self.simulation.levels
        least, guard = self.worst.audit.minimum_clearance, self.worst.guard
        return {
            "name": self.scenario.name,
            "grade": "measured",
            "clearance_below_m": self.below,
            **{f"probability_{k}" if k == "below" else k: v for k, v in self.estimate.summary().items()},
            "confidence": CONFIDENCE,
            "runs": [float(run) for run in self.estimate.runs],
            "ended": self.simulation.ended,
            "levels": len(levels),
            "thresholds_m": [level.threshold for level in levels[1:]],
            "acceptance": [level.acceptance for level in levels[1:]],
            "steps": [level.step for level in levels[1:]],
            "flights": self.simulation.evaluations,
            "flights_per_level": levels[0].values.shape[1],
            "random_numbers": len(self.worst_tape),
            "seed": self.scenario.seed,
            "least_clearance_m": least if math.isfinite(least) else None,
            "guard": guard is not None,
            "assumptions_broken": None if self.assumptions_broken is None else list(self.assumptions_broken),
            "faults": self.scenario.faults.model_dump(exclude_defaults=True),
            "seconds": self.seconds,
        }


def rare(
    scenario: ScenarioLike,
    *,
    below: float = 0.0,
    runs: int = RUNS,
    flights: int = FLIGHTS,
    state: Path | None = None,
    target: Target | None = None,
    model: FieldModel | None = None,
    progress: Progress = silent,
) -> RareEvent:
    """Measure how probable it is that a flight's clearance falls below a number, by subset simulation.

    Random are the scenario's faults, its disturbance of kind "random", and the start as the table `rare` spreads it;
    all of it drawn from the scenario's seed (docs/motion.md).

    Args:
        scenario: what to fly: a `Scenario`, the path of its TOML file, or its tables as a dict.
        below: the clearance, m; 0 is contact.
        runs: side by side, at least 2; the interval comes from their spread, and 8 or more make it hold.
        flights: of a level and run; a multiple of 8.
        state: folder in which the simulation is kept after each level, and gone on with if it is there.
        target: already loaded; else the scenario's.
        model: its field, already loaded; else the scenario's.
        progress: called as the work goes on.

    Raises:
        ScenarioError: nothing is random, the guard's theorem excludes what is asked for, or a number out of range.
        KeepoutError: something in the scenario cannot be flown; the message names the entry.

    """
    began = time.perf_counter()
    scenario = Scenario.of(scenario)
    progress(0.0, "preparing")
    mission = prepare(scenario, target=target, model=model, progress=part_of(progress, 0.0, 0.1))
    scenario = mission.scenario
    _refuse_theorem(mission, below)
    flown = TapedFlights(mission)
    question = Question(below, runs, flights, scenario.seed, MOST_LEVELS)
    identity = {
        "scenario": scenario.model_dump_json(),
        "below": below,
        "runs": runs,
        "flights": flights,
        "most_levels": MOST_LEVELS,
        "target": mission.target.sha256,
        "field": mission.model.sha256,
        "guard": RECIPE if mission.guard is not None else "",
        "batch": BATCH,
        "versions": {name: metadata.version(name) for name in ("jax", "jaxlib", "numpy")},
    }
    found = simulate(
        flown.clearance,
        flown.tape.numbers,
        question,
        state=None if state is None else state / f"state-{digest(json.dumps(identity, sort_keys=True))[:16]}.npz",
        progress=part_of(progress, 0.1, 0.95),
    )
    progress(0.95, "the worst flight")
    worst = flown.fly(found.lowest)
    progress(1.0, "")
    return RareEvent(
        scenario,
        below,
        estimate(found, below),
        found,
        worst,
        found.lowest,
        None if mission.setup.guard is None else mission.assumptions_broken,
        time.perf_counter() - began,
    )


def _refuse_theorem(mission: Mission, below: float) -> None:
    """Refuse to measure what is proved: a contact that the guard's theorem excludes."""
    spread = mission.scenario.rare
    if mission.start_certified and below <= 0.0 and not (spread.start_position_std or spread.start_velocity_std):
        raise ScenarioError(
            f"{mission.scenario.name}: the guard's theorem covers this scenario, so that a contact has probability 0, "
            "proved and not measured; ask for a clearance above 0 with --below, or fly beyond an "
            "assumption, such as faults.dropped or faults.position_noise_std"
        )
