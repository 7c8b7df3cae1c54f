"""An artificial potential field on Keepout's learned distance (Khatib 1986).

Khatib's attraction with his limit on the speed, F = −k_v (v − ν v_d), v_d = (k_p/k_v)(goal − r), ν = min(1, v_max/‖v_d‖),
and his repulsion (FIRAS) F = η (1/ρ − 1/ρ₀) ∇ρ/ρ² within ρ₀ of the keep-out zone, where ρ = f̃ − e_h − radius − margin.
The sum is limited to the thrusters' authority, and drift and disturbance are compensated as in every rival.

Tuning. k_v = 0.5/s is the default law's tracking gain, and k_p/k_v = v_max/(1.5 m) its slowing length. ρ₀ is the
distance in which the chaser stops from v_max with half its authority, √ of which Khatib leaves to the designer:
v_max²/(2·a_b/2) ≈ 2.5 m for 4 mm/s². η makes the repulsion equal to the authority at `stand_off`, where the chaser then
rests against its full attraction; `stand_off` and ρ₀ were chosen on 64 pairs of seed 1 round `pocket` and `intelsat30`
(`TUNED` in `tests/benchmarks` does not use them): the most pairs reached without contact.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree
from rivals_laws.observed import ObservedLaw, Plant
from rivals_laws.rival import Rival
from rivals_laws.rival_case import Point, RivalCase

from keepout.fields.field import Field
from keepout.motion.relative import MotionState

Vector = Float[Array, "3"]


class PotentialField(ObservedLaw):
    """Attraction to `towards` (m) and repulsion from {field = offset}; lengths in m, gain in 1/s."""

    plant: Plant
    field: Field
    offset: float
    towards: Vector
    gain: float
    slowing_length: float
    influence: float
    stand_off: float

    @property
    def goal(self) -> Vector:
        """Where it is drawn, m."""
        return self.towards

    def acceleration(self, own: PyTree, estimate: MotionState) -> tuple[PyTree, Vector]:
        """Add attraction and repulsion, m/s²."""
        plant = self.plant
        away = self.towards - estimate.position
        wanted = plant.speed_limit / self.slowing_length * away
        wanted = wanted * jnp.minimum(1.0, plant.speed_limit / jnp.sqrt(jnp.sum(wanted**2) + 1e-300))
        pull = self.gain * (wanted - estimate.velocity)
        value, gradient = self.field.value_and_gradient(estimate.position)
        near = jnp.maximum(value - self.offset, 1e-3)

        def firas(distance: Array | float) -> Array | float:
            return (1.0 / distance - 1.0 / self.influence) / distance**2

        push = plant.authority * firas(near) / firas(self.stand_off)
        total = pull + jnp.where(near < self.influence, push, 0.0) * gradient
        return own, total * jnp.minimum(1.0, plant.authority / jnp.sqrt(jnp.sum(total**2) + 1e-300))


@dataclasses.dataclass(frozen=True)
class ArtificialPotential(Rival):
    """Khatib's potential field on the learned distance."""

    name = "potential field"
    gain: float = 0.5
    slowing_length: float = 1.5
    influence: float = 2.5
    stand_off: float = 0.3

    def law(self, case: RivalCase, start: Point, goal: Point) -> PotentialField:
        """Make the law of one goal."""
        numbers = (self.gain, self.slowing_length, self.influence, self.stand_off)
        law = case.once(
            self.settings, lambda: PotentialField(Plant.of(case), case.model.field, case.offset, jnp.zeros(3), *numbers)
        )
        return eqx.tree_at(lambda l: l.towards, law, jnp.asarray(goal))


RIVALS = (ArtificialPotential(),)
