"""One depth image: what is promised of the sensor that took it, and where it was taken from."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from keepout.apps.led.camera import Pinhole
from keepout.core.errors import MapError

WIDTH_IN_PITCHES = 2.0
"""Ray pitches that a part must be wide to return surely: at a right-angled corner the reach is 1.71 of them."""


@dataclass(frozen=True)
class SensorBounds:
    """What is promised of a depth sensor; the theorem in docs/mapping.md names each number."""

    range_error: float = 0.03
    """Greatest error of a range, m."""
    position_error: float = 0.05
    """Greatest error of the sensor's place in the map's frame, drift included, m."""
    attitude_error: float = 0.005
    """Greatest angle between the sensor's true and estimated axes in the map's frame, rad."""
    surely_returned_width: float = 0.03
    """Within this lateral distance of any point of the target within the usable range a ray meets the target, m."""
    rays_across: int = 5
    """Rays across and down a pixel; its range is the first return of all of them."""
    sure_empty_range: float = 15.0
    """A pixel without return is empty out to this range, m; 0: no return says nothing."""
    least_range: float = 0.3
    """Nearer than this the sensor says nothing, m."""
    greatest_range: float = 15.0
    """Farther than this the sensor says nothing, m."""

    def __post_init__(self) -> None:
        for name in ("range_error", "position_error", "attitude_error", "sure_empty_range", "least_range"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise MapError(f"sensor {name} = {value}; it must be finite and not negative")
        if not self.attitude_error < 0.5:
            raise MapError(f"sensor attitude_error = {self.attitude_error}; it must be less than 0.5 rad")
        if not (math.isfinite(self.surely_returned_width) and self.surely_returned_width > 0.0):
            raise MapError(f"sensor surely_returned_width = {self.surely_returned_width}; it must be positive, in m")
        if not self.least_range < self.greatest_range <= 1000.0:
            raise MapError(
                f"sensor greatest_range = {self.greatest_range}; it must be more than least_range = "
                f"{self.least_range} m and at most 1000 m"
            )
        if not 1 <= self.rays_across <= 64:
            raise MapError(f"sensor rays_across = {self.rays_across}; it must be 1 to 64")

    def usable_range(self, camera: Pinhole) -> float:
        """Farthest range at which parts as wide as `surely_returned_width` surely return, m."""
        pitch = 1.0 / (camera.focal * self.rays_across)
        return min(self.greatest_range, self.surely_returned_width / (WIDTH_IN_PITCHES * pitch))

    def return_error(self, camera: Pinhole, ranges: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Bound how far from a part of the target its return is put, m, at some ranges (m).

        It is ε_ρ + ε_p + v (ε_θ + a): the errors of range and place; at the range v those of the axes, and the angle a
        between the pixel's middle, where the return is put, and the ray of the pixel that returned.
        """
        # Rays are at the middles of sub-squares; on the image plane they are farther apart than on the sphere.
        aside = math.hypot(0.5, 0.5) * (1.0 - 1.0 / self.rays_across) / camera.focal
        return self.range_error + self.position_error + ranges * (self.attitude_error + aside)


@dataclass(frozen=True, eq=False)
class View:
    """One image of ranges and the estimated pose that it was taken from, in the map's frame."""

    camera: Pinhole
    position: Float[np.ndarray, "3"]
    """Estimated place of the sensor, m."""
    axes: Float[np.ndarray, "3 3"]
    """Estimated camera axes x, y, z as columns."""
    ranges: Float[np.ndarray, "height width"]
    """First return of each pixel, m; inf: no return; nan: says nothing."""
    time: float = 0.0
    """When it was taken, s."""

    def __post_init__(self) -> None:
        if self.ranges.shape != self.camera.shape:
            raise MapError(f"view ranges of shape {self.ranges.shape}; the camera's images are {self.camera.shape}")
        if self.position.shape != (3,) or self.axes.shape != (3, 3):
            raise MapError(
                f"view position of shape {self.position.shape} and axes of shape {self.axes.shape}; they must be (3,) "
                "and (3, 3)"
            )

    def points(self) -> Float[np.ndarray, "m 3"]:
        """Give the place of each return in the map's frame, m: the pixel's middle at its range, by the estimate."""
        returned = np.isfinite(self.ranges)
        rays = self.camera.directions()[returned] @ self.axes.T
        return self.position + self.ranges[returned][:, None] * rays
