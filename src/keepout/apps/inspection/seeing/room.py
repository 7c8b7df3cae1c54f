"""The room allowed to a chaser's centre: no nearer to the mesh than the stand-off, and connected with far outside."""

import math

import numpy as np
from jaxtyping import Bool, Float

from keepout.apps.inspection.seeing.beam import Limits, boxes_meet
from keepout.apps.inspection.seeing.rules import SeeingRules
from keepout.core.errors import InspectionError
from keepout.core.geometry.distance import Distance, ExactDistance, Points
from keepout.core.geometry.octree import SQRT3, refine
from keepout.core.progress import Progress, silent

_ROUNDING = 1e-9
"""Metres; above the rounding of an exact distance by orders of magnitude."""
_DEEPEST = 10
"""Halvings of the cube: a thousand cells across at most."""
_STEPS = 24
"""Of a walk up the distance; each about doubles what is left above the stand-off."""


class Room:
    """The component of {distance to the mesh >= stand_off} that reaches far outside, between two bounds.

    An octree is flooded twice from outside: through cells that lie in the set as a whole (what they reach surely
    belongs to the room), and through cells that may hold a point of it (what they do not reach surely does not). A
    path through the closed set that passes from cell to cell over an edge or a corner meets all cells around it, so
    the second flood, too, goes from face to face.

    Args:
        distance: exact unsigned distance to the mesh.
        stand_off: least distance of the chaser's centre, m, positive.
        leaf: side of the smallest cells, m; a fifth of the stand-off where absent, and never less than a
            thousandth of the target's size.
        progress: told of the flood.

    Attributes:
        distance: as given.
        stand_off: as given.
        origin: (3,) lowest corner of the octree's cube, m.
        side: of that cube, m. All beyond it belongs to the room.

    Raises:
        InspectionError: a stand-off or leaf that is not positive and finite.

    """

    def __init__(
        self, distance: Distance, stand_off: float, *, leaf: float | None = None, progress: Progress = silent
    ) -> None:
        leaf = 0.2 * stand_off if leaf is None else leaf
        for name, value in (("stand_off", stand_off), ("leaf", leaf)):
            if not 0.0 < value < math.inf:
                raise InspectionError(f"room: {name} is {value:g} m; it must be positive and finite")
        self.distance = distance
        self.stand_off = float(stand_off)
        extent = float((distance.upper - distance.lower).max())
        self.side = extent + 2.0 * (self.stand_off + 2.0 * leaf) + 1e-3
        self.origin: Float[np.ndarray, 3] = 0.5 * (distance.lower + distance.upper) - 0.5 * self.side
        depth = max(1, min(_DEEPEST, math.ceil(math.log2(self.side / leaf))))

        def visit(centres: Points, half_width: float, level: int) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
            progress(level / (depth + 1), f"room: level {level} of {depth}")
            d, reach = distance.distance(centres), half_width * SQRT3 + _ROUNDING
            within, outside = d - reach > self.stand_off, d + reach < self.stand_off
            return ~within & ~outside, (within, ~outside)

        self._cells, (within, possible) = refine(self.origin, self.side, depth, visit, 2)
        last = (1 << self._cells.level.astype(np.int32)) - 1
        outer = (self._cells.index == 0).any(axis=1) | (self._cells.index == last[:, None]).any(axis=1)
        self._sure = self._cells.connected(within, outer)
        self._possible = self._cells.connected(possible, outer)

    def allowed(self, points: Points) -> Bool[np.ndarray, " n"]:
        """Say which points surely belong to the room; a few of those that do, at its very border, are not said to.

        Args:
            points: (n, 3) m, body frame.

        """
        points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
        answer = np.zeros(len(points), bool)
        here, gradient = self.distance.distance_and_gradient(points)
        active = np.flatnonzero(here >= self.stand_off)
        places, here, gradient = points[active], here[active], gradient[active]
        for _ in range(_STEPS):
            holder = self._cells.locate(places)
            arrived = (holder < 0) | self._sure[holder]
            answer[active[arrived]] = True
            going = ~arrived & self._possible[holder]
            active, places, here, gradient = active[going], places[going], here[going], gradient[going]
            if len(active) == 0:
                break
            # Within the ball of this radius every point is at least the stand-off from the mesh.
            step = np.maximum(here - self.stand_off - _ROUNDING, 0.0)
            places = places + step[:, None] * gradient
            here, gradient = self.distance.distance_and_gradient(places)
        return answer

    def limits(self, rules: SeeingRules) -> Limits:
        """Give what bounds a camera's places in the form that the compiled search takes.

        Raises:
            InspectionError: a room around a point cloud.

        """
        if not isinstance(self.distance, ExactDistance):
            raise InspectionError(
                "room: around a point cloud there is nothing to be seen; a mesh or a map has surfaces"
            )
        tree, cells = self.distance.tree, self._cells
        return Limits(
            tree.lower, tree.upper, tree.right, tree.first, tree.amount, tree.corners, tree.plane, cells.child,
            self._possible, self.origin, cells.depth, cells.unit, self.stand_off, rules.least_range,
            rules.greatest_range, math.tan(rules.greatest_incidence),
            rules.greatest_sample_distance / rules.pixel_angle,
        )  # fmt: skip

    def surely_not(
        self, centres: Points, half_widths: Float[np.ndarray, "n 3"] | Float[np.ndarray, " n"]
    ) -> Bool[np.ndarray, " n"]:
        """Say which boxes surely hold no point of the room: what a proof that nothing is seen may leave out.

        Args:
            centres: (n, 3) of boxes along the axes, m, body frame.
            half_widths: (n,) of cubes or (n, 3), m.

        """
        centres = np.ascontiguousarray(centres, dtype=np.float64).reshape(-1, 3)
        half = np.broadcast_to(np.asarray(half_widths, dtype=np.float64).reshape(len(centres), -1), centres.shape)
        reach = np.linalg.norm(half, axis=1) + _ROUNDING
        near = self.distance.distance(centres) + reach < self.stand_off
        rest = np.flatnonzero(~near)
        boxes = np.concatenate([centres[rest] - half[rest] - _ROUNDING, centres[rest] + half[rest] + _ROUNDING], axis=1)
        cells = self._cells
        near[rest] = ~boxes_meet(cells.child, cells.depth, self._possible, self.origin, cells.unit, boxes)
        return near
