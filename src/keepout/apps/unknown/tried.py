"""Which views were taken, and which cells stayed closed though a view looked straight at them."""

import math
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, UInt8

from keepout.apps.led.camera import Pinhole
from keepout.apps.unknown.cells import ACROSS, closed_cells
from keepout.apps.unknown.known_free import KnownFreeMap
from keepout.apps.unknown.sight import first_closed
from keepout.apps.unknown.view import View

PATIENCE, MOST_PATIENCE = 3, 7
SAME_PLACE, SAME_DIRECTION = 0.3, math.cos(math.radians(10.0))
"""Metres, and cosine of an angle, within which two views count as one."""
_RAYS = (48, 64)


@dataclass(eq=False)
class Tried:
    """Memory of the views taken so far; it grows by `note` after each."""

    patience: int
    """Failures after which nothing more is hoped of a cell."""
    failures: UInt8[np.ndarray, "nx ny nz"]
    """For every cell, views from different directions that looked at it through free room and left it closed."""
    positions: list[Float[np.ndarray, "3"]] = field(default_factory=list)
    axes: list[Float[np.ndarray, "3 3"]] = field(default_factory=list)

    @classmethod
    def nothing(cls, known: KnownFreeMap) -> "Tried":
        """Begin with no view.

        Where no return says nothing, a cell opens only in front of a surface, so more directions are worth trying.
        """
        patience = PATIENCE if known.bounds.sure_empty_range > 0.0 else MOST_PATIENCE
        return cls(patience, np.zeros(tuple((n + ACROSS - 1) // ACROSS for n in known.free.shape), dtype=np.uint8))

    @classmethod
    def of_map(cls, known: KnownFreeMap, camera: Pinhole) -> "Tried":
        """Remember the views that a map took, for one that was read from a file.

        What a view could look at is judged by the map as it is now, so at least as many failures are counted as by
        `note` after each view.
        """
        tried = cls.nothing(known)
        for seen in known.seen:
            tried._remember(known, camera, seen.position, seen.axes)
        return tried

    def note(self, known: KnownFreeMap, view: View) -> None:
        """Remember a view that the map has seen: what lies first on its rays and is closed has failed once more.

        Views from within 0.3 m and 10 degrees of an earlier one count once: another try is another direction.
        """
        self._remember(known, view.camera, view.position, view.axes)

    def repeats(self, position: Float[np.ndarray, "3"], boresight: Float[np.ndarray, "3"]) -> bool:
        """Whether a view was taken from so near a place in so near a direction that another would tell nothing new."""
        return any(
            np.linalg.norm(position - earlier) < SAME_PLACE and boresight @ axes[:, 2] > SAME_DIRECTION
            for earlier, axes in zip(self.positions, self.axes, strict=True)
        )

    def _remember(
        self, known: KnownFreeMap, camera: Pinhole, position: Float[np.ndarray, "3"], axes: Float[np.ndarray, "3 3"]
    ) -> None:
        repeated = self.repeats(position, axes[:, 2])
        self.positions.append(position.copy())
        self.axes.append(axes.copy())
        if repeated:
            return
        bounds = known.bounds
        edge = ACROSS * known.spacing
        ball = 0.5 * math.sqrt(3.0) * known.spacing + bounds.surely_returned_width + bounds.position_error
        rays = _rays(camera)
        found = np.empty((len(rays), 3), dtype=np.int64)
        first_closed(
            closed_cells(known.free),
            (position - known.origin) / edge,
            (rays / np.linalg.norm(rays, axis=1, keepdims=True)) @ axes.T,
            (bounds.least_range + ball) / edge,
            (bounds.usable_range(camera) - ball) / edge - 1.0,
            found,
        )
        found, rays = found[found[:, 0] >= 0], rays[found[:, 0] >= 0]
        if len(found) == 0:
            return
        # Cells whose window may reach beyond the image were not tried.
        apart = np.linalg.norm(known.origin + edge * (found + 0.5) - position, axis=1)
        window = (ball + known.spacing + bounds.attitude_error * apart) / apart
        whole = np.ones(len(found), dtype=bool)
        for axis, pixels in ((0, camera.width), (1, camera.height)):
            half = math.atan(0.5 * pixels / camera.focal)
            whole &= np.arctan(np.abs(rays[:, axis])) + window < half
        index = tuple(np.unique(found[whole], axis=0).T)
        self.failures[index] = np.minimum(self.failures[index].astype(np.int64) + 1, 255).astype(np.uint8)


def _rays(camera: Pinhole) -> Float[np.ndarray, "n 3"]:
    """Rays evenly over the image, in camera axes, 1 along the boresight."""
    rows, columns = ((np.arange(count) + 0.5) / count - 0.5 for count in _RAYS)
    down, across = np.meshgrid(rows, columns, indexing="ij")
    rays = [across * camera.width / camera.focal, down * camera.height / camera.focal, np.ones_like(down)]
    return np.stack(rays, axis=-1).reshape(-1, 3)
