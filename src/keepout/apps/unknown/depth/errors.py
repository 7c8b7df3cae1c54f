"""How wrong an image is, within what is promised, or in one way beyond it."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from keepout.apps.unknown.mapping.view import SensorBounds
from keepout.core.errors import ScenarioError

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


def rotation_by(vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Give the rotation about a vector by its length (rad): Rodrigues' formula, without loss at small angles."""
    x, y, z = vector
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = float(np.linalg.norm(vector))
    first, second = np.sinc(angle / math.pi), 0.5 * np.sinc(0.5 * angle / math.pi) ** 2
    return np.eye(3) + first * cross + second * cross @ cross


def _in_ball(generator: np.random.Generator, radius: float) -> Float[np.ndarray, "3"]:
    """Draw evenly from a ball."""
    vector = generator.normal(size=3)
    return vector * (radius * generator.random() ** (1.0 / 3.0) / np.linalg.norm(vector))
