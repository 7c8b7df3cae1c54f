"""The target's orbit: a Kepler ellipse, the rotating frame that it carries along, and what bends it.

Beyond the Earth's point mass that is its oblateness, differential drag, and the push of sunlight. All in ECI, SI units.
"""

import abc
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from keepout.core.errors import ScenarioError
from keepout.core.motion.arrays import Scalar, Vector, as_float64
from keepout.core.motion.rotation import orbital_rate, vvlh_axes

# EGM-96 / WGS-84 values.
EARTH_GRAVITATIONAL_PARAMETER = 3.986004418e14  # m^3/s^2
EARTH_EQUATORIAL_RADIUS = 6378137.0  # m
EARTH_J2 = 1.08262668e-3
EARTH_ROTATION_RATE = 7.292115e-5  # rad/s
SOLAR_PRESSURE = 4.56e-6
"""Of sunlight at the Earth's distance on a surface that absorbs it, N/m² (Montenbruck and Gill, section 3.4)."""
PENUMBRA = 20_000.0
"""Width of the shadow's edge, m: as at an altitude of 400 km. Across it the light rises linearly."""

_DAY = 86_400_000_000_000
_J2000 = 10_957.5
"""Days from 1970-01-01 to 2000-01-01 12:00."""


class Perturbation(eqx.Module):
    """An acceleration that depends on where a body is and how fast it moves."""

    @abc.abstractmethod
    def of_target(self, position: Vector, velocity: Vector) -> Vector:
        """Acceleration of the target, m/s², at an ECI position and velocity."""

    def of_chaser(self, position: Vector, velocity: Vector) -> Vector:
        """Acceleration of the chaser, m/s², at an ECI position and velocity; by default as of the target."""
        return self.of_target(position, velocity)


class J2(Perturbation):
    """The Earth's oblateness, the same for both spacecraft (Vallado, Fundamentals of Astrodynamics, section 8.7)."""

    def of_target(self, position: Vector, velocity: Vector) -> Vector:
        """Acceleration at an ECI position, m/s²."""
        radius_squared = position @ position
        radius = jnp.sqrt(radius_squared)
        strength = 1.5 * EARTH_J2 * EARTH_GRAVITATIONAL_PARAMETER * EARTH_EQUATORIAL_RADIUS**2 / radius**5
        polar = 5 * position[2] ** 2 / radius_squared
        return strength * position * (polar - jnp.array([1.0, 1.0, 3.0]))


class _ByArea(Perturbation):
    """An acceleration in proportion to area over mass, which differs between the two spacecraft."""

    target_area_to_mass: float
    chaser_area_to_mass: float

    def of_target(self, position: Vector, velocity: Vector) -> Vector:
        """Acceleration of the target, m/s²."""
        return self.target_area_to_mass * self._per_area_to_mass(position, velocity)

    def of_chaser(self, position: Vector, velocity: Vector) -> Vector:
        """Acceleration of the chaser, m/s²."""
        return self.chaser_area_to_mass * self._per_area_to_mass(position, velocity)

    @abc.abstractmethod
    def _per_area_to_mass(self, position: Vector, velocity: Vector) -> Vector:
        """Acceleration of a body with 1 m²/kg, m/s²."""


class Drag(_ByArea):
    """Drag in an exponential atmosphere that turns with the Earth.

    target_area_to_mass, chaser_area_to_mass: drag coefficient × area / mass of each, m²/kg. density: kg/m³ at
    `altitude` (m above the equatorial radius). scale_height: m.
    """

    density: float
    altitude: float
    scale_height: float

    def _per_area_to_mass(self, position: Vector, velocity: Vector) -> Vector:
        air = velocity - EARTH_ROTATION_RATE * jnp.array([-position[1], position[0], 0.0])
        height = jnp.linalg.norm(position) - EARTH_EQUATORIAL_RADIUS - self.altitude
        return -0.5 * self.density * jnp.exp(-height / self.scale_height) * jnp.linalg.norm(air) * air


def sun_direction(instant: int) -> Float[np.ndarray, "3"]:
    """Give the unit vector from the Earth to the sun in the equator and equinox of date.

    Good to 0.01° from 1950 to 2050 (Vallado, Fundamentals of Astrodynamics, algorithm 29). UTC is taken for UT1, and
    the axes for those of the orbit: from 2000 to 2050 they differ by up to 0.7°.

    Args:
        instant: of UTC, nanoseconds since 1970-01-01.

    """
    centuries = (instant / _DAY - _J2000) / 36_525.0
    anomaly = math.radians(357.529_109_2 + 35_999.050_34 * centuries)
    mean_longitude = 280.460 + 36_000.771 * centuries
    longitude = math.radians(
        mean_longitude + 1.914_666_471 * math.sin(anomaly) + 0.019_994_643 * math.sin(2.0 * anomaly)
    )
    obliquity = math.radians(23.439_291 - 0.013_004_2 * centuries)
    return np.array(
        [math.cos(longitude), math.cos(obliquity) * math.sin(longitude), math.sin(obliquity) * math.sin(longitude)]
    )


def lit(position: Vector, direction: Vector) -> Scalar:
    """Give the share of the sun, 0 to 1, that is seen at an ECI position (m): the shadow is a cylinder with an edge.

    Continuous wherever a spacecraft is more than half of `PENUMBRA` above the equatorial radius.
    """
    along = position @ direction
    beside = jnp.linalg.norm(position - along * direction)
    share = jnp.clip((beside - EARTH_EQUATORIAL_RADIUS) / PENUMBRA + 0.5, 0.0, 1.0)
    return jnp.where(along < 0.0, share, 1.0)


class SolarPressure(_ByArea):
    """The push of sunlight on a ball ("cannonball"), away from the sun; the sun stands still.

    direction: unit vector from the Earth to the sun, ECI. target_area_to_mass, chaser_area_to_mass: radiation pressure
    coefficient × area / mass of each, m²/kg.
    """

    direction: tuple[float, float, float]

    def _per_area_to_mass(self, position: Vector, velocity: Vector) -> Vector:
        direction = jnp.asarray(self.direction)
        return -SOLAR_PRESSURE * lit(position, direction) * direction


def target_acceleration(
    position: Vector, velocity: Vector, gravitational_parameter: Scalar, perturbations: tuple[Perturbation, ...]
) -> Vector:
    """Acceleration of the target in ECI, m/s²: the point mass and every perturbation."""
    acceleration = -gravitational_parameter * position / jnp.linalg.norm(position) ** 3
    for perturbation in perturbations:
        acceleration = acceleration + perturbation.of_target(position, velocity)
    return acceleration


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
