"""Keepout's own laws, for reference: the default law with geodesic guidance, and the paper's with printed numbers."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from keepout.core.control.barrier_grid import require_free
from keepout.core.control.controller import Controller
from keepout.core.mission.law import build_law
from rivals_laws.rival import Rival
from rivals_laws.rival_case import Point, RivalCase


@dataclasses.dataclass(frozen=True)
class KeepoutDefault(Rival):
    """The default law, all its gains from `core/control/design.py`."""

    name = "keepout default"

    def law(self, case: RivalCase, start: Point, goal: Point) -> Controller:
        """Give the default law its geodesic."""
        law = case.default_law
        leader = law.velocity.guidance
        found = case.geodesic(start, goal)
        found = eqx.tree_at(lambda g: (g.speed, g.slowing_length), found, (leader.speed, leader.slowing_length))
        return eqx.tree_at(lambda law: law.velocity.guidance, law, found)


@dataclasses.dataclass(frozen=True)
class PaperPrinted(Rival):
    """The paper's law with the constants of its section VI, on Keepout's field."""

    name = "paper printed"

    def law(self, case: RivalCase, start: Point, goal: Point) -> Controller:
        """Lead the paper's law straight to the goal."""
        for name, position in (("start", start), ("goal", goal)):
            require_free(case.model.field, case.offset, position, name)
        return eqx.tree_at(lambda law: law.velocity.guidance.goal, prototype(case), jnp.asarray(goal))


def prototype(case: RivalCase) -> Controller:
    """Give the paper's law to a goal far away, made once a case."""
    scenario = case.scenario.replace(
        control={"profile": "paper", "guidance": "straight", "circulation": "printed"},
        goal={"position": tuple(np.array([0.0, 0.0, 2.0 * case.reach]))},
    )
    return case.once("paper printed", lambda: build_law(scenario, case.model, from_start=False))


RIVALS = (KeepoutDefault(), PaperPrinted())
