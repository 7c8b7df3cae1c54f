"""Which views were taken, and which cells stayed closed though a view looked straight at them."""

import math
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, UInt8

from keepout.exploring.cells import ACROSS, Cells
from keepout.exploring.sight import first_closed
from keepout.mapping.known_free import KnownFreeMap
from keepout.mapping.view import View

GIVEN_UP = 3
"""Views that looked at a cell and left it closed, after which nothing more is hoped of it."""
_RAYS = (48, 64)


@dataclass(eq=False)
class Tried:
    """Memory of the views taken so far; it grows by `note` after each."""

    failures: UInt8[np.ndarray, "nx ny nz"]
    """For every cell, views from different directions that looked at it through free room and left it closed."""
    positions: list[Float[np.ndarray, "3"]] = field(default_factory=list)
    axes: list[Float[np.ndarray, "3 3"]] = field(default_factory=list)

    @classmethod
    def nothing(cls, known: KnownFreeMap) -> "Tried":
        """Begin with no view."""
        return cls(np.zeros(tuple((n + ACROSS - 1) // ACROSS for n in known.free.shape), dtype=np.uint8))

    def note(self, known: KnownFreeMap, view: View) -> None:
        """Remember a view that the map has seen: what lies first on its rays and is closed has failed once more.

        Views from within 0.3 m and 10 degrees of an earlier one count once: another try is another direction.
        """
        repeated = any(
            np.linalg.norm(view.position - position) < 0.3
            and view.axes[:, 2] @ axes[:, 2] > math.cos(math.radians(10.0))
            for position, axes in zip(self.positions, self.axes, strict=True)
        )
        self.positions.append(view.position.copy())
        self.axes.append(view.axes.copy())
        if repeated:
            return
        bounds, camera = known.bounds, view.camera
        cells = Cells.of(known)
        ball = 0.5 * math.sqrt(3.0) * known.spacing + bounds.surely_returned_width + bounds.position_error
        rows, columns = _RAYS
        down, across = np.meshgrid(
            (np.arange(rows) + 0.5) / rows - 0.5, (np.arange(columns) + 0.5) / columns - 0.5, indexing="ij"
        )
        rays = np.stack(
            [across * camera.width / camera.focal, down * camera.height / camera.focal, np.ones_like(down)], -1
        )
        rays = rays.reshape(-1, 3)
        length = np.linalg.norm(rays, axis=1)
        found = np.empty((len(rays), 3), dtype=np.int64)
        first_closed(
            cells.kinds,
            (view.position - cells.origin) / cells.edge,
            (rays / length[:, None]) @ view.axes.T,
            (bounds.least_range + ball) / cells.edge,
            (bounds.usable_range(camera) - ball) / cells.edge - 1.0,
            found,
        )
        found, rays = found[found[:, 0] >= 0], rays[found[:, 0] >= 0]
        if len(found) == 0:
            return
        # Cells whose window may reach beyond the image were not tried.
        apart = np.linalg.norm(cells.place(found) - view.position, axis=1)
        window = (ball + known.spacing + bounds.attitude_error * apart) / apart
        whole = np.ones(len(found), dtype=bool)
        for axis, pixels in ((0, camera.width), (1, camera.height)):
            half = math.atan(0.5 * pixels / camera.focal)
            whole &= np.arctan(np.abs(rays[:, axis])) + window < half
        tried = np.unique(found[whole], axis=0)
        index = tuple(tried.T)
        self.failures[index] = np.minimum(self.failures[index].astype(np.int64) + 1, 255).astype(np.uint8)
