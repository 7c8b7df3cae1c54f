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
    """The default law, all its gains from `core/control/profiles.py`."""

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
    """The paper's law with the constants of its section VI, on Keepout's field; it prints neither k_p nor e_∇h."""

    name = "paper printed"

    def law(self, case: RivalCase, start: Point, goal: Point) -> Controller:
        """Lead the paper's law straight to the goal."""
        for name, position in (("start", start), ("goal", goal)):
            require_free(case.model.field, case.offset, position, name)
        return eqx.tree_at(lambda law: law.velocity.guidance.goal, self.prototype(case), jnp.asarray(goal))

    def prototype(self, case: RivalCase) -> Controller:
        """Give the paper's law to a goal far away, made once a case."""
        scenario = case.scenario.replace(
            control={"profile": "paper", "guidance": "straight", "circulation": "printed", "paper": self.unprinted},
            goal={"position": tuple(np.array([0.0, 0.0, 2.0 * case.reach]))},
        )
        return case.once(self.name, lambda: build_law(scenario, case.model, from_start=False))

    @property
    def unprinted(self) -> dict[str, float]:
        """What the paper does not print, as entries of a scenario; nothing for Keepout's own choice."""
        return {}


@dataclasses.dataclass(frozen=True)
class PaperBest(PaperPrinted):
    """The same at the k_p (m) and e_∇h of 20 at which most flights reach untouched: `benchmarks/reach.py` has them."""

    name = "paper at its best"
    more_seconds = 1200
    slowing_length: float = 20.0
    gradient_error: float = 0.2

    @property
    def unprinted(self) -> dict[str, float]:
        """Both."""
        return {"slowing_length": self.slowing_length, "gradient_error": self.gradient_error}


RIVALS = (KeepoutDefault(), PaperPrinted(), PaperBest())
