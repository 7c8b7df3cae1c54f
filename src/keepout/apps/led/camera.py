"""A pinhole camera, its axes along a direction, and a boresight that turns with bounded rate and acceleration."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from keepout.core.errors import MapError, ScenarioError

Vector = Float[np.ndarray, "3"]

_PARALLEL = 1e-9
"""Sine of an angle below which two directions count as one line."""


@dataclass(frozen=True)
class Pinhole:
    """A pinhole camera with square pixels; axes x right, y down, z along the boresight.

    Pixel (row i, column j) is the square [j, j+1] x [i, i+1] of the image, whose point (a, b) looks along
    ((a - width/2) / focal, (b - height/2) / focal, 1).

    Attributes:
        width: pixels across.
        height: pixels down.
        horizontal_angle: full angle of view across the width, rad.

    """

    width: int
    height: int
    horizontal_angle: float

    def __post_init__(self) -> None:
        for name, value in (("width", self.width), ("height", self.height)):
            if not 1 <= value <= 8192:
                raise MapError(f"camera {name} = {value}; it must be 1 to 8192 pixels")
        if not 0.0 < self.horizontal_angle <= 3.0:
            raise MapError(f"camera horizontal_angle = {self.horizontal_angle}; it must be positive and at most 3 rad")

    @property
    def focal(self) -> float:
        """Focal length in pixels."""
        return 0.5 * self.width / math.tan(0.5 * self.horizontal_angle)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of an image."""
        return self.height, self.width

    def directions(self, rays_across: int = 1) -> Float[np.ndarray, "rows columns 3"]:
        """Give unit vectors (height * rays_across, width * rays_across, 3) in camera axes.

        Args:
            rays_across: rays across and down a pixel, at the centres of as many equal sub-squares.

        """
        across = ((np.arange(self.width * rays_across) + 0.5) / rays_across - 0.5 * self.width) / self.focal
        down = ((np.arange(self.height * rays_across) + 0.5) / rays_across - 0.5 * self.height) / self.focal
        rays = np.ones((len(down), len(across), 3))
        rays[..., 0] = across
        rays[..., 1] = down[:, None]
        return rays / np.linalg.norm(rays, axis=2, keepdims=True)


def angle_between(first: Vector, second: Vector) -> float:
    """Give the angle between two directions, rad, of any length but zero: without loss near 0 and a half turn."""
    return math.atan2(float(np.linalg.norm(np.cross(first, second))), float(first @ second))


def rotation_by(vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Give the rotation about a vector by its length (rad): Rodrigues' formula, without loss at small angles."""
    x, y, z = vector
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = float(np.linalg.norm(vector))
    first, second = np.sinc(angle / math.pi), 0.5 * np.sinc(0.5 * angle / math.pi) ** 2
    return np.eye(3) + first * cross + second * cross @ cross


def axes_towards(direction: Vector, up: Vector) -> Float[np.ndarray, "3 3"]:
    """Give the camera's axes as columns, z along a direction and y as far down as it goes.

    Args:
        direction: of the boresight, any length but zero.
        up: what is up in the image. Where the boresight is along it, the coordinate axis farthest from both takes its
            place.

    Raises:
        ScenarioError: a direction that is zero or not finite.

    """
    z = _unit(direction, "direction")
    side = np.cross(z, _unit(up, "up"))
    if np.linalg.norm(side) < _PARALLEL:
        side = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
    y = _unit(np.cross(z, side), "up")
    # A short side carries rounding along z; made from y and z, x is across both.
    return np.column_stack([np.cross(y, z), y, z])


def axes_across(normals: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Give two unit vectors across each unit normal: with it they are right-handed axes."""
    first = np.cross(normals, np.eye(3)[np.abs(normals).argmin(axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(normals, first)


@dataclass(frozen=True, eq=False)
class Boresight:
    """A boresight that turns; a value, which `step` makes a new one of.

    It turns along the great circle to the wanted direction, as fast as it may and can still stop: from rest towards a
    direction that stays, it arrives exactly and never passes it. Both limits hold whatever is wanted.

    Attributes:
        direction: unit vector along the boresight.
        turning: angular velocity, rad/s, across the boresight; it is held over a period.
        greatest_rate: of the turn, rad/s.
        greatest_acceleration: of the turn, rad/s²: in a period the angular velocity changes by at most this times the
            period.

    Raises:
        ScenarioError: a number outside its range.

    """

    direction: Vector
    turning: Vector
    greatest_rate: float
    greatest_acceleration: float

    def __post_init__(self) -> None:
        for name, unit in (("greatest_rate", "rad/s"), ("greatest_acceleration", "rad/s2")):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ScenarioError(f"boresight: {name} is {value:g} {unit}; it must be finite and above 0")

    @classmethod
    def at_rest(cls, direction: Vector, *, greatest_rate: float, greatest_acceleration: float) -> "Boresight":
        """Start along a direction, of any length but zero, without turning."""
        return cls(_unit(direction, "direction"), np.zeros(3), greatest_rate, greatest_acceleration)

    def off(self, wanted: Vector) -> float:
        """Give the angle to a wanted direction, rad."""
        return angle_between(self.direction, _unit(wanted, "wanted direction"))

    def step(self, wanted: Vector, period: float) -> "Boresight":
        """Turn towards a wanted direction for a period (s)."""
        if not (math.isfinite(period) and period > 0.0):
            raise ScenarioError(f"boresight: the period is {period:g} s; it must be finite and above 0")
        angle = self.off(wanted)
        axis = np.cross(self.direction, _unit(wanted, "wanted direction"))
        if np.linalg.norm(axis) < _PARALLEL and angle > 1.0:  # straight behind: as it already turns, or any way
            axis = self.turning if self.turning.any() else axes_towards(self.direction, np.eye(3)[2])[:, 0]
        length = np.linalg.norm(axis)
        gain = self.greatest_acceleration * period
        speed = min(_stoppable(angle / (gain * period)) * gain, self.greatest_rate)
        change = (axis * (speed / length) if length > 0.0 else np.zeros(3)) - self.turning
        size = np.linalg.norm(change)
        turning = self.turning + change * min(1.0, gain / size if size > 0.0 else 1.0)
        direction = rotation_by(turning * period) @ self.direction
        direction /= np.linalg.norm(direction)
        # Rounding tips the axis out of the plane across the boresight.
        turning = turning - (turning @ direction) * direction
        return Boresight(direction, turning, self.greatest_rate, self.greatest_acceleration)


def _stoppable(way: float) -> float:
    """Give the speed whose way to rest, this step's included, is `way`.

    Units: a step, and the change of speed that a step may make. From speed v with n - 1 < v <= n the steps are v,
    v - 1, ..., and their sum is n v - n (n - 1)/2, which is n (n + 1)/2 at v = n.
    """
    n = max(math.ceil(0.5 * (math.sqrt(1.0 + 8.0 * way) - 1.0)), 1)
    return way / n + 0.5 * (n - 1)


def _unit(vector: Vector, name: str) -> Vector:
    vector = np.asarray(vector, dtype=np.float64)
    length = float(np.linalg.norm(vector))
    if not (math.isfinite(length) and length > 0.0):
        raise ScenarioError(f"boresight: the {name} is {vector}; it must be finite and not zero")
    return vector / length
