"""Safe velocity: field, guidance, circulation and the cone program put together (paper, section V-A)."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from keepout.core.control.circulation import CirculationLaw
from keepout.core.control.guidance import Guidance
from keepout.core.control.velocity_program import VelocityProgram, solve
from keepout.core.errors import ControlError
from keepout.core.fields.field import Field
from keepout.core.motion.arrays import Scalar, Vector


class ClassK(eqx.Module):
    """The extended class-K function α(h) of the barrier condition, m/s.

    Linear, α₀ h, without `braking`; with it α(h) = √(2 a_c h + (a_c/α₀)²) − a_c/α₀ for h ≥ 0 and α₀ h below: the
    approach then never asks for more deceleration than a_c, and the slope at the surface is still α₀. `rate` is α₀
    in 1/s, `braking` a_c in m/s².
    """

    rate: Scalar
    braking: Scalar | None = None

    def __call__(self, barrier: Scalar) -> Scalar:
        """Return α(h)."""
        if self.braking is None:
            return self.rate * barrier
        knee = self.braking / self.rate
        root = jnp.sqrt(2.0 * self.braking * jnp.maximum(barrier, 0.0) + knee * knee)
        return jnp.where(barrier >= 0.0, root - knee, self.rate * barrier)


class SpeedCone(eqx.Module):
    """The speed limit s(h) = min(v_max, √(2 a_b (max(h, 0) + reserve))).

    At this speed the chaser can stop within h + reserve. `limit` v_max in m/s, `authority` a_b in m/s² (None: no
    cone, only the cap), `reserve` in m.
    """

    limit: Scalar
    authority: Scalar | None
    reserve: Scalar

    def __call__(self, barrier: Scalar) -> Scalar:
        """Return s(h)."""
        if self.authority is None:
            return self.limit
        return jnp.minimum(self.limit, jnp.sqrt(2.0 * self.authority * (jnp.maximum(barrier, 0.0) + self.reserve)))


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

    def at_time(self, time: Scalar) -> "SafeVelocity":
        """Give the same by the field as it is from a time (s) on."""
        field = self.field.at_time(time)
        return self if field is self.field else dataclasses.replace(self, field=field)

    def __call__(self, position: Vector, velocity: Vector, memory: Vector) -> tuple[VelocityPoint, Vector]:
        """Return the velocity layer at a position (m) and the circulation's memory for the next step."""
        if self.differentiate:
            value, normal, hessian = self.field.value_gradient_hessian(position)
        else:
            value, normal = self.field.value_and_gradient(position)
            hessian = jnp.zeros((3, 3))
        barrier = value - self.offset
        desired = self.guidance.desired_velocity(position)
        if self.circulation is not None:
            memory = self.circulation.update(memory, barrier, normal, desired, velocity)

        def safe(shift: Vector) -> tuple[Vector, Int[Array, ""]]:
            # To first order in the shift the field is its tangent plane with the Hessian's turn: all a Jacobian sees.
            program = self.program(
                barrier + jnp.sum(normal * shift),
                normal + jnp.sum(hessian * shift, axis=-1),
                self.guidance.desired_velocity(position + shift) if self.differentiate else desired,
                memory,
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

    def program(self, barrier: Scalar, normal: Vector, desired: Vector, memory: Vector) -> VelocityProgram:
        """Return the cone program at barrier h (m) with gradient ∇f̃ and desired velocity v_c (m/s)."""
        circulation = None
        if self.circulation is not None:
            circulation = self.circulation.inequality(memory, barrier, normal)
        return VelocityProgram(
            desired=desired,
            normal=normal,
            barrier_rate=self.class_k(barrier),
            gradient_error=self.gradient_error,
            circulation=circulation,
            box=self.box,
            speed=None if self.speed is None else self.speed(barrier),
        )
