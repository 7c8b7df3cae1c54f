"""Where the sun is, and how much of it a spacecraft in the Earth's shadow sees."""

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from keepout.core.motion.perturbation import EARTH_EQUATORIAL_RADIUS, Perturbation
from keepout.core.motion.rotation import Vector

SOLAR_PRESSURE = 4.56e-6
"""Of sunlight at the Earth's distance on a surface that absorbs it, N/m² (Montenbruck and Gill, section 3.4)."""
PENUMBRA = 20_000.0
"""Width of the shadow's edge, m: as at an altitude of 400 km. Across it the light rises linearly."""

_DAY = 86_400_000_000_000
_J2000 = 10_957.5
"""Days from 1970-01-01 to 2000-01-01 12:00."""


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
        [
            math.cos(longitude),
            math.cos(obliquity) * math.sin(longitude),
            math.sin(obliquity) * math.sin(longitude),
        ]
    )


def lit(position: Vector, direction: Vector) -> Float[Array, ""]:
    """Give the share of the sun, 0 to 1, that is seen at an ECI position (m): the shadow is a cylinder with an edge.

    Continuous wherever a spacecraft is more than half of `PENUMBRA` above the equatorial radius.
    """
    along = position @ direction
    beside = jnp.linalg.norm(position - along * direction)
    share = jnp.clip((beside - EARTH_EQUATORIAL_RADIUS) / PENUMBRA + 0.5, 0.0, 1.0)
    return jnp.where(along < 0.0, share, 1.0)


class SolarPressure(Perturbation):
    """The push of sunlight on a ball ("cannonball"), away from the sun; the sun stands still.

    direction: unit vector from the Earth to the sun, ECI. target_area_to_mass, chaser_area_to_mass: radiation pressure
    coefficient × area / mass of each, m²/kg.
    """

    direction: tuple[float, float, float]
    target_area_to_mass: float
    chaser_area_to_mass: float

    def of_target(self, position: Vector, velocity: Vector) -> Vector:
        """Acceleration of the target, m/s²."""
        return self.target_area_to_mass * self._per_area_to_mass(position)

    def of_chaser(self, position: Vector, velocity: Vector) -> Vector:
        """Acceleration of the chaser, m/s²."""
        return self.chaser_area_to_mass * self._per_area_to_mass(position)

    def _per_area_to_mass(self, position: Vector) -> Vector:
        direction = jnp.asarray(self.direction)
        return -SOLAR_PRESSURE * lit(position, direction) * direction
