"""A law that leads from hold point to hold point, slower as it comes closer.

One law flies all legs: which one it is on is in its memory. So single flights, batches and the flight computer step
through the same program, and what law and observer remember goes on from leg to leg.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from keepout.core.control.controller import Controller
from keepout.core.control.guidance import Guidance
from keepout.core.control.law import Command, LawOfAnother
from keepout.core.errors import ControlError
from keepout.core.fields.field import Field
from keepout.core.motion.arrays import Flag, Scalar, Vector, as_float64, norm
from keepout.core.motion.relative import MotionState

SURE = 0.75
"""Share of a hold's tolerance within which the estimate must be for the hold to count: the rest is for its error."""
_FEW = 64
"""Numbers of an array that is copied without a thought."""


class SpeedByDistance(eqx.Module):
    """The largest speed, m/s, by how far the chaser is: linear between the pairs given, constant beyond them.

    Attributes:
        distances: m, rising.
        speeds: m/s, that belong to them.
        point: (3,) m, body frame, that the distance is measured to; None: to the mesh, by `field`.
        field: the distance to the mesh, of which `error_bound` (m) is taken off.
        error_bound: by how much the field over-states, m.

    """

    distances: Float[Array, "pairs"] = eqx.field(converter=as_float64)
    speeds: Float[Array, "pairs"] = eqx.field(converter=as_float64)
    point: Vector | None
    field: Field | None
    error_bound: Scalar = eqx.field(converter=as_float64, default=0.0)

    def __call__(self, position: Vector) -> Scalar:
        """Give the largest speed at a position (m)."""
        if self.point is not None:
            distance = norm(position - self.point)
        else:
            assert self.field is not None
            distance = self.field.value(position) - self.error_bound
        return jnp.interp(distance, self.distances, self.speeds)


class LegGuidance(Guidance):
    """The guidance of the leg under way, kept within a speed.

    A velocity that is cut keeps its direction; the law's safe velocity is its projection onto a set that holds zero
    wherever the chaser is outside the keep-out zone, so that it is never faster.

    Attributes:
        own: what differs between the legs' guidances, which are of one kind, with a leading axis of legs.
        common: what does not.
        leg: the one under way.
        rule: largest speed by distance; None: no such rule.

    """

    own: Guidance
    common: Guidance
    leg: Int[Array, ""]
    rule: SpeedByDistance | None = None

    @classmethod
    def of(cls, ways: Sequence[Guidance], rule: SpeedByDistance | None) -> "LegGuidance":
        """Put the legs' guidances together; the leg under way is the last.

        Raises:
            ControlError: they are not of one kind.

        """
        arrays, (still, *others) = zip(*(eqx.partition(way, eqx.is_array) for way in ways), strict=True)
        shapes = {str(jax.tree.map(jnp.shape, way)) for way in arrays}
        if len(shapes) > 1 or any(other != still for other in others):
            raise ControlError("legs: their guidances are not of one kind, with arrays of the same shapes")
        # An array that all of them hold is not copied: it may be large. A single leg has its numbers as two have them.
        few = _FEW if len(ways) == 1 else 0
        same = jax.tree.map(lambda *parts: all(part is parts[0] for part in parts) and np.size(parts[0]) > few, *arrays)
        own = jax.tree.map(lambda shared, *parts: None if shared else jnp.stack(parts), same, *arrays)
        common = jax.tree.map(lambda shared, part: part if shared else None, same, arrays[0])
        last: Any = jax.device_put(np.asarray(len(ways) - 1, dtype=np.int32))
        return cls(own, eqx.combine(common, still), last, rule)  # pyright: ignore

    @property
    def way(self) -> Guidance:
        """The guidance of the leg under way."""
        return eqx.combine(jax.tree.map(lambda array: array[self.leg], self.own), self.common)

    @property
    def goal(self) -> Vector:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The place of the leg under way, m."""
        return self.way.goal

    def desired_velocity(self, position: Vector) -> Vector:
        """Return the leg's desired velocity, m/s, within the rule."""
        wanted = self.way.desired_velocity(position)
        if self.rule is None:
            return wanted
        return wanted * jnp.minimum(1.0, self.rule(position) / jnp.maximum(norm(wanted), 1e-12))


class Legs(eqx.Module):
    """What is asked at each hold point, with a leading axis of legs.

    Attributes:
        tolerance: the chaser is to stay closer, m; on board a hold counts within `SURE` times that.
        dwell: for which it stays there without a break, s.
        release: before which it does not fly on, s since the epoch.
        by_word: whether that is when somebody says "go".

    """

    tolerance: Float[Array, "legs"] = eqx.field(converter=as_float64)
    dwell: Float[Array, "legs"] = eqx.field(converter=as_float64)
    release: Float[Array, "legs"] = eqx.field(converter=as_float64)
    by_word: Bool[Array, "legs"]


class Progress(eqx.Module):
    """How far the legs are.

    Attributes:
        leg: under way.
        held: for how long the chaser has been at its place by now, s.
        aborted: whether the mission was abandoned.

    """

    leg: Int[Array, ""]
    held: Scalar
    aborted: Flag


class LegLaw(LawOfAnother):
    """A law whose guidance is a `LegGuidance`: flies on once a place was held for its dwell and is released.

    Once the mission is abandoned it flies back to the place before the one it was flying to, and stays there.

    Attributes:
        law: the law of each leg, but for its guidance's `leg`.
        legs: what is asked at each hold point.
        period: between control steps, s.
        abort_at: when the mission is abandoned, s since the epoch; infinite: never.

    """

    law: Controller  # pyright: ignore[reportIncompatibleVariableOverride]
    legs: Legs
    period: Scalar = eqx.field(converter=as_float64)
    abort_at: Scalar = eqx.field(converter=as_float64, default=math.inf)

    @property
    def goal(self) -> Vector:
        """The last leg's place, m."""
        return self.law.goal

    def initial_state(self, state: MotionState) -> PyTree:
        """Begin with the first leg."""
        return self.law.initial_state(state), Progress(jnp.zeros((), jnp.int32), jnp.zeros(()), jnp.asarray(False))

    def with_applied_force(self, state: PyTree, force: Vector) -> PyTree:
        """Tell the law."""
        memory, progress = state
        return self.law.with_applied_force(memory, force), progress

    def step(self, state: PyTree, estimate: MotionState) -> tuple[PyTree, Command]:
        """Fly the leg under way, and see whether it is over."""
        memory, progress = state
        aborted = estimate.time >= self.abort_at
        leg = jnp.where(aborted & ~progress.aborted, jnp.maximum(progress.leg - 1, 0), progress.leg)
        law = self.at_leg(leg)
        memory, order = law.step(memory, estimate)
        there = norm(estimate.position - law.goal) < SURE * self.legs.tolerance[leg]
        held = jnp.where(there, progress.held, 0.0)
        # Whole periods are counted up, so that a dwell of so many is not missed by their rounding.
        over = there & (held >= self.legs.dwell[leg] - 1e-6 * self.period) & (estimate.time >= self.legs.release[leg])
        over = over & (leg + 1 < len(self.legs.dwell)) & ~aborted
        held = jnp.where(there & ~over, held + self.period, 0.0)
        return (memory, Progress(leg + over, held, progress.aborted | aborted)), dataclasses.replace(order, leg=leg)

    def at_leg(self, leg: Int[Array, ""]) -> Controller:
        """Give the law of one leg alone."""
        return eqx.tree_at(lambda law: law.velocity.guidance.leg, self.law, leg)
