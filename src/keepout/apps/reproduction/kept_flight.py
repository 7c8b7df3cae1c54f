"""One flight of a reproduction, kept as its log, so that it is flown once."""

import jax
import jax.numpy as jnp
import numpy as np

from keepout.apps.reproduction.work import Work
from keepout.core.fields.model import FieldModel
from keepout.core.flight.loop import FlightLog, fly
from keepout.core.geometry.target import Target
from keepout.core.mission.build import load_model, prepare
from keepout.core.mission.flight import Flight, judged
from keepout.core.mission.scenario import Scenario
from keepout.core.progress import Progress, part_of


def kept_flight(
    work: Work, scenario: Scenario, target: Target, progress: Progress, *, model: FieldModel | None = None
) -> Flight:
    """Fly a scenario and keep its log; one that an earlier run kept is not flown again, but audited again.

    Args:
        work: where it is kept.
        scenario: what to fly; the name begins the kept file's.
        target: its mesh.
        progress: told how far the flight is.
        model: the field to fly by, instead of the scenario's.

    """
    model = load_model(scenario, target) if model is None else model
    mission = prepare(scenario, target=target, model=model, progress=part_of(progress, 0.0, 0.3))
    progress(0.3, "flying")

    def make() -> dict[str, np.ndarray]:
        log = fly(mission.setup, mission.initial, mission.steps, jax.random.key(scenario.seed))
        arrays = {name: getattr(log, name) for name in FlightLog.__annotations__}
        return {name: np.asarray(array) for name, array in arrays.items() if array is not None}

    kept = work.arrays(scenario.name, [scenario.model_dump(mode="json"), target.sha256, model.sha256], make)
    progress(0.8, "audit")
    return judged(mission, FlightLog(**{name: jnp.asarray(array) for name, array in kept.items()}))
