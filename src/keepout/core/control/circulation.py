"""Circulation: the relaxed inequality T · v − Υ(h) ≥ σ that turns the chaser around an obstacle.

Paper Eq. cbf_socp_CI, with T = Ω ∇f̃ and Υ(h) = level − slope h. The choices differ in Ω. A constant Ω cannot exclude
deadlock in three dimensions: a skew Ω has an axis, and T = 0 wherever ∇f̃ is parallel to it; the paper's printed Ω is
not skew, so its T is not tangent.
"""

import abc
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from keepout.core.control.velocity_program import Circulation
from keepout.core.motion.arrays import Flag, Scalar, Vector, as_float64, norm

PRINTED = ((0.0, 0.0, 1.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 0.0))
"""Ω as printed in the paper, section VI."""


def skew(axis: Vector) -> Float[Array, "3 3"]:
    """Return the matrix of the cross product with `axis`."""
    x, y, z = axis[0], axis[1], axis[2]
    zero = jnp.zeros_like(x)
    return jnp.stack([jnp.stack([zero, -z, y]), jnp.stack([z, zero, -x]), jnp.stack([-y, x, zero])])


class CirculationLaw(eqx.Module):
    """How Ω is chosen. `memory` (3,) is carried by the controller from step to step.

    `level` is Υ(0) in m/s, `slope` in 1/s, `weight` the penalty p of the relaxation.
    """

    level: Scalar = eqx.field(converter=as_float64, default=0.1)
    slope: Scalar = eqx.field(converter=as_float64, default=1.0)
    weight: Scalar = eqx.field(converter=as_float64, default=1.0)

    def update(self, memory: Vector, barrier: Scalar, normal: Vector, desired: Vector, velocity: Vector) -> Vector:
        """Return the memory for this step from h (m), ∇f̃, the desired velocity and the velocity (m/s); else kept."""
        return memory

    @abc.abstractmethod
    def matrix(self, memory: Vector) -> Float[Array, "3 3"]:
        """Return Ω."""

    def inequality(self, memory: Vector, barrier: Scalar, normal: Vector) -> Circulation:
        """Return the inequality at a point with barrier h (m) and gradient ∇f̃."""
        return Circulation(self.matrix(memory) @ normal, self.level - self.slope * barrier, self.weight)


class ConstantCirculation(CirculationLaw):
    """A constant Ω (3, 3): `printed_circulation` has the paper's, `skew_circulation` a skew one."""

    omega: Float[Array, "3 3"] = eqx.field(kw_only=True)

    def matrix(self, memory: Vector) -> Float[Array, "3 3"]:
        """Return the constant."""
        return self.omega


class SwitchingCirculation(CirculationLaw):
    """A skew Ω whose axis is chosen when the obstacle is met and kept until it is left (hysteresis).

    On meeting the obstacle (Υ(h) > 0) the axis is n × v_c, so that T is the part of the desired velocity along the
    surface; straight against the surface any perpendicular axis will do. It is kept while it turns around the
    obstacle, and let go at twice the barrier value. Where the surface bends towards the axis (sine below
    `degenerate`) T would vanish: the axis becomes n × v, which carries on in the direction of flight.
    """

    degenerate: Scalar = eqx.field(converter=as_float64, default=0.3)

    def update(self, memory: Vector, barrier: Scalar, normal: Vector, desired: Vector, velocity: Vector) -> Vector:
        """Return the axis to use now; zero while there is no obstacle near."""
        n = _unit(normal)
        reach = self.level / self.slope
        engaged = jnp.sum(memory * memory) > 0.25
        spare = jnp.where(jnp.abs(n[0]) < 0.7, jnp.asarray([1.0, 0.0, 0.0]), jnp.asarray([0.0, 1.0, 0.0]))
        perpendicular = _unit(jnp.cross(n, spare))
        towards = _unit_or(jnp.cross(n, _unit(desired)), perpendicular)
        onwards = _unit_or(jnp.cross(n, _unit(velocity)), towards)
        sine = jnp.linalg.norm(jnp.cross(memory, n))
        kept = jnp.where(sine < self.degenerate, onwards, memory)
        near: Flag = barrier < jnp.where(engaged, 2.0 * reach, reach)
        return jnp.where(near, jnp.where(engaged, kept, towards), 0.0)

    def matrix(self, memory: Vector) -> Float[Array, "3 3"]:
        """Return the cross product with the axis."""
        return skew(memory)


@dataclass(frozen=True)
class NoCirculation:
    """No circulation, where a law has one of its own: the cone program has no such row."""


def printed_circulation() -> ConstantCirculation:
    """Return the paper's, with Ω as printed: it is not skew, so its T is not tangent."""
    return ConstantCirculation(omega=jnp.asarray(PRINTED))


def skew_circulation() -> ConstantCirculation:
    """Return one that turns about the constant axis (1, 1, 1)."""
    axis = np.ones(3)
    return ConstantCirculation(omega=skew(jnp.asarray(axis / np.linalg.norm(axis))))


def _unit(vector: Vector) -> Vector:
    size = norm(vector)
    return vector / jnp.where(size > 0.0, size, 1.0)


def _unit_or(vector: Vector, otherwise: Vector) -> Vector:
    """Return the direction of a cross product of unit vectors, or another where they are nearly parallel."""
    return jnp.where(jnp.sum(vector * vector) > 1e-6, _unit(vector), otherwise)
