"""The settings of a depth sensor, a scanning or flash lidar or a stereo pair: optics, promises, rhythm and losses."""

import math
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from keepout.apps.unknown.mapping.view import WIDTH_IN_PITCHES, Pinhole, SensorBounds
from keepout.core.errors import ScenarioError


@dataclass(frozen=True)
class DepthCamera:
    """A depth sensor: image, bounds, when it looks, where it sits, and which returns it loses.

    A lost return is one that the sensor knows to be lost: its pixel says nothing (nan), instead of saying that there is
    nothing (inf).

    Attributes:
        camera: pixels and angle of view.
        bounds: what is promised of each image.
        period: time between images, s.
        latency: time from an image to when it can be used, s.
        mounting: (3,) of the sensor from the chaser's centre, in camera axes, m.
        dropout: probability that a pixel's return is lost.
        grazing_angle: angle from a surface's normal beyond which its return is lost, rad; pi/2: none is.

    Raises:
        ScenarioError: a number outside its range, or a `surely_returned_width` so small that nothing beyond the least
            range may be used.

    """

    camera: Pinhole = field(default_factory=lambda: Pinhole(160, 120, math.radians(60.0)))
    bounds: SensorBounds = field(default_factory=SensorBounds)
    period: float = 10.0
    latency: float = 0.0
    mounting: tuple[float, float, float] = (0.0, 0.0, 0.0)
    dropout: float = 0.0
    grazing_angle: float = math.pi / 2

    def __post_init__(self) -> None:
        if not (math.isfinite(self.period) and self.period > 0.0):
            raise ScenarioError(f"depth sensor: period is {self.period:g} s; it must be finite and above 0")
        if not (math.isfinite(self.latency) and self.latency >= 0.0):
            raise ScenarioError(f"depth sensor: latency is {self.latency:g} s; it must be finite and at least 0")
        if len(self.mounting) != 3 or not all(math.isfinite(part) for part in self.mounting):
            raise ScenarioError(f"depth sensor: mounting is {self.mounting}; it must be three finite numbers, in m")
        if not 0.0 <= self.dropout <= 1.0:
            raise ScenarioError(f"depth sensor: dropout is {self.dropout:g}; it must be a probability, 0 to 1")
        if not 0.0 < self.grazing_angle <= math.pi / 2:
            raise ScenarioError(
                f"depth sensor: grazing_angle is {self.grazing_angle:g} rad; it must be above 0 and at most pi/2"
            )
        bounds = self.bounds
        usable = bounds.usable_range(self.camera)
        if not usable > bounds.least_range:
            raise ScenarioError(
                f"depth sensor: surely_returned_width is {bounds.surely_returned_width:g} m, which returns surely up "
                f"to {usable:g} m only; it must be above {WIDTH_IN_PITCHES * self.ray_pitch * bounds.least_range:g} m "
                f"to be of use beyond least_range = {bounds.least_range:g} m"
            )

    @property
    def ray_pitch(self) -> float:
        """Angle between neighbouring rays in the middle of the image, rad: their distance at a range of 1."""
        return 1.0 / (self.camera.focal * self.bounds.rays_across)

    def sensor_position(
        self, position: Float[np.ndarray, "3"], axes: Float[np.ndarray, "3 3"]
    ) -> Float[np.ndarray, "3"]:
        """Give where the sensor is, m, from the chaser's centre and the camera's axes as columns."""
        return position + axes @ np.asarray(self.mounting, dtype=np.float64)
