"""An artificial potential field on Keepout's learned distance (Khatib 1986).

Khatib's attraction with his limit on the speed, F = −k_v (v − ν v_d), v_d = (k_p/k_v)(goal − r),
ν = min(1, v_max/‖v_d‖), and his repulsion (FIRAS) F = η (1/ρ − 1/ρ₀) ∇ρ/ρ² within ρ₀ of the keep-out zone, where
ρ = f̃ − e_h − radius − margin. Both are limited: the attraction to half of the thrusters' authority, so that it cannot
outweigh the repulsion, and the sum to all of it. Goals beside a surface lie where it repels; there the repulsion falls
with the square of the distance to the goal, as Ge & Cui 2000 mend it.

Tuning. k_v = 0.5/s is the default law's tracking gain, and k_p/k_v = v_max/(1.5 m) its slowing length. η makes the
repulsion equal to the authority at `stand_off`; from v_max the chaser stops in v_max²/(2·4 mm/s²) = 1.25 m at full
authority. `stand_off` and ρ₀ (`influence`), which Khatib leaves to the designer, are the best of `choices`: nearer ones
are as good round `intelsat30` and a little sooner, but touch the pocket and the ISS.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from keepout.core.fields.field import Field
from keepout.core.motion.relative import MotionState
from rivals_laws.observed import ObservedLaw, Plant
from rivals_laws.rival import Rival
from rivals_laws.rival_case import Point, RivalCase

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
        far = jnp.sqrt(jnp.sum(away**2) + 1e-300)
        wanted = away * plant.speed_limit / jnp.maximum(self.slowing_length, far)
        pull = _limited(self.gain * (wanted - estimate.velocity), 0.5 * plant.authority)
        value, gradient = self.field.value_and_gradient(estimate.position)
        near = jnp.maximum(value - self.offset, 1e-3)

        def firas(distance: Array | float) -> Array | float:
            return (1.0 / distance - 1.0 / self.influence) / distance**2

        push = plant.authority * firas(near) / firas(self.stand_off) * jnp.minimum(1.0, far / self.influence) ** 2
        return own, _limited(pull + jnp.where(near < self.influence, push, 0.0) * gradient, plant.authority)


def _limited(vector: Vector, most: Float[Array, ""]) -> Vector:
    return vector * jnp.minimum(1.0, most / jnp.sqrt(jnp.sum(vector**2) + 1e-300))


@dataclasses.dataclass(frozen=True)
class ArtificialPotential(Rival):
    """Khatib's potential field on the learned distance."""

    name = "potential field"
    choices = {"stand_off": (0.3, 0.6, 1.0, 1.5), "influence": (1.5, 2.5, 4.0)}  # noqa: RUF012
    gain: float = 0.5
    slowing_length: float = 1.5
    influence: float = 4.0
    stand_off: float = 1.5

    def law(self, case: RivalCase, start: Point, goal: Point) -> PotentialField:
        """Make the law of one goal."""
        numbers = (self.gain, self.slowing_length, self.influence, self.stand_off)
        law = case.once(
            self.settings, lambda: PotentialField(Plant.of(case), case.model.field, case.offset, jnp.zeros(3), *numbers)
        )
        return eqx.tree_at(lambda law: law.towards, law, jnp.asarray(goal))


RIVALS = (ArtificialPotential(),)
