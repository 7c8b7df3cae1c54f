"""Safe velocity: field, guidance, circulation and the cone program put together (paper, section V-A).

Circulation is the relaxed inequality T · v − Υ(h) ≥ σ that turns the chaser around an obstacle (paper Eq. cbf_socp_CI,
with T = Ω ∇f̃ and Υ(h) = level − slope h). The choices differ in Ω. A constant Ω cannot exclude deadlock in three
dimensions: a skew Ω has an axis, and T = 0 wherever ∇f̃ is parallel to it; the paper's printed Ω is not skew, so its T
is not tangent.
"""

import abc
import dataclasses
from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from keepout.core.control.guidance import Guidance
from keepout.core.control.unit_program import Circulation, HalfSpaces, VelocityProgram, or_one
from keepout.core.control.velocity_program import solve
from keepout.core.errors import ControlError
from keepout.core.fields.field import Field
from keepout.core.fields.zones import ZonedField
from keepout.core.motion.arrays import Flag, Scalar, Vector, as_float64, norm

PRINTED = ((0.0, 0.0, 1.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 0.0))
"""Ω as printed in the paper, section VI."""

_NEVER = 1e100
"""Metres: so far that no row acts."""


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
    return vector / or_one(norm(vector))


def _unit_or(vector: Vector, otherwise: Vector) -> Vector:
    """Return the direction of a cross product of unit vectors, or another where they are nearly parallel."""
    return jnp.where(jnp.sum(vector * vector) > 1e-6, _unit(vector), otherwise)


class ClassK(eqx.Module):
    """The extended class-K function α(h) of the barrier condition, m/s.

    Linear, α₀ h, without `braking`; with it α(h) = √(2 a_c h + (a_c/α₀)²) − a_c/α₀ for h ≥ 0 and α₀ h below: the
    approach then never asks for more deceleration than a_c, and the slope at the surface is still α₀. `rate` is α₀
    in 1/s, `braking` a_c in m/s².
    """

    rate: Scalar
    braking: Scalar | None = None

    def __call__(self, barrier: Float[Array, "*barriers"]) -> Float[Array, "*barriers"]:
        """Return α(h), of each h where there are several."""
        if self.braking is None:
            return self.rate * barrier
        knee = self.braking / self.rate
        root = jnp.sqrt(2.0 * self.braking * jnp.maximum(barrier, 0.0) + knee * knee)
        return jnp.where(barrier >= 0.0, root - knee, self.rate * barrier)


class SpeedCone(eqx.Module):
    """The speed limit s(h) = min(v_max, √(2 a_b (max(h, 0) + reserve))).

    At this speed the chaser can stop within h + reserve. `limit` v_max in m/s, `authority` a_b in m/s²,
    `reserve` in m.
    """

    limit: Scalar
    authority: Scalar
    reserve: Scalar

    def __call__(self, barrier: Scalar) -> Scalar:
        """Return s(h)."""
        return jnp.minimum(self.limit, jnp.sqrt(2.0 * self.authority * (jnp.maximum(barrier, 0.0) + self.reserve)))


class Barriers(NamedTuple):
    """A barrier to first order about a point, or several along a leading axis: h (m), ∇h, and ∇h's turn (1/m)."""

    values: Float[Array, "*things"]
    normals: Float[Array, "*things 3"]
    hessians: Float[Array, "*things 3 3"]

    def shifted(self, shift: Vector) -> "Barriers":
        """Give them beside the point by `shift` (3,) m: tangent planes with the Hessians' turn, all a Jacobian sees."""
        values = self.values + jnp.sum(self.normals * shift, axis=-1)
        return self._replace(values=values, normals=self.normals + jnp.sum(self.hessians * shift, axis=-1))


class VelocityPoint(eqx.Module):
    """The velocity layer at one position.

    `barrier` h (m) of the law, `normal` ∇f̃, `desired` v_c and `velocity` v_s (m/s), `jacobian` ∂v_s/∂r (1/s; zero
    where the law does not use it), `status` a `ConeStatus`.
    """

    barrier: Scalar
    normal: Vector
    desired: Vector
    velocity: Vector
    jacobian: Float[Array, "3 3"]
    status: Int[Array, ""]


@jax.custom_jvp
def _once(derivative: Array) -> Array:
    """Give what was found together with a derivative; it is refused to be differentiated once more."""
    return derivative


@_once.defjvp
def _refuse_twice(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    raise ControlError(
        "flight: a law that uses the safe velocity's derivative (profile paper, feedforward) has no derivative itself; "
        "differentiate a flight of the default law"
    )


class SafeVelocity(eqx.Module):
    """The map from a position to its safe velocity v_s.

    Barrier h = field − `offset` (m; certified error, chaser radius, margin and the law's own nominal offset).
    `gradient_error` is the paper's e_∇h; None where the barrier's own gradient is exact. `box` is the paper's limit
    on each component, `speed` the limit on the norm; at least one of them. `differentiate` says whether ∂v_s/∂r is
    formed (it needs the field's Hessian).

    With `row_per_zone` the target and each zone of a `ZonedField` have a barrier row each, else the nearest of them
    has one. A zone's distance is known, so that e_∇h is the target's alone. Barrier and normal of the `VelocityPoint`
    are those of the nearest all the same. So are those of circulation, whose T still jumps where another is nearest.
    """

    field: Field
    offset: Scalar
    guidance: Guidance
    class_k: ClassK
    circulation: CirculationLaw | None = None
    gradient_error: Scalar | None = None
    box: Scalar | None = None
    speed: SpeedCone | None = None
    differentiate: bool = eqx.field(static=True, default=True)
    row_per_zone: bool = eqx.field(static=True, default=False)

    def at_time(self, time: Scalar) -> "SafeVelocity":
        """Give the same by the field as it is from a time (s) on."""
        field = self.field.at_time(time)
        return self if field is self.field else dataclasses.replace(self, field=field)

    def __call__(self, position: Vector, velocity: Vector, memory: Vector) -> tuple[VelocityPoint, Vector]:
        """Return the velocity layer at a position (m) and the circulation's memory for the next step."""
        nearest, things = self._barriers(position)
        barrier, normal, desired = nearest.values, nearest.normals, self.guidance.desired_velocity(position)
        if self.circulation is not None:
            memory = self.circulation.update(memory, barrier, normal, desired, velocity)

        def safe(shift: Vector) -> tuple[Vector, Int[Array, ""]]:
            program = self.program(
                nearest.shifted(shift),
                self.guidance.desired_velocity(position + shift) if self.differentiate else desired,
                memory,
                None if things is None else things.shifted(shift),
            )
            solution = solve(program, forward=self.differentiate)
            return solution.velocity, solution.status

        shift = jnp.zeros(3)
        if not self.differentiate:
            answer, status = safe(shift)
            return VelocityPoint(barrier, normal, desired, answer, jnp.zeros((3, 3)), status), memory

        def with_value(shift: Vector) -> tuple[Array, tuple[Array, Array]]:
            answer, status = safe(shift)
            return answer, (answer, status)

        jacobian, (answer, status) = jax.jacfwd(with_value, has_aux=True)(shift)
        return VelocityPoint(barrier, normal, desired, _once(answer), _once(jacobian), status), memory

    def program(
        self, nearest: Barriers, desired: Vector, memory: Vector, things: Barriers | None = None
    ) -> VelocityProgram:
        """Return the cone program at a barrier with a desired velocity v_c (m/s).

        With `things`, the target before the zones, each of these has a barrier row, else the nearest alone.
        """
        circulation, first, half_spaces = None, nearest, None
        if things is not None:
            first, zones = (
                jax.tree.map(lambda all_of, part=part: all_of[part], things) for part in (0, slice(1, None))
            )
            half_spaces = HalfSpaces(zones.normals, self.class_k(zones.values))
        if self.circulation is not None:
            circulation = self.circulation.inequality(memory, nearest.values, nearest.normals)
        return VelocityProgram(
            desired=desired,
            normal=first.normals,
            barrier_rate=self.class_k(first.values),
            gradient_error=self.gradient_error,
            circulation=circulation,
            box=self.box,
            speed=None if self.speed is None else self.speed(nearest.values),
            half_spaces=half_spaces,
        )

    def _barriers(self, position: Vector) -> tuple[Barriers, Barriers | None]:
        """Give the nearest barrier at a position (m), and those of target and zones where each has a row."""
        field, each = self.field, None
        if self.row_per_zone and isinstance(field, ZonedField):
            field, each = field.target, field.zone_values
        if self.differentiate:
            value, normal, hessian = field.value_gradient_hessian(position)
        else:
            value, normal = field.value_and_gradient(position)
            hessian = jnp.zeros((3, 3))
        target = Barriers(value - self.offset, normal, hessian)
        if each is None:
            return target, None
        gradients = jax.jacfwd(each)
        away, normals = each(position), gradients(position)
        hessians = jax.jacfwd(gradients)(position) if self.differentiate else jnp.zeros((*normals.shape, 3))
        # A zone that has ended is infinitely far. It becomes a row that never acts.
        zones = Barriers(jnp.minimum(away - self.offset, _NEVER), normals, hessians)
        things = jax.tree.map(lambda one, more: jnp.concatenate([one[None], more]), target, zones)
        return jax.tree.map(lambda all_of: all_of[jnp.argmin(things.values)], things), things
