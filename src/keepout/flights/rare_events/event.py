"""How probable it is that a scenario's flight comes nearer to the target than a number: measured, never proved."""

import json
import math
import time
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from keepout.core.errors import ScenarioError
from keepout.core.fields.model import FieldModel
from keepout.core.flight.batches import BATCH
from keepout.core.geometry.target import Target
from keepout.core.guard.field import RECIPE
from keepout.core.kept import digest
from keepout.core.mission.build import Mission, prepare
from keepout.core.mission.flight import Flight
from keepout.core.mission.scenario import Scenario, ScenarioLike
from keepout.core.progress import Progress, part_of, silent
from keepout.flights.rare_events.flights import TapedFlights
from keepout.flights.rare_events.subset import CONFIDENCE, Estimate, Question, Simulation, estimate, simulate

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
