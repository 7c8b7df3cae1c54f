"""Taking an image: rays against the exact mesh, the first return of each pixel, and then the errors."""

import functools
import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from keepout.apps.unknown.depth.camera import DepthCamera
from keepout.apps.unknown.depth.errors import MIXED_DEPTH, ErrorDraw
from keepout.apps.unknown.mapping.view import Pinhole, View
from keepout.core.errors import ScenarioError
from keepout.core.geometry.first_hit import FirstHit

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
