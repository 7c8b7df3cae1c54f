"""Passages: flights of one law that differ in start, goal and k_p only, and so share one compiled program.

They are flown a batch at a time, and each batch is kept as soon as it has landed.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from keepout.apps.reproduction.rest import first_within, trapped
from keepout.apps.reproduction.work import Work
from keepout.core.control.controller import Controller
from keepout.core.control.guidance.guidance import Guidance
from keepout.core.flight.batches import fly_batches, states_at
from keepout.core.flight.loop import FlightLog
from keepout.core.flight.record import OPTIONAL_COLUMNS
from keepout.core.flight.setup import FlightSetup
from keepout.core.mission.audited import judge
from keepout.core.mission.build import Mission
from keepout.core.mission.scenario import Scenario

TOGETHER = 60
"""Most passages in a batch: few enough that a stopped run loses minutes."""

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
    kept = []
    for first in range(0, len(passages), size):
        part = passages[first : first + size]
        made_of = [base.model_dump(mode="json"), [dataclasses.astuple(one) for one in part], list(made_with), logs]
        kept.append(
            work.arrays(
                f"{base.name}-{first}",
                made_of,
                lambda part=part, first=first: _fly(
                    mission(), part, size, guidances or _own_guidances(mission()), max(0, min(logs - first, len(part)))
                ),
            )
        )
        work.progress(min(1.0, (first + size) / len(passages)), f"{base.name}, {first + len(part)} of {len(passages)}")
    return {name: np.concatenate([one[name] for one in kept if name in one]) for name in kept[0]}


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
    """Fly one batch and audit it; it is filled up to `size`, so that one shape is compiled."""
    scenario, count = mission.scenario, len(passages)
    filled = [passages[i % count] for i in range(size)]
    goals = jnp.asarray([p.goal for p in filled])
    setup = eqx.tree_at(_varied, mission.setup, (goals, guidances(filled)))
    initial = states_at(setup.motion, [p.start for p in filled])
    columns: dict[str, np.ndarray] = {}
    names = [name for name in FlightLog.__annotations__ if name not in OPTIONAL_COLUMNS]
    result = fly_batches(
        setup,
        initial,
        mission.steps,
        seed=scenario.seed,
        vary=_varied,
        columns=names,
        landed=lambda _, log: columns.update(log),
        batch=size,
        workers=1,
    )
    time, position = columns["time"][0], columns["position"][:count]
    audits = judge(scenario, mission.target, {name: column[:count] for name, column in columns.items()})
    tolerance = scenario.goal.tolerance
    ends = [(path, np.asarray(passage.goal)) for path, passage in zip(position, passages, strict=True)]
    within = [first_within(time, path, goal, tolerance) for path, goal in ends]
    return {
        "reached": np.asarray(result.reached)[:count],
        "trapped": np.array([trapped(time, path, goal, tolerance) for path, goal in ends]),
        "first_within_s": np.array([np.inf if one is None else one for one in within]),
        "final_error_m": np.asarray(result.final_error)[:count],
        "contact": np.array([str(audit.contact) for audit in audits]),
        "minimum_clearance_m": np.array([audit.minimum_clearance for audit in audits]),
        "minimum_barrier_m": np.asarray(result.minimum_barrier)[:count],
        "delta_v_mps": np.asarray(result.delta_v)[:count],
        **{f"log_{name}": columns[name][:logs] for name in names},
    }


def log_of(landed: Landed, index: int) -> FlightLog:
    """Give one passage's log back."""
    return FlightLog(
        **{name[4:]: jnp.asarray(column[index]) for name, column in landed.items() if name.startswith("log_")}
    )
