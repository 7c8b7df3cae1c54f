"""Accelerations beyond the Earth's point mass: its oblateness, and differential drag. All in ECI, SI units."""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from keepout.core.motion.rotation import Vector

# EGM-96 / WGS-84 values.
EARTH_GRAVITATIONAL_PARAMETER = 3.986004418e14  # m^3/s^2
EARTH_EQUATORIAL_RADIUS = 6378137.0  # m
EARTH_J2 = 1.08262668e-3
EARTH_ROTATION_RATE = 7.292115e-5  # rad/s


class Perturbation(eqx.Module):
    """An acceleration that depends on where a body is and how fast it moves."""

    @abc.abstractmethod
    def of_target(self, position: Vector, velocity: Vector) -> Vector:
        """Acceleration of the target, m/s², at an ECI position and velocity."""

    @abc.abstractmethod
    def of_chaser(self, position: Vector, velocity: Vector) -> Vector:
        """Acceleration of the chaser, m/s², at an ECI position and velocity."""


class J2(Perturbation):
    """The Earth's oblateness, the same for both spacecraft (Vallado, Fundamentals of Astrodynamics, section 8.7)."""

    coefficient: float = EARTH_J2
    equatorial_radius: float = EARTH_EQUATORIAL_RADIUS
    gravitational_parameter: float = EARTH_GRAVITATIONAL_PARAMETER

    def of_target(self, position: Vector, velocity: Vector) -> Vector:
        """Acceleration at an ECI position, m/s²."""
        radius_squared = position @ position
        radius = jnp.sqrt(radius_squared)
        strength = 1.5 * self.coefficient * self.gravitational_parameter * self.equatorial_radius**2 / radius**5
        polar = 5 * position[2] ** 2 / radius_squared
        return strength * position * (polar - jnp.array([1.0, 1.0, 3.0]))

    def of_chaser(self, position: Vector, velocity: Vector) -> Vector:
        """Acceleration at an ECI position, m/s²."""
        return self.of_target(position, velocity)


class Drag(Perturbation):
    """Drag in an exponential atmosphere that turns with the Earth.

    target_area_to_mass, chaser_area_to_mass: drag coefficient × area / mass of each, m²/kg. density: kg/m³ at
    `altitude` (m above the equatorial radius). scale_height: m.
    """

    target_area_to_mass: float
    chaser_area_to_mass: float
    density: float
    altitude: float
    scale_height: float
    equatorial_radius: float = EARTH_EQUATORIAL_RADIUS
    rotation_rate: float = EARTH_ROTATION_RATE

    def of_target(self, position: Vector, velocity: Vector) -> Vector:
        """Acceleration of the target, m/s²."""
        return self.target_area_to_mass * self._per_area_to_mass(position, velocity)

    def of_chaser(self, position: Vector, velocity: Vector) -> Vector:
        """Acceleration of the chaser, m/s²."""
        return self.chaser_area_to_mass * self._per_area_to_mass(position, velocity)

    def _per_area_to_mass(self, position: Vector, velocity: Vector) -> Vector:
        air = velocity - self.rotation_rate * jnp.array([-position[1], position[0], 0.0])
        height = jnp.linalg.norm(position) - self.equatorial_radius - self.altitude
        return -0.5 * self.density * jnp.exp(-height / self.scale_height) * jnp.linalg.norm(air) * air


def target_acceleration(
    position: Vector,
    velocity: Vector,
    gravitational_parameter: Float[Array, ""],
    perturbations: tuple[Perturbation, ...],
) -> Vector:
    """Acceleration of the target in ECI, m/s²: the point mass and every perturbation."""
    acceleration = -gravitational_parameter * position / jnp.linalg.norm(position) ** 3
    for perturbation in perturbations:
        acceleration = acceleration + perturbation.of_target(position, velocity)
    return acceleration
