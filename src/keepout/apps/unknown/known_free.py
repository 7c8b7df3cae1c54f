"""The map of what has been seen free: cubes become free by the rule of docs/mapping.md, and stay free for ever.

What has not been seen free is an obstacle.
"""

import enum
import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int64

from keepout.apps.unknown.distance_transform import renew, squares_of
from keepout.apps.unknown.rule import BLOCK, SLACK, empty_ranges, free_cubes, pyramid, rule_of
from keepout.apps.unknown.view import SensorBounds, View
from keepout.core.cores import kernel
from keepout.core.errors import MapError

_MOST_CUBES = 1024
"""Across the grid: 3 GiB."""
_MOST_CELLS = 64
"""In the cap: a tile of distances is made from the cubes that far round it."""
_ROTATION = 1e-10
"""Greatest departure of the axes from a rotation: the slack of the rule covers it."""


class ViewStatus(enum.Enum):
    """What became of a view; all but SEEN left the map as it was."""

    SEEN = "seen"
    FROM_UNKNOWN = "from_unknown"
    """The sensor's place is not in known-free room: no sensor can be there."""
    POSE_JUMP = "pose_jump"
    """Farther from the last view than speed limit and pose error explain."""
    NOT_FINITE = "not_finite"
    """A pose or range that no sensor can have: not finite, a range below zero, axes that are no rotation."""
    EMPTY = "empty"
    """No pixel says anything."""
    CONTRADICTED = "contradicted"
    """A return lies in known-free room: this view, or one before, broke a promise."""


@dataclass(frozen=True)
class ViewReport:
    """What a view did to the map."""

    status: ViewStatus
    opened: int
    """Cubes that became free."""
    contradicting: int = 0
    """Returns farther inside known-free room, or outside the declared ball, than the errors explain: each proves that a
    promise of ball or sensor is broken. Counted in every view whose pose is finite, taken or not."""
    outside: int = 0
    """Those of them that lie outside the ball."""


@dataclass(frozen=True, eq=False)
class Seen:
    """Pose and time of a view that the map took."""

    time: float
    position: Float[np.ndarray, "3"]
    axes: Float[np.ndarray, "3 3"]


class KnownFreeMap:
    """Cubes in a box round the declared ball that holds the target; grows in place as views come in.

    Attributes:
        name: of the target.
        centre: (3,) of the declared ball, m.
        radius: of the declared ball, m.
        spacing: edge of a cube, m.
        cap: greatest distance that is kept, m; a whole number of spacings.
        bounds: what is promised of the sensor.
        speed_limit: of the chaser, m/s; a view farther from the last one is refused.
        origin: (3,) lower corner of the grid, m.
        free: (n, n, n) bool, whether each cube is free. To be read only.
        squares: (n+1, n+1, n+1) uint16, squared distance in cells of each cube corner to the nearest cube that is not
            free, capped at (cap / spacing)². To be read only.
        returned: the point cloud of all returns.
        seen: pose and time of each view taken, in order.
        broken: promises of ball and sensor that were broken when the map was made, each in words, as far as whoever
            made it knew; to be added to by whoever knows more.
        contradicting: returns so far that prove that a promise was broken.

    """

    def __init__(
        self,
        centre: Sequence[float] | Float[np.ndarray, "3"],
        radius: float,
        *,
        spacing: float = 0.1,
        cap: float = 1.2,
        bounds: SensorBounds,
        name: str,
        speed_limit: float = math.inf,
    ) -> None:
        """Lay the grid; `begin` and `map_file.load` fill it."""
        self.name, self.centre, self.radius = name, np.array(centre, dtype=np.float64), float(radius)
        self.spacing, self.cap, self.bounds, self.speed_limit = float(spacing), float(cap), bounds, float(speed_limit)
        self._check()
        half = (self.radius + self.cap + 3.0 * self.spacing) / self.spacing
        cubes = BLOCK * math.ceil(2.0 * half / BLOCK - 1e-9)
        if cubes > _MOST_CUBES:
            raise MapError(
                f"map spacing = {self.spacing} m for a ball of radius {self.radius} m gives {cubes} cubes across; at "
                f"most {_MOST_CUBES} are held: spacing must be at least {2.0 * half * self.spacing / _MOST_CUBES:.3g} m"
            )
        self.origin = self.centre - 0.5 * cubes * self.spacing
        self.seen: list[Seen] = []
        self.broken: tuple[str, ...] = ()
        self.contradicting = 0
        self._flight_began = 0
        self.free = np.zeros((cubes, cubes, cubes), dtype=np.bool_)
        self.squares = np.zeros((0, 0, 0), dtype=np.uint16)
        self.returned = Returns(self.origin, self.spacing, cubes)
        self._unknown = np.zeros((0, 0, 0), dtype=np.int32)

    def _check(self) -> None:
        if not (self.centre.shape == (3,) and np.isfinite(self.centre).all()):
            raise MapError(f"map centre = {self.centre.tolist()}; it must be three finite coordinates in metres")
        for name in ("radius", "spacing", "cap"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise MapError(f"map {name} = {value}; it must be positive and finite, in metres")
        if not self.speed_limit > 0.0:
            raise MapError(f"map speed_limit = {self.speed_limit}; it must be positive, in m/s")
        cells = self.cap / self.spacing
        if abs(cells - round(cells)) > 1e-6 or not 1 <= round(cells) <= _MOST_CELLS:
            raise MapError(
                f"map cap = {self.cap} m; it must be 1 to {_MOST_CELLS} whole spacings of {self.spacing} m, such as "
                f"{min(max(round(cells), 1), _MOST_CELLS) * self.spacing:.6g} m"
            )

    @classmethod
    def begin(cls, centre: Sequence[float] | Float[np.ndarray, "3"], radius: float, **settings: Any) -> "KnownFreeMap":
        """Begin a map: all cubes that meet the declared ball are unknown, all others free.

        Args:
            centre: (3,) of the ball that is declared to hold the whole target, in its body frame, m.
            radius: of that ball, m.
            **settings: `bounds` and `name`, by which a map file is known again; `spacing`, by default 0.1 m, `cap`,
                1.2 m, and `speed_limit`, none.

        Raises:
            MapError: a number out of range.

        """
        made = cls(centre, radius, **settings)
        made.fill(made.free_outside_the_ball())
        return made

    def free_outside_the_ball(self) -> Bool[np.ndarray, "n n n"]:
        """Give the cubes that do not meet the declared ball: free before the first view."""
        cubes = len(self.free)
        low = self.origin[:, None] + self.spacing * np.arange(cubes)
        gap = np.maximum(low - self.centre[:, None], self.centre[:, None] - (low + self.spacing))
        across, down, ahead = np.maximum(gap, 0.0) ** 2
        # A cube that touches the ball to rounding counts as meeting it.
        limit = self.radius**2 * (1.0 + 1e-12)
        free = np.empty_like(self.free)
        for i in range(cubes):
            free[i] = across[i] + down[:, None] + ahead[None, :] > limit
        return free

    def fill(self, free: Bool[np.ndarray, "n n n"]) -> None:
        """Take over which cubes are free, and make what follows from it."""
        self.free = free
        self.squares = squares_of(free, self.cap_cells)
        blocks = len(free) // BLOCK
        known = free.reshape(blocks, BLOCK, blocks, BLOCK, blocks, BLOCK).sum(axis=(1, 3, 5), dtype=np.int32)
        self._unknown = (BLOCK**3 - known).astype(np.int32)

    @property
    def cap_cells(self) -> int:
        """The cap in cells."""
        return round(self.cap / self.spacing)

    @property
    def upper(self) -> Float[np.ndarray, "3"]:
        """Upper corner of the box, m."""
        return self.origin + len(self.free) * self.spacing

    @property
    def assumptions_broken(self) -> tuple[str, ...]:
        """What makes this map one that nothing is promised of, in words; () where nothing is known against it."""
        told = tuple(f"map: {line}" for line in self.broken)
        if self.contradicting:
            told += (f"map: {self.contradicting} returns contradict it, so that ball or sensor break a promise",)
        return told

    @property
    def views(self) -> int:
        """How many views the map took."""
        return len(self.seen)

    @property
    def returns(self) -> Float32[np.ndarray, "m 3"]:
        """Point cloud of all returns in the map's frame, by the estimated poses, m; each place once."""
        return self.returned.points()

    def is_free(self, points: Float[np.ndarray, "m 3"]) -> Bool[np.ndarray, "m"]:
        """Say of points (m) whether they lie in known-free room; outside the box everything is free."""
        cells = np.floor((points - self.origin) / self.spacing)
        inside = ((cells >= 0) & (cells < len(self.free))).all(axis=1)
        answer = np.ones(len(points), dtype=np.bool_)
        answer[inside] = self.free[tuple(cells[inside].astype(np.int64).T)]
        return answer

    def begin_flight(self) -> None:
        """Begin another flight by the same map: its first view may be taken anywhere, at any time."""
        self._flight_began = len(self.seen)

    def see(self, view: View) -> ViewReport:
        """Grow the map by a view, in place; a refused view leaves it as it was, but for `contradicting`."""
        status = self._status(view)
        if status is ViewStatus.NOT_FINITE:
            return ViewReport(status, 0)
        points = view.points()
        contradicting, outside = self._contradicting(view, points)
        self.contradicting += contradicting
        if contradicting and status is ViewStatus.SEEN:
            status = ViewStatus.CONTRADICTED
        opened = 0
        if status is ViewStatus.SEEN:
            opened = self.open(view)
            self.returned.add(points)
            self.seen.append(Seen(float(view.time), view.position.copy(), view.axes.copy()))
        return ViewReport(status, opened, contradicting, outside)

    def open(self, view: View) -> int:
        """Free the cubes that the rule frees, and bring the distances up to date; gives how many were freed."""
        rule = rule_of(view, self.bounds, self.spacing)
        empty = empty_ranges(view, self.bounds)
        first, last = self.blocks_in_view(view, rule.farthest)
        changed = np.zeros(self._unknown.shape, dtype=np.bool_)
        cubes = self.free, self._unknown, changed
        opened = free_cubes(rule, pyramid(empty), self.origin, self.spacing, first, last, *cubes)
        if opened:
            renew(self.free, self.squares, self.cap_cells, changed, BLOCK)
        return opened

    def blocks_in_view(self, view: View, farthest: float) -> Int[np.ndarray, "2 3"]:
        """Give the first and the one after the last block of a box round all that the camera sees up to a range, m."""
        camera = view.camera
        half = 0.5 * np.array([camera.width, camera.height]) / camera.focal
        corners = np.array([[a * half[0], b * half[1], 1.0] for a in (-1, 1) for b in (-1, 1)])
        # The part of the cone nearer than `farthest` lies within the pyramid cut there across the boresight.
        reached = np.vstack([view.position, view.position + max(farthest, 0.0) * corners @ view.axes.T])
        low, high = (np.array([reached.min(axis=0), reached.max(axis=0)]) - self.origin) / (BLOCK * self.spacing)
        return np.clip([np.floor(low) - 1, np.ceil(high) + 1], 0, len(self.free) // BLOCK).astype(np.int64)

    def _status(self, view: View) -> ViewStatus:
        if not all(np.isfinite(part).all() for part in (view.position, view.axes, view.time)):
            return ViewStatus.NOT_FINITE
        turned = np.abs(view.axes.T @ view.axes - np.eye(3)).max() <= _ROTATION and np.linalg.det(view.axes) >= 0.0
        if not turned or (view.ranges < 0.0).any():
            return ViewStatus.NOT_FINITE
        if not (np.isfinite(view.ranges) | (np.isposinf(view.ranges) & (self.bounds.sure_empty_range > 0.0))).any():
            return ViewStatus.EMPTY
        if not self.is_free(view.position[None])[0]:
            return ViewStatus.FROM_UNKNOWN
        if len(self.seen) > self._flight_began:
            last = self.seen[-1]
            explained = self.speed_limit * abs(view.time - last.time) + 2.0 * self.bounds.position_error
            # An endless speed over no time is no limit.
            if np.linalg.norm(view.position - last.position) > explained:
                return ViewStatus.POSE_JUMP
        return ViewStatus.SEEN

    def _contradicting(self, view: View, points: Float[np.ndarray, "m 3"]) -> tuple[int, int]:
        """Count the returns that no part of a target in unknown room can have sent, and those outside the ball."""
        explained = self.bounds.return_error(view.camera, view.ranges[np.isfinite(view.ranges)]) + SLACK
        outside = np.linalg.norm(points - self.centre, axis=1) > self.radius + explained
        inside = in_free_room(points, explained, self.origin, self.spacing, self.free, self.cap)
        return int((outside | inside).sum()), int(outside.sum())


LATTICE = 4
"""Lattice steps an edge of a cube: a return moves by less than a quarter of an edge."""
_MERGE = 2_000_000
"""Keys that wait before they are merged."""


class Returns:
    """Returns inside the box of a map, as sorted whole-number keys of their lattice places."""

    def __init__(self, origin: Float[np.ndarray, "3"], spacing: float, cubes: int) -> None:
        self._origin = origin
        self._step = spacing / LATTICE
        self._across = cubes * LATTICE
        self._sorted = np.zeros(0, dtype=np.int64)
        self._waiting: list[np.ndarray] = []

    def add(self, points: Float[np.ndarray, "m 3"]) -> None:
        """Take in returns in the map's frame, m; those outside the box are left out."""
        cells = np.floor((points - self._origin) / self._step)
        cells = cells[((cells >= 0) & (cells < self._across)).all(axis=1)].astype(np.int64)
        keys = np.unique((cells[:, 0] * self._across + cells[:, 1]) * self._across + cells[:, 2])
        self._waiting.append(keys)
        if sum(map(len, self._waiting)) > _MERGE:
            self._merge()

    def _merge(self) -> None:
        if self._waiting:
            self._sorted = np.unique(np.concatenate([self._sorted, *self._waiting]))
            self._waiting = []

    @property
    def keys(self) -> Int64[np.ndarray, "m"]:
        """Sorted keys: what a file keeps."""
        self._merge()
        return self._sorted

    @keys.setter
    def keys(self, keys: Int64[np.ndarray, "m"]) -> None:
        self._sorted, self._waiting = keys, []

    def points(self) -> Float32[np.ndarray, "m 3"]:
        """Give the middle of each lattice place that holds a return, m."""
        keys = self.keys
        cells = np.stack([keys // self._across**2, keys // self._across % self._across, keys % self._across], axis=1)
        return (self._origin + (cells + 0.5) * self._step).astype(np.float32)


def in_free_room(
    points: Float[np.ndarray, "m 3"],
    reach: Float[np.ndarray, "m"],
    origin: Float[np.ndarray, "3"],
    spacing: float,
    free: Bool[np.ndarray, "n n n"],
    cap: float,
) -> Bool[np.ndarray, "m"]:
    """Say round which points a whole ball lies in free cubes: farther than `reach` from each cube that is not free.

    Args:
        points: m, in the grid's frame.
        reach: radius of each point's ball, m. A ball of the cap or more is not judged: the answer is no.
        origin: (3,) lower corner of the grid, m.
        spacing: edge of a cube, m.
        free: whether each cube is. Those within the cap of the border are; so is all beyond it.
        cap: m.

    """
    found = np.zeros(len(points), dtype=np.bool_)
    judged = np.flatnonzero(reach < cap)
    held = np.empty(len(judged), dtype=np.bool_)
    _in_free_room((points[judged] - origin) / spacing, reach[judged] / spacing, free, held)
    found[judged] = held
    return found


@kernel()
def _in_free_room(places, reach, free, held):
    for p in range(len(places)):
        held[p] = _ball_is_free(places[p, 0], places[p, 1], places[p, 2], reach[p], free)


@kernel()
def _ball_is_free(x, y, z, r, free):
    """Decide for a place and a radius in cells: the box of cubes round the ball, less those that it does not meet."""
    last = free.shape[0] - 1
    for i in range(max(int(np.floor(x - r)), 0), min(int(np.floor(x + r)), last) + 1):
        across = max(i - x, x - i - 1.0, 0.0) ** 2
        for j in range(max(int(np.floor(y - r)), 0), min(int(np.floor(y + r)), last) + 1):
            down = across + max(j - y, y - j - 1.0, 0.0) ** 2
            if down > r * r:
                continue
            for k in range(max(int(np.floor(z - r)), 0), min(int(np.floor(z + r)), last) + 1):
                if not free[i, j, k] and down + max(k - z, z - k - 1.0, 0.0) ** 2 <= r * r:
                    return False
    return True


def whole_blocks(free: Bool[np.ndarray, "nx ny nz"], width: int) -> Bool[np.ndarray, "mx my mz"]:
    """Say of each block, `width` cubes wide, whether every cube of it is free; beyond the map all is free."""
    for axis in range(3):
        slabs = np.moveaxis(free, axis, 0)
        slabs = np.pad(slabs, ((0, -len(slabs) % width), (0, 0), (0, 0)), constant_values=True)
        whole = functools.reduce(np.logical_and, [slabs[first::width] for first in range(width)])
        free = np.moveaxis(whole, 0, axis)
    return free
