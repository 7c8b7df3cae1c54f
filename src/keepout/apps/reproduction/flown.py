"""Flights of a reproduction, each flown once and kept: single ones as their logs, and passages a batch at a time.

Passages are flights of one law that differ in start, goal and k_p only, and so share one compiled program.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from keepout.apps.reproduction.work import Work
from keepout.core.control.controller import Controller
from keepout.core.control.guidance import Guidance
from keepout.core.fields.model import FieldModel
from keepout.core.flight.batches import states_at
from keepout.core.flight.loop import FlightLog, fly
from keepout.core.flight.record import OPTIONAL_COLUMNS
from keepout.core.flight.setup import FlightSetup
from keepout.core.geometry.target import Target
from keepout.core.mission.build import Mission, load_model, prepare
from keepout.core.mission.flight import Flight, fly_audited, judged
from keepout.core.mission.scenario import Scenario
from keepout.core.progress import Progress, part_of

TOGETHER = 60
"""Most passages in a batch: few enough that a stopped run loses minutes."""

REST_WINDOW = 300.0
"""For so long (s), at its end, a flight at rest has stayed where it is."""
REST_SHARE = 0.05
"""Within this share of the distance that is left to the goal it has then stayed."""

Triple = tuple[float, float, float]


@dataclasses.dataclass(frozen=True)
class Passage:
    """From where to where (m, body frame), and with which k_p (m); None where the law has its own."""

    start: Triple
    goal: Triple
    slowing_length: float | None = None

    def scenario(self, base: Scenario) -> Scenario:
        """Give the scenario that flies it, all else as in `base`."""
        flown = base.replace(start={"position": self.start}, goal={"position": self.goal})
        if self.slowing_length is None:
            return flown
        return flown.replace(control={"paper": {"slowing_length": self.slowing_length}})


Landed = dict[str, np.ndarray]
"""By name, an entry a passage: reached, trapped, first_within_s (infinite: never), final_error_m, contact (the audit's
word), minimum_clearance_m, minimum_barrier_m, delta_v_mps; where logs are kept, `FlightLog`'s columns as log_<name>."""


def fly_passages(
    work: Work,
    base: Scenario,
    passages: Sequence[Passage],
    mission: Callable[[], Mission],
    *,
    made_with: Sequence[str],
    guidances: Callable[[Sequence[Passage]], Guidance] | None = None,
    logs: int = 0,
) -> Landed:
    """Fly passages without a guard, a batch at a time; batches that an earlier run has flown are not flown again.

    Args:
        work: keeps the batches.
        base: scenario of them all; its name begins the names of the kept files.
        passages: at least one.
        mission: gives the first passage's, prepared; asked only where there is something to fly.
        made_with: what else the flights depend on: digests of mesh and field.
        guidances: gives the guidances of some passages, stacked; by default the law's own, with each passage's goal
            and k_p.
        logs: of so many passages, the first ones, whole logs are kept.

    """
    size = min(TOGETHER, len(passages))

    def fly(first: int, last: int) -> Landed:
        led = guidances or _own_guidances(mission())
        return _fly(mission(), passages[first:last], size, led, max(0, min(logs, last) - first))

    made_of = [base.model_dump(mode="json"), [dataclasses.astuple(one) for one in passages], list(made_with), logs]
    return work.batches(base.name, len(passages), size, made_of, fly)


def _own_guidances(mission: Mission) -> Callable[[Sequence[Passage]], Guidance]:
    """Give the law's own guidance, led to each passage's goal with its k_p."""

    def stacked(passages: Sequence[Passage]) -> Guidance:
        controller = mission.setup.controller
        assert isinstance(controller, Controller)
        one, count = controller.velocity.guidance, len(passages)
        guidance = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, *jnp.shape(leaf))), one)
        guidance = eqx.tree_at(lambda g: g.goal, guidance, jnp.asarray([p.goal for p in passages]))
        lengths = [p.slowing_length for p in passages]
        return eqx.tree_at(lambda g: g.slowing_length, guidance, jnp.asarray(lengths, dtype=float))

    return stacked


def _varied(setup: FlightSetup) -> Any:
    return setup.goal, setup.controller.velocity.guidance  # pyright: ignore[reportAttributeAccessIssue]


def _fly(
    mission: Mission,
    passages: Sequence[Passage],
    size: int,
    guidances: Callable[[Sequence[Passage]], Guidance],
    logs: int,
) -> Landed:
    """Fly one batch and audit it, compiled for `size` flights."""
    scenario = mission.scenario
    setup = eqx.tree_at(_varied, mission.setup, (jnp.asarray([p.goal for p in passages]), guidances(passages)))
    columns: dict[str, np.ndarray] = {}
    names = [name for name in FlightLog.__annotations__ if name not in OPTIONAL_COLUMNS]
    result, audits = fly_audited(
        scenario,
        mission.target,
        setup,
        states_at(setup.motion, [p.start for p in passages]),
        columns=names,
        landed=lambda _, log: columns.update(log),
        seed=scenario.seed,
        vary=_varied,
        batch=size,
        workers=1,
    )
    time, tolerance = columns["time"][0], scenario.goal.tolerance
    ends = [(path, np.asarray(passage.goal)) for path, passage in zip(columns["position"], passages, strict=True)]
    within = [first_within(time, path, goal, tolerance) for path, goal in ends]
    return {
        "reached": np.asarray(result.reached),
        "trapped": np.array([trapped(time, path, goal, tolerance) for path, goal in ends]),
        "first_within_s": np.array([np.inf if one is None else one for one in within]),
        "final_error_m": np.asarray(result.final_error),
        "contact": np.array([str(audit.contact) for audit in audits]),
        "minimum_clearance_m": np.array([audit.minimum_clearance for audit in audits]),
        "minimum_barrier_m": np.asarray(result.minimum_barrier),
        "delta_v_mps": np.asarray(result.delta_v),
        **{f"log_{name}": columns[name][:logs] for name in names},
    }


def log_of(landed: Landed, index: int) -> FlightLog:
    """Give one passage's log back."""
    return FlightLog(
        **{name[4:]: jnp.asarray(column[index]) for name, column in landed.items() if name.startswith("log_")}
    )


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


def trapped(
    time: Float[np.ndarray, "samples"],
    position: Float[np.ndarray, "samples 3"],
    goal: Float[np.ndarray, "3"],
    tolerance: float,
) -> bool:
    """Whether a flight came to rest outside its goal's tolerance.

    It did if it ends further than `tolerance` from the goal, and over its last 300 s was never further from where it
    ends than a twentieth of the distance that is left. Nothing less shows that something holds it: unhindered, the
    paper's guidance covers 63 % of the way that is left in 300 s at k_p = 30 m and 0.1 m/s, and more at smaller k_p.
    The share, not a length, because close to the goal the guidance is as slow as a trapped chaser that chatters.

    Args:
        time: of the samples, s, rising.
        position: m, in the goal's frame.
        goal: m.
        tolerance: of the goal, m.

    Returns:
        False too for a flight shorter than 300 s, or one that holds a position that is not a number.

    """
    left = float(np.linalg.norm(position[-1] - goal))
    last = time >= time[-1] - REST_WINDOW
    if time[-1] - time[0] < REST_WINDOW or not left > tolerance:
        return False
    strayed = np.linalg.norm(position[last] - position[-1], axis=1)
    return bool(np.all(strayed <= REST_SHARE * left))


def first_within(
    time: Float[np.ndarray, "samples"],
    position: Float[np.ndarray, "samples 3"],
    goal: Float[np.ndarray, "3"],
    tolerance: float,
) -> float | None:
    """Give the time (s after the start) when a flight first was within its goal's tolerance; None if it never was."""
    near = np.linalg.norm(position - goal, axis=1) < tolerance
    return float(time[np.argmax(near)] - time[0]) if near.any() else None
