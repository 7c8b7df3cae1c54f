"""The target's orbit: a Kepler ellipse, and the rotating orbital frame that it carries along."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Float

from keepout.core.errors import ScenarioError
from keepout.core.motion.arrays import as_float64
from keepout.core.motion.frames import orbital_rate, vvlh_axes
from keepout.core.motion.perturbation import EARTH_GRAVITATIONAL_PARAMETER, Perturbation, target_acceleration
from keepout.core.motion.rotation import Vector

Scalar = Float[Array, ""]


class OrbitalFrame(eqx.Module):
    """The VVLH frame at one moment.

    radius: distance of the target from the Earth's centre, m. angular_velocity (rad/s) and angular_acceleration
    (rad/s²): of VVLH against inertial space, in VVLH axes.
    """

    radius: Scalar
    angular_velocity: Vector
    angular_acceleration: Vector


class Orbit(eqx.Module):
    """A Kepler ellipse; time zero is the epoch. Angles in radians, lengths in metres.

    `inclination`, `right_ascension` and `argument_of_perigee` place the ellipse in ECI. Unperturbed relative motion
    does not depend on them; perturbations and conversions to ECI do.

    Raises:
        ScenarioError: a semi-major axis that is not positive, or an eccentricity outside [0, 1).

    """

    semi_major_axis: Scalar = eqx.field(converter=as_float64)
    eccentricity: Scalar = eqx.field(converter=as_float64, default=0.0)
    true_anomaly: Scalar = eqx.field(converter=as_float64, default=0.0)
    inclination: Scalar = eqx.field(converter=as_float64, default=0.0)
    right_ascension: Scalar = eqx.field(converter=as_float64, default=0.0)
    argument_of_perigee: Scalar = eqx.field(converter=as_float64, default=0.0)
    gravitational_parameter: Scalar = eqx.field(converter=as_float64, default=EARTH_GRAVITATIONAL_PARAMETER)

    def __check_init__(self):
        if isinstance(self.semi_major_axis, Tracer) or isinstance(self.eccentricity, Tracer):
            return  # values are not known yet inside a transformation
        if not (math.isfinite(self.semi_major_axis) and float(self.semi_major_axis) > 0):
            raise ScenarioError(f"semi_major_axis: {float(self.semi_major_axis):g} m; it must be positive and finite")
        if not 0 <= float(self.eccentricity) < 1:
            raise ScenarioError(f"eccentricity: {float(self.eccentricity):g}; it must lie in [0, 1)")

    @property
    def period(self) -> Scalar:
        """Orbital period, s."""
        return 2 * jnp.pi / self.mean_motion

    @property
    def mean_motion(self) -> Scalar:
        """Mean motion, rad/s."""
        return jnp.sqrt(self.gravitational_parameter / self.semi_major_axis**3)

    def true_anomaly_at(self, time: Scalar) -> Scalar:
        """Solve for the true anomaly θ(t) in radians, within one turn about perigee."""
        e = self.eccentricity
        half = self.true_anomaly / 2
        start = 2 * jnp.arctan2(jnp.sqrt(1 - e) * jnp.sin(half), jnp.sqrt(1 + e) * jnp.cos(half))
        mean = start - e * jnp.sin(start) + self.mean_motion * time
        eccentric = eccentric_anomaly(mean, e)
        beta = e / (1 + jnp.sqrt(1 - e**2))
        return eccentric + 2 * jnp.arctan2(beta * jnp.sin(eccentric), 1 - beta * jnp.cos(eccentric))

    def frame(self, time: Scalar) -> OrbitalFrame:
        """Give VVLH at `time`: R = a(1−e²)/(1+e cos θ), ω = [0, −θ̇, 0], θ̇ and θ̈ as in the paper (section II)."""
        theta = self.true_anomaly_at(time)
        e = self.eccentricity
        mu_over_p_cubed = self.gravitational_parameter / (self.semi_major_axis * (1 - e**2)) ** 3
        swell = 1 + e * jnp.cos(theta)
        theta_rate = jnp.sqrt(mu_over_p_cubed) * swell**2
        theta_acceleration = -2 * mu_over_p_cubed * e * jnp.sin(theta) * swell**3
        return OrbitalFrame(
            radius=self.semi_major_axis * (1 - e**2) / swell,
            angular_velocity=jnp.array([0.0, -1.0, 0.0]) * theta_rate,
            angular_acceleration=jnp.array([0.0, -1.0, 0.0]) * theta_acceleration,
        )

    def inertial_state(self, time: Scalar) -> tuple[Vector, Vector]:
        """Give the target's ECI position (m) and velocity (m/s) at `time`."""
        theta = self.true_anomaly_at(time)
        e = self.eccentricity
        parameter = self.semi_major_axis * (1 - e**2)
        radius = parameter / (1 + e * jnp.cos(theta))
        speed = jnp.sqrt(self.gravitational_parameter / parameter)
        in_plane = jnp.array([jnp.cos(theta), jnp.sin(theta), 0.0]) * radius
        rate = jnp.array([-jnp.sin(theta), e + jnp.cos(theta), 0.0]) * speed
        axes = _turn_z(self.right_ascension) @ _turn_x(self.inclination) @ _turn_z(self.argument_of_perigee)
        return axes @ in_plane, axes @ rate


def eccentric_anomaly(mean_anomaly: Scalar, eccentricity: Scalar) -> Scalar:
    """Solve Kepler's equation E − e sin E = M for E in [−π, π], to rounding, with a fixed number of operations.

    The starting value is Markley's (1995) cubic, good to about 1e-3 rad for every M and e < 1; two of his
    fourth-order corrections then leave only rounding.
    """
    e = eccentricity
    M = mean_anomaly - 2 * jnp.pi * jnp.round(mean_anomaly / (2 * jnp.pi))
    alpha = (3 * jnp.pi**2 + 1.6 * jnp.pi * (jnp.pi - jnp.abs(M)) / (1 + e)) / (jnp.pi**2 - 6)
    d = 3 * (1 - e) + alpha * e
    q = 2 * alpha * d * (1 - e) - M**2
    r = 3 * alpha * d * (d - 1 + e) * M + M**3
    w = jnp.cbrt(jnp.abs(r) + jnp.sqrt(q**3 + r**2)) ** 2
    E = (2 * r * w / (w**2 + w * q + q**2) + M) / d
    for _ in range(2):
        sine, cosine = e * jnp.sin(E), e * jnp.cos(E)
        f0, f1 = E - sine - M, 1 - cosine
        d3 = -f0 / (f1 - 0.5 * f0 * sine / f1)
        d4 = -f0 / (f1 + 0.5 * d3 * sine + d3**2 * cosine / 6)
        E = E + d4
    return E


def perturbed_frame(
    position: Vector, velocity: Vector, gravitational_parameter: Scalar, perturbations: tuple[Perturbation, ...]
) -> OrbitalFrame:
    """Give the VVLH frame of a target at an ECI position and velocity that feels `perturbations`.

    The angular acceleration is the exact derivative of the angular velocity along the target's motion.
    """

    def inertial_rate(r: Vector, v: Vector) -> Vector:
        momentum = jnp.cross(r, v)
        normal = momentum / jnp.linalg.norm(momentum)
        acceleration = target_acceleration(r, v, gravitational_parameter, perturbations)
        return orbital_rate(r, v, acceleration @ normal)

    acceleration = target_acceleration(position, velocity, gravitational_parameter, perturbations)
    rate, rate_change = jax.jvp(inertial_rate, (position, velocity), (velocity, acceleration))
    axes = vvlh_axes(position, velocity)
    return OrbitalFrame(jnp.linalg.norm(position), axes @ rate, axes @ rate_change)


def _turn_x(angle: Scalar) -> Float[Array, "3 3"]:
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def _turn_z(angle: Scalar) -> Float[Array, "3 3"]:
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
