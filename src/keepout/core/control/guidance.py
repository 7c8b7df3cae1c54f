"""Guidance: the desired velocity v_c before safety, as a function of position; and plans, which make it for a law."""

import abc
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from keepout.core.fields.field import Field
from keepout.core.motion.arrays import Scalar, Vector, as_float64
from keepout.core.progress import Progress, silent

Point = Float[np.ndarray, "3"]


class Guidance(eqx.Module):
    """A desired velocity for each position; `goal` (3,) m is where it leads."""

    goal: eqx.AbstractVar[Vector]

    @abc.abstractmethod
    def desired_velocity(self, position: Vector) -> Vector:
        """Return v_c in m/s at a position in m, both in the body frame.

        Args:
            position: (3,) m, body frame.

        Returns:
            (3,) m/s.

        """


class SlowingGuidance(Guidance):
    """A guidance that slows down towards its goal: `speed` v_max in m/s, `slowing_length` k_p in m."""

    goal: Vector
    speed: Scalar
    slowing_length: Scalar


class ComponentwiseGuidance(SlowingGuidance):
    """The paper's v_c = −v_max tanh(r_e / k_p), component by component; up to √3 v_max in norm."""

    def desired_velocity(self, position: Vector) -> Vector:
        """Return −v_max tanh(r_e / k_p)."""
        return -self.speed * jnp.tanh((position - self.goal) / self.slowing_length)


def towards(goal: Vector, position: Vector, length: Scalar) -> tuple[Array, Array]:
    """Return tanh(‖r_e‖/k_p) times the direction to the goal (smooth at the goal), and ‖r_e‖."""
    error = goal - position
    square = jnp.sum(error * error)
    away = square > 1e-24
    distance = jnp.sqrt(jnp.where(away, square, 1.0))
    factor = jnp.where(away, jnp.tanh(distance / length) / distance, 1.0 / length)
    return factor * error, jnp.where(away, distance, 0.0)


class StraightGuidance(SlowingGuidance):
    """Straight to the goal with speed v_max tanh(‖r_e‖ / k_p); never above v_max in norm."""

    def desired_velocity(self, position: Vector) -> Vector:
        """Return v_max tanh(‖r_e‖/k_p) times the direction to the goal."""
        return self.speed * towards(self.goal, position, self.slowing_length)[0]


@dataclass(frozen=True)
class Travel:
    """How a guidance is to lead to its goal.

    Attributes:
        speed: v_max, m/s.
        slowing_length: k_p, m.
        start: (3,) m, where given, must be connected to the goal.
        progress: called while the guidance is made.

    """

    speed: float
    slowing_length: float
    start: Point | None = None
    progress: Progress = silent


class GuidancePlan(abc.ABC):
    """Makes a `Guidance` for a law's keep-out zone {field ≤ offset}, its speed and its slowing length.

    Attributes:
        refuses: whether it refuses itself a goal that is not free; else the law does, by the field as it is at first.

    """

    refuses: ClassVar[bool] = False

    def of_legs(self, made: Callable[["GuidancePlan"], "GuidancePlan"]) -> "GuidancePlan":
        """Give the plan that `made` makes of this one, for legs flown by it; remembered where this one is."""
        return made(self)

    @abc.abstractmethod
    def guidance(self, field: Field, offset: float, goal: Point, travel: Travel) -> Guidance:
        """Make the guidance.

        Args:
            field: the law's.
            offset: of the law's barrier h = field − offset, m.
            goal: (3,) m, body frame, outside the keep-out zone.
            travel: how fast to lead there, and from where.

        Raises:
            ControlError: the goal cannot be led to.

        """


class _WhateverIsBetween(GuidancePlan):
    """A plan whose guidance does not ask the field."""

    made: ClassVar[type[SlowingGuidance]]

    def guidance(self, field: Field, offset: float, goal: Point, travel: Travel) -> Guidance:
        """Make the guidance; the field is not asked."""
        return self.made(jnp.asarray(goal), as_float64(travel.speed), as_float64(travel.slowing_length))


@dataclass(frozen=True)
class Straight(_WhateverIsBetween):
    """Straight to the goal, whatever is between (`StraightGuidance`)."""

    made = StraightGuidance


@dataclass(frozen=True)
class Componentwise(_WhateverIsBetween):
    """The paper's: straight to the goal, component by component (`ComponentwiseGuidance`)."""

    made = ComponentwiseGuidance
