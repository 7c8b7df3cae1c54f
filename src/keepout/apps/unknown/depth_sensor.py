"""A depth sensor, a scanning or flash lidar or a stereo pair: its settings, its errors, an image of the exact mesh."""

import functools
import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from keepout.apps.led.camera import Pinhole, rotation_by
from keepout.apps.led.first_hit import FirstHit
from keepout.apps.unknown.view import WIDTH_IN_PITCHES, SensorBounds, View
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


SIZES = ("random", "adversarial")
BROKEN = (None, "range", "pose", "mixed", "losses", "late")
"""What may not hold."""
MIXED_DEPTH = 0.1
"""Difference of the ranges in a pixel above which the pixel says their mean, where pixels are mixed, m."""
_TWICE = 2.0
"""Errors over their bounds where those are broken."""


@dataclass(frozen=True)
class ErrorDraw:
    """How errors are drawn.

    Attributes:
        size: "random": evenly from balls and intervals as large as the bounds. "adversarial": as large as the bounds.
            Ranges are all long, or of a random sign each. The place is off by its bound, forwards, so that what is
            seen is taken to be deeper, or sideways, so that edges move, or between; and the axes are turned by their
            bound about an axis across the boresight, so that what is ahead moves the same way sideways.
        broken: the assumption that does not hold, if any. "range": errors of ranges twice as large. "pose": those of
            the place and axes. "mixed": a pixel whose rays' ranges differ by more than `MIXED_DEPTH` says the mean of
            the nearest and the farthest. "losses": a lost return reads as if there were nothing. "late": the pose told
            is of another time.

    Raises:
        ScenarioError: an unknown name.

    """

    size: str = "random"
    broken: str | None = None

    def __post_init__(self) -> None:
        for name, value, valid in (("size", self.size, SIZES), ("broken", self.broken, BROKEN)):
            if value not in valid:
                raise ScenarioError(f"errors of the depth sensor: {name} is {value!r}; it must be one of {valid}")

    def range_errors(
        self, generator: np.random.Generator, shape: tuple[int, int], bounds: SensorBounds
    ) -> Float[np.ndarray, "height width"]:
        """Draw an error for each pixel, m."""
        bound = bounds.range_error * (_TWICE if self.broken == "range" else 1.0)
        if self.size == "random":
            return generator.uniform(-bound, bound, shape)
        if generator.random() < 0.5:
            return np.full(shape, bound)
        return np.where(generator.random(shape) < 0.5, -bound, bound)

    def pose_error(
        self, generator: np.random.Generator, axes: Float[np.ndarray, "3 3"], bounds: SensorBounds
    ) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
        """Draw an error of the place, m, and a rotation, both in the map's frame.

        Args:
            generator: of random numbers.
            axes: the camera's true axes as columns.
            bounds: of the errors.

        Returns:
            What is added to the true place, and what the true axes are turned by: `rotation @ axes`.

        """
        times = _TWICE if self.broken == "pose" else 1.0
        place, angle = times * bounds.position_error, times * bounds.attitude_error
        if self.size == "random":
            return _in_ball(generator, place), rotation_by(_in_ball(generator, angle))
        ahead = axes[:, 2]
        around = generator.uniform(0.0, 2.0 * math.pi)
        sideways = math.cos(around) * axes[:, 0] + math.sin(around) * axes[:, 1]
        lean = generator.choice([0.0, 0.5 * math.pi, generator.uniform(0.0, 0.5 * math.pi)])
        offset = math.cos(lean) * ahead + math.sin(lean) * sideways
        offset *= place / np.linalg.norm(offset)
        turn = np.cross(ahead, sideways)
        return offset, rotation_by(turn * (angle / np.linalg.norm(turn)))


def _in_ball(generator: np.random.Generator, radius: float) -> Float[np.ndarray, "3"]:
    """Draw evenly from a ball."""
    vector = generator.normal(size=3)
    return vector * (radius * generator.random() ** (1.0 / 3.0) / np.linalg.norm(vector))


Vector = Float[np.ndarray, "3"]
Axes = Float[np.ndarray, "3 3"]
Pose = tuple[Vector, Axes]

_NO_ROTATION = 1e-9
"""Greatest departure of axes from a rotation."""
_EXACT = ErrorDraw()


class FirstReturns(NamedTuple):
    """What the pixels of an image see before any error and before random losses.

    Attributes:
        nearest: range of the nearest surface that any ray of the pixel meets within the greatest range; `inf` for none.
        farthest: range of the farthest return of its rays; `-inf` for none.
        lost: whether the nearest surface's return is lost: met at a grazing angle, with no return as near.

    """

    nearest: Float[np.ndarray, "height width"]
    farthest: Float[np.ndarray, "height width"]
    lost: Bool[np.ndarray, "height width"]


def first_returns(camera: DepthCamera, first_hit: FirstHit, position: Vector, axes: Axes) -> FirstReturns:
    """Cast the rays of an image from the sensor's true pose.

    A ray whose return is lost may hide the nearest surface of its pixel. Where another ray of the pixel returns from
    as near or nearer, the loss changes nothing. Where none does, the pixel's true range is not known, and it is lost.

    Args:
        camera: the sensor.
        first_hit: the mesh.
        position: of the sensor, m.
        axes: the camera's axes x, y, z as columns.

    """
    across = camera.bounds.rays_across
    directions = _directions(camera.camera, across) @ axes.T
    ranges, faces = first_hit.cast(position[None], directions, camera.bounds.greatest_range)
    lost = np.zeros(len(ranges), dtype=bool)
    if camera.grazing_angle < math.pi / 2:
        met = np.flatnonzero(faces >= 0)
        cosine = np.abs(np.einsum("ni,ni->n", first_hit.normals[faces[met]], directions[met]))
        lost[met] = cosine < math.cos(camera.grazing_angle)
    height, width = camera.camera.shape
    ranges, lost = (a.reshape(height, across, width, across) for a in (ranges, lost))
    nearest = ranges.min(axis=(1, 3))
    returned = np.where(lost, np.inf, ranges)
    farthest = np.where(np.isfinite(returned), returned, -np.inf).max(axis=(1, 3))
    return FirstReturns(nearest, farthest, nearest < returned.min(axis=(1, 3)))


def take(
    camera: DepthCamera,
    first_hit: FirstHit,
    position: Vector,
    axes: Axes,
    generator: np.random.Generator,
    draw: ErrorDraw = _EXACT,
    *,
    time: float = 0.0,
    told: Pose | None = None,
) -> View:
    """Take an image. Pure but for the generator: the same state of it gives the same bits.

    A pixel says the first return of its rays and an error; `inf` where no ray meets anything within the greatest
    range; `nan` where its return is lost, or nearer than the least range.

    Args:
        camera: the sensor.
        first_hit: the mesh, in the map's frame.
        position: true place of the sensor, m (`DepthCamera.sensor_position` gives it).
        axes: true axes of the camera x, y, z as columns.
        generator: of random numbers.
        draw: how errors are drawn.
        time: of the image, s.
        told: sensor's true position and axes of another time, for images whose pose is told late.

    Returns:
        The image with the estimated pose.

    Raises:
        ScenarioError: a pose that is not one; a pose of another time without `draw.broken` "late", or the reverse;
            losses to be broken of a sensor that loses nothing.

    """
    _check(position, axes, draw, camera, told)
    nearest, farthest, lost = first_returns(camera, first_hit, position, axes)
    ranges = nearest.copy()
    if draw.broken == "mixed":
        mixed = ~lost & (farthest - nearest > MIXED_DEPTH)
        ranges[mixed] = 0.5 * (nearest[mixed] + farthest[mixed])
    ranges = np.maximum(ranges + draw.range_errors(generator, ranges.shape, camera.bounds), 0.0)
    lost |= generator.random(ranges.shape) < camera.dropout
    ranges[lost] = np.inf if draw.broken == "losses" else np.nan
    ranges[nearest < camera.bounds.least_range] = np.nan
    from_place, from_axes = (position, axes) if told is None else told
    offset, rotation = draw.pose_error(generator, from_axes, camera.bounds)
    return View(camera.camera, from_place + offset, rotation @ from_axes, ranges, float(time))


@functools.lru_cache(maxsize=4)
def _directions(camera: Pinhole, across: int) -> Float[np.ndarray, "n 3"]:
    return camera.directions(across).reshape(-1, 3)


def _check(position: Vector, axes: Axes, draw: ErrorDraw, camera: DepthCamera, told: Pose | None) -> None:
    for place, turned in (position, axes), *([told] if told is not None else []):
        if not np.isfinite(place).all():
            raise ScenarioError(f"depth sensor: its position is {place} m; it must be finite")
        if not (np.abs(turned.T @ turned - np.eye(3)).max() <= _NO_ROTATION and np.linalg.det(turned) > 0.0):
            raise ScenarioError(f"depth sensor: its axes are {turned.tolist()}; they must be a rotation matrix")
    if (told is not None) != (draw.broken == "late"):
        have = "no pose of another time" if told is None else "a pose of another time"
        raise ScenarioError(f"errors of the depth sensor: broken is {draw.broken!r} and there is {have}; give both")
    if draw.broken == "losses" and camera.dropout == 0.0 and camera.grazing_angle == math.pi / 2:
        raise ScenarioError(
            "errors of the depth sensor: broken is 'losses' but dropout is 0 and grazing_angle pi/2; one must lose some"
        )
