"""Sampling MPC: MPPI (Williams et al. 2017, "Information theoretic model predictive control") on Keepout's field.

K sequences of accelerations, each held for a few seconds, are drawn round the last answer, flown as double integrators
over the horizon, costed, and averaged with weights exp(−(S − min S)/λ); the answer, moved on by one period, is the mean
of the next step. Drift and disturbance are compensated as in every rival.

Costs, along the horizon: the distance to the goal over v_max in seconds (so that λ is a time too), a quadratic cost
beyond the speed limit, and, where the clearance ρ = f̃ − e_h − radius − margin is below `room`, a cost that grows
to `collision` at ρ = 0 and stays so inside (Williams' indicator, made sloped so that samples which all touch are still
told apart).

Tuning, as Williams et al. recommend: the horizon is twice the time to stop from v_max (25 s at the authority of
4 mm/s²), Σ half the authority, and K as many as a step of some milliseconds on one core allows (512 reached the same
4 goals of seed 1 round `intelsat30` in the same time as 256). λ was tried on 16
pairs of seed 1 round `pocket`: 0.3, 1 and 3 s reached 9, 15 and 15 without contact, in 7.0, 2.3 and 1.27 times the
bound; `choices` go on from there. The other costs were set once.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from keepout.core.fields.field import Field
from keepout.core.motion.relative import MotionState
from rivals_laws.observed import ObservedLaw, Plant
from rivals_laws.rival import Rival
from rivals_laws.rival_case import Point, RivalCase

Vector = Float[Array, "3"]


class Weights(eqx.Module):
    """Numbers of the costs: λ (s), Σ (m/s²), the seconds that an acceleration is held, and see the module."""

    temperature: float
    spread: float
    held: float
    room: float
    collision: float
    speeding: float


class SamplingMPC(ObservedLaw):
    """MPPI to `towards` (m), K `samples` of `knots` accelerations each."""

    plant: Plant
    field: Field
    offset: float
    towards: Vector
    weights: Weights
    knots: int = eqx.field(static=True)
    samples: int = eqx.field(static=True)

    @property
    def goal(self) -> Vector:
        """Where it leads, m."""
        return self.towards

    def initial_memory(self, state: MotionState) -> tuple[Float[Array, "knots 3"], Int[Array, ""]]:
        """Start from no acceleration, and count the steps for the random key."""
        return jnp.zeros((self.knots, 3)), jnp.zeros((), jnp.int32)

    def acceleration(self, own, estimate: MotionState):
        """Draw, fly, weigh and average; the first acceleration is flown."""
        mean, count = own
        w, limit = self.weights, self.plant.authority
        key = jax.random.fold_in(jax.random.key(0), count)
        noise = w.spread * jax.random.normal(key, (self.samples, self.knots, 3))
        noise = noise.at[0].set(0.0).at[1].set(-mean)  # the last answer itself, and drifting on
        drawn = mean + noise
        size = jnp.sqrt(jnp.sum(drawn**2, axis=-1, keepdims=True) + 1e-300)
        drawn = drawn * jnp.minimum(1.0, limit / size)
        cost = self._cost(drawn, estimate)
        weight = jax.nn.softmax(-(cost - jnp.min(cost)) / w.temperature)
        answer = jnp.einsum("k,kij->ij", weight, drawn)
        # A period later the held accelerations have moved on by a share of one.
        share = 1.0 / w.held
        moved = (1.0 - share) * answer + share * jnp.concatenate([answer[1:], jnp.zeros((1, 3))])
        return (moved, count + 1), answer[0]

    def _cost(self, drawn: Float[Array, "k n 3"], estimate: MotionState) -> Float[Array, " k"]:
        w, T = self.weights, self.weights.held
        velocity = estimate.velocity + T * jnp.cumsum(drawn, axis=1)
        before = jnp.concatenate([jnp.broadcast_to(estimate.velocity, (len(drawn), 1, 3)), velocity[:, :-1]], axis=1)
        position = estimate.position + jnp.cumsum(0.5 * T * (before + velocity), axis=1)
        clearance = self.field.value(position) - self.offset
        near = jnp.clip(1.0 - clearance / w.room, 0.0, None)
        error = jnp.sqrt(jnp.sum((position - self.towards) ** 2, axis=-1) + 1e-12)
        speed = jnp.sqrt(jnp.sum(velocity**2, axis=-1) + 1e-300)
        over = jnp.maximum(speed / self.plant.speed_limit - 0.95, 0.0)
        touching = w.collision * jnp.where(near >= 1.0, near, near**4)
        running = error / self.plant.speed_limit + touching + w.speeding * over**2
        last = jnp.sqrt(jnp.sum(velocity[:, -1] ** 2, axis=-1)) / self.plant.speed_limit
        return jnp.mean(running, axis=1) + error[:, -1] / self.plant.speed_limit + 5.0 * last * jnp.exp(-error[:, -1])


@dataclasses.dataclass(frozen=True)
class PathIntegral(Rival):
    """MPPI on the learned distance."""

    name = "MPPI"
    choices = {"temperature_s": (1.0, 3.0, 10.0), "room_m": (0.3, 0.6)}  # noqa: RUF012
    swept = 16
    samples: int = 256
    knots: int = 10
    held_s: float = 5.0
    temperature_s: float = 3.0
    spread_of_authority: float = 0.5
    room_m: float = 0.3
    collision: float = 1000.0
    speeding: float = 2000.0

    def flights(self, target: str) -> int | None:
        """Give fewer flights than the others': a control step takes milliseconds."""
        return 32 if target == "iss" else 64

    def note(self, case: RivalCase) -> str:
        """Say why there are fewer."""
        return f"{self.samples} samples, {self.knots * self.held_s:g} s ahead; fewer flights, as it is slow"

    def law(self, case: RivalCase, start: Point, goal: Point) -> SamplingMPC:
        """Make the law of one goal."""

        def make() -> SamplingMPC:
            plant = Plant.of(case)
            spread = self.spread_of_authority * float(plant.authority)
            weights = Weights(self.temperature_s, spread, self.held_s, self.room_m, self.collision, self.speeding)
            field = case.model.field
            return SamplingMPC(plant, field, case.offset, jnp.zeros(3), weights, self.knots, self.samples)

        return eqx.tree_at(lambda law: law.towards, case.once(self.settings, make), jnp.asarray(goal))


RIVALS = (PathIntegral(),)
