"""How the target turns: fixed in VVLH, fixed in inertial space, or tumbling freely."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Float

from keepout.core.errors import ScenarioError
from keepout.core.motion import rotation
from keepout.core.motion.arrays import NumbersLike, Vector, as_float64
from keepout.core.motion.orbit import EARTH_GRAVITATIONAL_PARAMETER, OrbitalFrame
from keepout.core.motion.rotation import Quaternion

_normalised = jax.jit(rotation.normalise)


def _unit(value: NumbersLike) -> Array:
    return _normalised(as_float64(value))


class AttitudeMotion(eqx.Module):
    """A law for the target's attitude and angular velocity.

    `attitude` is the unit quaternion body ← VVLH at the epoch, scalar first.
    """

    attitude: eqx.AbstractVar[Quaternion]

    @abc.abstractmethod
    def initial_angular_velocity(self, frame: OrbitalFrame) -> Vector:
        """Inertial angular velocity at the epoch, rad/s, in body axes."""

    @abc.abstractmethod
    def rates(self, attitude: Quaternion, angular_velocity: Vector, frame: OrbitalFrame) -> tuple[Vector, Vector]:
        """Inertial angular velocity ω (rad/s) and acceleration ω̇ (rad/s²) of the body, both in body axes.

        A law that prescribes ω returns the prescribed value and ignores the integrated `angular_velocity`.
        """


class VVLHFixed(AttitudeMotion):
    """A target that keeps its attitude in VVLH, as an Earth-pointing spacecraft does; the paper's case."""

    attitude: Quaternion = eqx.field(converter=_unit, default_factory=rotation.identity)

    def initial_angular_velocity(self, frame: OrbitalFrame) -> Vector:
        """VVLH's own rate, rad/s, in body axes."""
        return rotation.matrix(self.attitude) @ frame.angular_velocity

    def rates(self, attitude: Quaternion, angular_velocity: Vector, frame: OrbitalFrame) -> tuple[Vector, Vector]:
        """VVLH's own rates, in body axes."""
        body_from_vvlh = rotation.matrix(attitude)
        return body_from_vvlh @ frame.angular_velocity, body_from_vvlh @ frame.angular_acceleration


class InertiallyFixed(AttitudeMotion):
    """A target that does not turn against the stars."""

    attitude: Quaternion = eqx.field(converter=_unit, default_factory=rotation.identity)

    def initial_angular_velocity(self, frame: OrbitalFrame) -> Vector:
        """Zero."""
        return jnp.zeros(3)

    def rates(self, attitude: Quaternion, angular_velocity: Vector, frame: OrbitalFrame) -> tuple[Vector, Vector]:
        """Zero and zero."""
        return jnp.zeros(3), jnp.zeros(3)


class Tumbling(AttitudeMotion):
    """Free rotation with a full inertia tensor: J ω̇ = τ − ω × J ω.

    angular_velocity: inertial, at the epoch, rad/s, in body axes. inertia: 3 × 3, kg m² about the target's centre of
    mass; only its ratios matter. gravity_gradient: whether τ is that of the Earth's point mass, 3 μ/R³ n × J n with n
    the direction to it (Hughes, Spacecraft Attitude Dynamics, section 8.1), or zero.

    Raises:
        ScenarioError: an inertia tensor that no rigid body has.

    """

    angular_velocity: Vector = eqx.field(converter=as_float64)
    inertia: Float[Array, "3 3"] = eqx.field(converter=as_float64)
    attitude: Quaternion = eqx.field(converter=_unit, default_factory=rotation.identity)
    gravity_gradient: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        if isinstance(self.inertia, Tracer):
            return  # values are not known yet inside a transformation
        J = self.inertia
        scale = float(jnp.max(jnp.abs(J)))
        if not bool(jnp.all(jnp.isfinite(J))) or float(jnp.max(jnp.abs(J - J.T))) > 1e-9 * scale:
            raise ScenarioError(f"inertia: {J.tolist()}; it must be a finite symmetric 3 × 3 tensor")
        smallest, middle, largest = jnp.linalg.eigvalsh(J)
        if smallest <= 0 or largest > (smallest + middle) * (1 + 1e-9):
            raise ScenarioError(
                f"inertia: principal moments {float(smallest):g}, {float(middle):g}, {float(largest):g} kg m²; "
                "they must be positive, and the largest at most the sum of the others"
            )

    def initial_angular_velocity(self, frame: OrbitalFrame) -> Vector:
        """Angular velocity as given, rad/s, in body axes."""
        return self.angular_velocity

    def rates(self, attitude: Quaternion, angular_velocity: Vector, frame: OrbitalFrame) -> tuple[Vector, Vector]:
        """Integrated ω, and ω̇ from Euler's equation."""
        torque = -jnp.cross(angular_velocity, self.inertia @ angular_velocity)
        if self.gravity_gradient:
            nadir = rotation.matrix(attitude) @ jnp.array([0.0, 0.0, 1.0])
            strength = 3.0 * EARTH_GRAVITATIONAL_PARAMETER / frame.radius**3
            torque = torque + strength * jnp.cross(nadir, self.inertia @ nadir)
        # Cramer's rule: a library's solver would keep a step on board from being one kernel.
        a, b, c = self.inertia.T
        cofactors = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)])
        return angular_velocity, cofactors @ torque / (a @ cofactors[0])
