"""One flight of a reproduction, kept as arrays: its states and forces over time, and what the audit found."""

import json
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from keepout.experiments.work import Work
from keepout.fields.model import FieldModel
from keepout.geometry.target import Target
from keepout.mission.build import load_model
from keepout.mission.flight import fly
from keepout.mission.scenario import Scenario
from keepout.progress import Progress

_COLUMNS = ("time", "position", "velocity", "force", "barrier", "lyapunov")


@dataclass(frozen=True)
class KeptFlight:
    """A flight's columns, named as in `FlightRecord`, and its `Flight.summary`."""

    scenario: Scenario
    summary: dict[str, Any]
    time: Float[np.ndarray, "N"]
    position: Float[np.ndarray, "N 3"]
    velocity: Float[np.ndarray, "N 3"]
    force: Float[np.ndarray, "N 3"]
    barrier: Float[np.ndarray, "N"]
    lyapunov: Float[np.ndarray, "N"]

    @property
    def error(self) -> Float[np.ndarray, "N"]:
        """Distance to the goal, m."""
        return np.linalg.norm(self.position - np.asarray(self.scenario.goal.position), axis=1)


def kept_flight(
    work: Work, scenario: Scenario, target: Target, progress: Progress, *, model: FieldModel | None = None
) -> KeptFlight:
    """Fly a scenario and keep it; one that an earlier run kept is not flown again.

    Args:
        work: where it is kept.
        scenario: what to fly; the name begins the kept file's.
        target: its mesh.
        progress: told how far the flight is.
        model: the field to fly by, instead of the scenario's.

    """

    def make() -> dict[str, np.ndarray]:
        flight = fly(scenario, target=target, model=model, progress=progress)
        columns = {name: getattr(flight.record, name) for name in _COLUMNS}
        return {**columns, "summary": np.asarray(json.dumps(flight.summary()))}

    model = load_model(scenario, target) if model is None else model
    made_of = {"scenario": scenario.model_dump(mode="json"), "target": target.sha256, "field": model.sha256}
    arrays = work.arrays(scenario.name, made_of, make)
    progress(1.0, "")
    return KeptFlight(scenario, json.loads(str(arrays["summary"])), **{name: arrays[name] for name in _COLUMNS})
