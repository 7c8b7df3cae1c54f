"""The room allowed to a chaser's centre, and how near a camera may come along a beam of directions from a patch."""

import math
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from keepout.apps.inspection.seeing.visible import SeeingRules
from keepout.core.cores import kernel
from keepout.core.errors import InspectionError
from keepout.core.geometry.distance import Distance, ExactDistance, Points, Tree, closest_triangle
from keepout.core.geometry.octree import SQRT3, refine

_BEAM_STEPS = 2000
"""Along a beam, at most; where they are used up the height reached so far stands."""
_FINENESS = 2e-4
"""Part of the stand-off, or of a height, to which the least height is found."""
_DEEP = 192
"""Entries of a stack: eight for each of `_DEEPEST` halvings, and more than a `Tree` is deep."""
_COARSENESS = 0.1
"""Part of the beam's width to which it is found where that is more."""
_ROUNDING = 1e-9
"""Metres; above the rounding of an exact distance by orders of magnitude."""
_DEEPEST = 10
"""Halvings of the cube: a thousand cells across at most."""
_STEPS = 24
"""Of a walk up the distance; each about doubles what is left above the stand-off."""


@runtime_checkable
class Measure(Protocol):
    """A distance from places."""

    def distance(self, points: Points) -> Float[np.ndarray, "n"]:
        """Give it, m, 1-Lipschitz."""
        ...


class Limits(NamedTuple):
    """What bounds the places of a camera, as the compiled loops take it.

    Attributes:
        tree: of the mesh.
        child: of the room's octree; see `Cells.child`.
        possible: cells that may hold a place of the room.
        unit: side of the octree's smallest cells, m.
        stand_off: m, positive.
        spread: tangent of the greatest incidence.
        finest: greatest square of the range over the height, m.

    """

    tree: Tree
    child: Int[np.ndarray, "nodes 8"]
    possible: Bool[np.ndarray, " cells"]
    origin: Float[np.ndarray, " 3"]
    depth: int
    unit: float
    stand_off: float
    least_range: float
    greatest_range: float
    spread: float
    finest: float


class Work(NamedTuple):
    """Room for the compiled loops to work in: of a walk down a tree, and a box."""

    stack: Int[np.ndarray, " deep"]
    bounds: Float[np.ndarray, " deep"]
    corners: Float[np.ndarray, "deep 4"]
    box: Float[np.ndarray, " 6"]


@kernel()
def beam_workspace():
    """Give room to work in."""
    return Work(np.empty(_DEEP, dtype=np.int64), np.empty(_DEEP), np.empty((_DEEP, 4)), np.empty(6))


@kernel()
def _distance(limits, x, y, z, work):
    """Distance from a point to the mesh."""
    return np.sqrt(closest_triangle(limits.tree, x, y, z, 0, work.stack, work.bounds)[0])


@kernel()
def meets_room(limits, work):
    """Whether the box in `work` (lower corner, upper corner; m) meets a cell of possible room, or leaves the cube."""
    box, stack, corners, origin, unit = work.box, work.stack, work.corners, limits.origin, limits.unit
    whole = float(1 << limits.depth)
    x0, x1 = (box[0] - origin[0]) / unit, (box[3] - origin[0]) / unit
    y0, y1 = (box[1] - origin[1]) / unit, (box[4] - origin[1]) / unit
    z0, z1 = (box[2] - origin[2]) / unit, (box[5] - origin[2]) / unit
    if min(x0, y0, z0) < 0.0 or max(x1, y1, z1) > whole:
        return True
    stack[0] = 0
    corners[0, 0], corners[0, 1], corners[0, 2], corners[0, 3] = 0.0, 0.0, 0.0, whole
    waiting = 1
    while waiting > 0:
        waiting -= 1
        node, half = stack[waiting], 0.5 * corners[waiting, 3]
        x, y, z = corners[waiting, 0], corners[waiting, 1], corners[waiting, 2]
        for k in range(8):
            cx, cy, cz = x + (k & 1) * half, y + ((k >> 1) & 1) * half, z + ((k >> 2) & 1) * half
            if x1 < cx or x0 > cx + half or y1 < cy or y0 > cy + half or z1 < cz or z0 > cz + half:
                continue
            entry = limits.child[node, k]
            if entry >= 0:
                stack[waiting] = entry
                corners[waiting, 0], corners[waiting, 1], corners[waiting, 2] = cx, cy, cz
                corners[waiting, 3] = half
                waiting += 1
            elif limits.possible[~entry]:
                return True
    return False


@kernel(inline="always")
def place_of(frame, wx, wy, height):
    """Give the place at a height in a direction from the patch."""
    x = frame[0, 0] + height * (wx * frame[1, 0] + wy * frame[2, 0] + frame[3, 0])
    y = frame[0, 1] + height * (wx * frame[1, 1] + wy * frame[2, 1] + frame[3, 1])
    z = frame[0, 2] + height * (wx * frame[1, 2] + wy * frame[2, 2] + frame[3, 2])
    return x, y, z


@kernel()
def _by_rules(limits, outline, wx, wy, half, height):
    """Give a height below which the rules allow no place of a beam, from one on; inf where they allow none at all.

    A corner a is seen at the tangent |w - a / height|, at most `spread`, and at height * (1 + tangent²)^(1/2).
    """
    # Distances change by at most `fastest` a metre of height.
    raised, fastest = height, np.sqrt(1.0 + wx * wx + wy * wy) + half * np.sqrt(2.0)
    for j in range(len(outline)):
        dx, dy = abs(wx - outline[j, 0] / height), abs(wy - outline[j, 1] / height)
        least, most = max(dx - half, 0.0) ** 2 + max(dy - half, 0.0) ** 2, (dx + half) ** 2 + (dy + half) ** 2
        excess, reach = np.sqrt(least) - limits.spread, np.sqrt(outline[j, 0] ** 2 + outline[j, 1] ** 2)
        if excess > 0.0:
            inverse = 1.0 / height - excess / reach
            if inverse <= 1e-9:
                return np.inf
            raised = max(raised, 1.0 / inverse)
        far, near = height * np.sqrt(1.0 + least), height * np.sqrt(1.0 + most)
        raised = max(raised, height + (far - limits.greatest_range) / fastest)
        raised = max(raised, height + (limits.least_range - near) / fastest)
        if limits.finest < np.inf:
            raised = max(raised, height + (far * far - limits.finest * height) / (2.0 * far * fastest + limits.finest))
    return raised


@kernel()
def _step_without_room(limits, frame, wx, wy, half, height, work):
    """Give how far a beam surely has no room from a height on, m: the longest of three steps that has none, or 0."""
    x, y, z = place_of(frame, wx, wy, height)
    for step in (8.0 * limits.unit, 2.0 * limits.unit, 0.5 * limits.unit):
        wide = (height + step) * half
        for k in range(3):
            along = step * (wx * frame[1, k] + wy * frame[2, k] + frame[3, k])
            here = x if k == 0 else (y if k == 1 else z)
            beside = wide * (abs(frame[1, k]) + abs(frame[2, k])) + 1e-9
            work.box[k], work.box[3 + k] = here + min(along, 0.0) - beside, here + max(along, 0.0) + beside
        if not meets_room(limits, work):
            return step
    return 0.0


@kernel()
def least_height(limits, frame, outline, wx, wy, half, height, work):
    """Give a height below which no place in a square of directions is allowed; inf where none is at any height.

    Args:
        limits: what bounds the places.
        frame: (4, 3) the patch's centre, two axes in its plane, and the normal of the unit.
        outline: (k, 2) corners of the patch in these axes, m.
        wx: middle of the square.
        wy: the same.
        half: half its side.
        height: below which none is allowed, as known, m.
        work: room to work in.

    """
    nearest = max(abs(wx) - half, 0.0) ** 2 + max(abs(wy) - half, 0.0) ** 2
    across = half * np.sqrt(2.0)
    fastest = np.sqrt(1.0 + wx * wx + wy * wy) + across
    for _ in range(_BEAM_STEPS):
        if height * np.sqrt(1.0 + nearest) >= limits.greatest_range or height * (1.0 + nearest) > limits.finest:
            return np.inf
        raised = _by_rules(limits, outline, wx, wy, half, height)
        if raised == np.inf:
            return np.inf
        if raised > height * (1.0 + max(_FINENESS, _COARSENESS * across)):
            height += (raised - height) * (1.0 - 1e-9)
            continue
        x, y, z = place_of(frame, wx, wy, height)
        # Places nearer to this one than that are nearer to the mesh than the stand-off.
        ball = limits.stand_off - _distance(limits, x, y, z, work) - height * across
        if ball > max(_FINENESS * limits.stand_off, _COARSENESS * height * across):
            height += ball * (1.0 - 1e-9) / fastest
            continue
        if height * across > 4.0 * limits.unit:
            return height
        step = _step_without_room(limits, frame, wx, wy, half, height, work)
        if step == 0.0:
            return height
        height += step
    return height


@kernel()
def first_place(limits, frame, outline, wx, wy, height, work):
    """Give the least height found, from one on, at which a place in one direction keeps room and rules; inf if none."""
    slant, box = np.sqrt(1.0 + wx * wx + wy * wy), work.box
    for _ in range(_BEAM_STEPS):
        if height * slant >= limits.greatest_range:
            return np.inf
        farthest, nearest = 0.0, np.inf
        for j in range(len(outline)):
            square = (wx - outline[j, 0] / height) ** 2 + (wy - outline[j, 1] / height) ** 2
            farthest, nearest = max(farthest, square), min(nearest, square)
        steep = farthest > (limits.spread * (1.0 - 1e-9)) ** 2
        coarse = height * (1.0 + farthest) > limits.finest
        if steep or coarse or height * np.sqrt(1.0 + nearest) <= limits.least_range:
            height *= 1.01
            continue
        if height * np.sqrt(1.0 + farthest) >= limits.greatest_range:
            return np.inf
        x, y, z = place_of(frame, wx, wy, height)
        short = limits.stand_off + 1e-6 - _distance(limits, x, y, z, work)
        if short > 0.0:
            height += max(short / slant, _FINENESS * limits.stand_off)
            continue
        box[0], box[1], box[2], box[3], box[4], box[5] = x, y, z, x, y, z
        if meets_room(limits, work):
            return height
        height += 0.5 * limits.unit
    return np.inf


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
        free: distance to all that places and ways keep the stand-off from: nowhere more than `distance`, which it is
            where absent. What is nearer to the rest than the stand-off is not allowed, but parts no component.

    Attributes:
        distance: as given.
        free: as given.
        stand_off: as given.
        origin: (3,) lowest corner of the octree's cube, m.
        side: of that cube, m. All beyond it belongs to the room.

    Raises:
        InspectionError: a stand-off or leaf that is not positive and finite.

    """

    def __init__(
        self, distance: Distance, stand_off: float, *, leaf: float | None = None, free: Measure | None = None
    ) -> None:
        leaf = 0.2 * stand_off if leaf is None else leaf
        for name, value in (("stand_off", stand_off), ("leaf", leaf)):
            if not 0.0 < value < math.inf:
                raise InspectionError(f"room: {name} is {value:g} m; it must be positive and finite")
        self.distance = distance
        self.free: Measure = distance if free is None else free
        self.stand_off = float(stand_off)
        extent = float((distance.upper - distance.lower).max())
        self.side = extent + 2.0 * (self.stand_off + 2.0 * leaf) + 1e-3
        self.origin: Float[np.ndarray, 3] = 0.5 * (distance.lower + distance.upper) - 0.5 * self.side
        depth = max(1, min(_DEEPEST, math.ceil(math.log2(self.side / leaf))))

        def visit(centres: Points, half_width: float, level: int) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
            d, reach = distance.distance(centres), half_width * SQRT3 + _ROUNDING
            within, outside = d - reach > self.stand_off, d + reach < self.stand_off
            return ~within & ~outside, (within, ~outside)

        self._cells, (within, possible) = refine(self.origin, self.side, depth, visit, 2)
        last = (1 << self._cells.level.astype(np.int32)) - 1
        outer = (self._cells.index == 0).any(axis=1) | (self._cells.index == last[:, None]).any(axis=1)
        self._sure = self._cells.connected(within, outer)
        self._possible = self._cells.connected(possible, outer)

    @property
    def narrowed(self) -> bool:
        """Whether more than the mesh is kept away from."""
        return self.free is not self.distance

    def allowed(self, points: Points) -> Bool[np.ndarray, " n"]:
        """Say which points surely belong to the room; a few of those that do, at its very border, are not said to.

        Args:
            points: (n, 3) m, body frame.

        """
        points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
        answer = np.zeros(len(points), bool)
        here, gradient = self.distance.distance_and_gradient(points)
        active = np.flatnonzero(here >= self.stand_off)
        if self.narrowed:
            active = active[self.free.distance(points[active]) >= self.stand_off]
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
        cells = self._cells
        return Limits(
            tree=self.distance.tree,
            child=cells.child,
            possible=self._possible,
            origin=self.origin,
            depth=cells.depth,
            unit=cells.unit,
            stand_off=self.stand_off,
            least_range=rules.least_range,
            greatest_range=rules.greatest_range,
            spread=math.tan(rules.greatest_incidence),
            finest=rules.greatest_sample_distance / rules.pixel_angle,
        )
