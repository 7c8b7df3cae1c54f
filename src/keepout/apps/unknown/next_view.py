"""Which view to take next: where to fly in known-free room, and where to look from there.

What a camera somewhere would open is found by rays over the whole sphere through the cells, and images made of them. A
ray goes on through unknown cells, with less confidence after each. What it opens is the volume it passes times the
worth of the cells times that confidence, so views that look through much unknown room are worth what they may show.
"""

import functools
import math
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8
from scipy.spatial import KDTree

from keepout.apps.led import driver
from keepout.apps.led.camera import Pinhole, axes_towards
from keepout.apps.unknown.cells import (
    CLOSE,
    EXPLAINED,
    FREE,
    MOST_PATIENCE,
    NEARBY,
    PATIENCE,
    SAME_DIRECTION,
    SAME_PLACE,
    SURFACE,
    UNKNOWN,
    Cells,
    Frontier,
    Tried,
)
from keepout.apps.unknown.known_free import KnownFreeMap
from keepout.apps.unknown.ways import HopedWay, Reachable, hoped_way, reachable
from keepout.core.cores import kernel

UP = np.array([0.0, 0.0, 1.0])
"""What the camera holds up in the image, in the map's frame."""
_RAYS, _DIRECTIONS, _DRAWN, _PLACES = 2000, 192, 4000, 256
_BINS = (0.6, 1.0, 1.6, 2.6, 4.5)
"""Metres at which bins of range begin: the nearer, the farther from the image's edge a window must be to lie inside."""
_RANGES = (1.5, 3.0, 5.0, 8.0)
"""Metres from a frontier along its normal at which a view is considered; and between shells round what is wanted."""
_REFINED, _AROUND = 6, 10
_STAGES = 3
_LEAST_GAIN = 0.005
"""A view expected to open less (m³) is not worth taking."""


@dataclass(frozen=True, eq=False)
class Seeker:
    """Who looks for a view: where it is, what it sees with, and what a view costs it in time.

    Attributes:
        position: of the chaser's centre and camera, m.
        camera: the camera.
        keep: least distance, m, of the chaser's centre from all that is not known free.
        boresight: where the camera looks now, a unit vector; None: no turn is counted.
        speed: of the way, m/s.
        turn_rate: of the turn, rad/s.
        settling: a while to settle, s.

    """

    position: Float[np.ndarray, "3"]
    camera: Pinhole
    keep: float
    boresight: Float[np.ndarray, "3"] | None = None
    speed: float = 0.2
    turn_rate: float = 0.05
    settling: float = 60.0


@dataclass(frozen=True, eq=False)
class NextView:
    """Where to fly and where to look from there."""

    position: Float[np.ndarray, "3"]
    """m; the goal itself where that is known to be reachable."""
    direction: Float[np.ndarray, "3"]
    """Unit vector along the boresight; `UP` is up in the image that was counted on."""
    why: str
    is_goal: bool = False


Ending = Literal[
    "reached goal", "everything reachable seen", "no way known", "out of time", "out of views", "contradicted"
]


@dataclass(frozen=True, eq=False)
class Ended(driver.Ended):
    """There is nothing more to fly for; of `choose`: no view worth taking."""

    outcome: Ending
    why: str
    unknown: Float[np.ndarray, "n 3"] = field(default_factory=lambda: np.zeros((0, 3)))
    """Centres (m) of the cells that are in the way, or of all frontier cells left, for a picture."""


def choose(
    known: KnownFreeMap, seeker: Seeker, goal: Float[np.ndarray, "3"] | None, tried: Tried, *, seed: int = 0
) -> NextView | Ended:
    """Choose the view that opens most of what is wanted per second.

    Args:
        known: the map.
        seeker: who looks for it.
        goal: where the chaser wants to be, m; None to look all round.
        tried: the views so far.
        seed: of the places drawn.

    """
    keep = seeker.keep
    reach = reachable(known, seeker.position, keep)
    if goal is not None and reach.leads_to(known, goal):
        towards = known.origin + 0.5 * known.spacing * np.array(known.free.shape) - goal
        return NextView(goal, _unit(towards), "goal is reachable", is_goal=True)
    if not reach.reached.any():
        return Ended(
            "no way known",
            f"nowhere within {math.sqrt(3.0) * reach.spacing:.2f} m of the chaser is {keep:.2f} m "
            "from all that is not known free",
        )
    cells = Cells.of(known)
    search = _Search(known, reach, cells, seeker, tried, seed)
    way = None
    if goal is not None:
        surface = _surface_at(known, seeker.camera, goal)
        if surface < keep:
            why = f"the goal {_said(goal)} is at most {surface:.2f} m from the seen surface, less than {keep:.2f} m"
            return Ended("no way known", why, cells.place(np.argwhere(cells.kinds == SURFACE)))
        way = hoped_way(reach, cells, tried, seeker.position, goal)
        wanted = np.argwhere((way.stages > 0) & (tried.failures < tried.patience))
        if len(wanted):
            stage = way.stages[tuple(wanted.T)]
            first = cells.place(wanted[stage == stage.min()])
            found = search.best(_codes(cells, tried, way.stages), _TOWARDS, first[:: max(1, len(first) // 64)])
            if found is not None:
                return replace(found, why="opens the way to the goal")
    codes = _codes(cells, tried, np.zeros_like(cells.kinds))
    for worths in (_ALL_ROUND, _ANYTHING):
        found = search.best(codes, worths, search.edge.centres)
        if found is not None:
            nothing_else = "nothing on the way to the goal can be seen: " if goal is not None else ""
            return replace(found, why=nothing_else + "opens most around")
    if way is None or goal is None:
        return Ended("everything reachable seen", _left(search.edge, tried), cells.place(search.edge.cells))
    return Ended("no way known", _blocked(way, cells, tried, goal), cells.place(np.argwhere(way.stages > 0)))


def _surface_at(known: KnownFreeMap, camera: Pinhole, goal: Float[np.ndarray, "3"]) -> float:
    """Bound from above the distance from a place to cubes that hold a seen surface, which never become free, m."""
    if len(known.returns) == 0:
        return math.inf
    bounds = known.bounds
    # A return stands for a pixel, whose corner is this much of the range away from its middle.
    slant = 1.0 / (math.sqrt(2.0) * camera.focal)
    error = bounds.range_error + bounds.position_error + (bounds.attitude_error + slant) * bounds.greatest_range
    # Returns are kept on a lattice finer than a cube, and a distance interpolated between nodes may be too long.
    return float(np.linalg.norm(known.returns - goal, axis=1).min()) + error + known.spacing


class _Search:
    """Views from places that the chaser can reach, by what they open per second."""

    def __init__(self, known: KnownFreeMap, reach: Reachable, cells: Cells, seeker: Seeker, tried: Tried, seed: int):
        self.reach, self.cells, self.seeker, self.tried = reach, cells, seeker, tried
        self.edge = Frontier.of(cells)
        self.generator = np.random.default_rng(seed)
        self.rays = sphere(_RAYS)
        self.directions = sphere(_DIRECTIONS)
        bounds = known.bounds
        half = 0.5 * math.sqrt(3.0) * known.spacing + bounds.position_error
        self.bins = np.maximum(_BINS, bounds.least_range + half)
        self.nearest, self.farthest = self.bins[0], bounds.usable_range(seeker.camera) - half
        window = half + bounds.surely_returned_width + known.spacing
        self.images = _images(seeker.camera, tuple(window / self.bins + bounds.attitude_error))
        self.empty = bounds.sure_empty_range - half - bounds.surely_returned_width

    def best(
        self, codes: UInt8[np.ndarray, "nx ny nz"], worths: Float32[np.ndarray, "256"], wanted: Float[np.ndarray, "w 3"]
    ) -> NextView | None:
        """Give the best view worth taking, from places around the `wanted` ones (m); None without any."""
        nodes = self._places(wanted)
        if len(nodes) == 0:
            return None
        gains = self._gains(codes, worths, nodes)
        rates = self._rates(nodes, gains)
        for _ in range(2):
            top = nodes[np.argsort(-rates.max(axis=1), kind="stable")[:_REFINED]]
            steps = self.generator.integers(-3, 4, size=(_REFINED * _AROUND, 3))
            more = self._reached(np.repeat(top, _AROUND, axis=0) + steps[: len(top) * _AROUND])
            if len(more):
                more_gains = self._gains(codes, worths, more)
                nodes, gains = np.concatenate([nodes, more]), np.concatenate([gains, more_gains])
                rates = np.concatenate([rates, self._rates(more, more_gains)])
        place, direction = np.unravel_index(np.argmax(rates), rates.shape)
        if rates[place, direction] <= 0.0 or float(gains[place, direction]) < _LEAST_GAIN:
            return None
        return NextView(self.reach.place(nodes[place][None])[0], self.directions[direction].copy(), "")

    def _places(self, wanted: Float[np.ndarray, "w 3"]) -> Int[np.ndarray, "n 3"]:
        """Lattice nodes on shells of all ranges round what is wanted, and where normals of the frontier lead."""
        reached = np.flatnonzero(self.reach.reached)
        drawn = self.generator.choice(reached, min(_DRAWN, len(reached)), replace=False)
        nodes = np.stack(np.unravel_index(drawn, self.reach.reached.shape), axis=1)
        if len(wanted):
            apart, _ = KDTree(wanted).query(self.reach.place(nodes))
            inner = np.flatnonzero((apart > self.nearest) & (apart < self.farthest))
            order = inner[np.argsort(apart[inner], kind="stable")]
            # As many from every shell: near places open narrow gaps, far ones much room.
            shells = np.array_split(order, np.searchsorted(apart[order], _RANGES))
            share = _PLACES // len(shells)
            nodes = np.concatenate([nodes[self.generator.permutation(shell)[:share]] for shell in shells])
        else:
            nodes = nodes[:_PLACES]
        large = np.argsort(-self.edge.sizes, kind="stable")[:30]
        out = self.edge.centres[large, None] + np.outer(_RANGES, [1, 1, 1])[None] * self.edge.normals[large, None]
        at = np.concatenate([out.reshape(-1, 3), self.seeker.position[None]])
        along = self._reached(np.round((at - self.reach.origin) / self.reach.spacing).astype(int))
        return np.unique(np.concatenate([nodes, along]), axis=0)

    def _reached(self, nodes: Int[np.ndarray, "n 3"]) -> Int[np.ndarray, "m 3"]:
        nodes = nodes[np.all((nodes >= 0) & (nodes < self.reach.room.shape), axis=1)]
        return np.unique(nodes[self.reach.reached[tuple(nodes.T)]], axis=0)

    def _gains(self, codes, worths, nodes) -> Float32[np.ndarray, "n d"]:
        """Volume in m³ times worth that the view in each direction from each node is expected to open."""
        edge = self.cells.edge
        places, limits = (self.reach.place(nodes) - self.cells.origin) / edge, (self.farthest / edge, self.empty / edge)
        gains = np.zeros((len(self.bins), len(nodes), len(self.rays)), dtype=np.float32)
        _march(codes, worths, _PASSES, places, self.rays, self.bins / edge, *limits, gains)
        return np.matmul(gains, self.images).sum(axis=0) * np.float32(edge**3)

    def _rates(self, nodes, gains) -> Float[np.ndarray, "n d"]:
        """Gain per second of flying, turning and settling; 0 for what was tried."""
        seeker = self.seeker
        seconds = seeker.settling + self.reach.lengths(nodes)[:, None] / seeker.speed
        if seeker.boresight is not None:
            angle = np.arccos(np.clip(self.directions @ seeker.boresight, -1.0, 1.0))
            seconds = seconds + angle[None] / seeker.turn_rate
        rates = np.asarray(gains, dtype=float) / seconds
        places = self.reach.place(nodes)
        for position, axes in zip(self.tried.positions, self.tried.axes, strict=True):
            close = np.linalg.norm(places - position, axis=1) < SAME_PLACE
            if close.any():
                rates[np.ix_(close, self.directions @ axes[:, 2] > SAME_DIRECTION)] = 0.0
        return rates


@functools.lru_cache(maxsize=4)
def _images(camera: Pinhole, borders: tuple[float, ...]) -> Float32[np.ndarray, "b m d"]:
    """Which rays of the sphere lie in the image along each direction, for borders of several widths (rad): 1 or 0."""
    axes = np.stack([axes_towards(direction, UP) for direction in sphere(_DIRECTIONS)])
    seen = np.einsum("nij,mi->nmj", axes, sphere(_RAYS))
    ahead = seen[..., 2] > 1e-6
    forward = np.where(ahead, seen[..., 2], 1.0)[..., None]
    images = np.empty((len(borders), _RAYS, _DIRECTIONS), dtype=np.float32)
    halves = [math.atan(0.5 * pixels / camera.focal) for pixels in (camera.width, camera.height)]
    for image, border in zip(images, borders, strict=True):
        slopes = np.array([math.tan(max(half - border, 0.02)) for half in halves])
        image[...] = (ahead & (np.abs(seen[..., :2]) <= slopes * forward).all(axis=2)).T
    return images


_KINDS = 6
_TRIES = MOST_PATIENCE + 1
_ENDS = 255


def _codes(cells: Cells, tried: Tried, stages: UInt8[np.ndarray, "nx ny nz"]) -> UInt8[np.ndarray, "nx ny nz"]:
    """Give each cell a number for look-up: kind, stage of the way that it blocks, and how often it was tried."""
    failures = np.where(tried.failures >= tried.patience, MOST_PATIENCE, tried.failures).astype(np.uint8)
    codes = 1 + ((cells.kinds + np.uint8(_KINDS) * stages) * np.uint8(_TRIES) + failures)
    codes[cells.kinds == SURFACE] = _ENDS
    codes[cells.kinds == FREE] = 0
    return codes


def _table(value) -> Float32[np.ndarray, "256"]:
    """Look-up table of value(kind, stage, tries) by code."""
    table = np.zeros(256, dtype=np.float32)
    for stage in range(_STAGES + 1):
        for kind in (EXPLAINED, UNKNOWN, NEARBY, CLOSE):
            for tries in range(_TRIES):
                table[1 + (kind + _KINDS * stage) * _TRIES + tries] = value(kind, stage, tries)
    return table


def _passing(kind: int, stage: int, tries: int) -> float:
    if tries == MOST_PATIENCE:
        return -1.0
    return (0.3 if kind == EXPLAINED else 0.97) * (1.0, 0.7, 0.4, 0.2)[min(tries, PATIENCE)]


_PASSES = _table(_passing)
"""Confidence left after a cell, by code."""


def _still_hoped(tries: int) -> float:
    return 0.0 if tries == MOST_PATIENCE else 0.4 ** min(tries, PATIENCE)


_ALL_ROUND = _table(
    lambda kind, stage, tries: {EXPLAINED: 0.0, UNKNOWN: 0.01, NEARBY: 0.1, CLOSE: 1.0}[kind] * _still_hoped(tries)
)
_ANYTHING = _table(lambda kind, stage, tries: 0.0 if kind == EXPLAINED else _still_hoped(tries))
_TOWARDS = _table(
    lambda kind, stage, tries: (
        (0.002 if stage == 0 else (1.0, 0.4, 0.15)[stage - 1])
        * (0.3 if kind == EXPLAINED else 1.0)
        * (0.0 if kind == EXPLAINED and stage == 0 else _still_hoped(tries))
    )
)
"""How much opening a cell is wanted, by code."""


def _unit(vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    length = np.linalg.norm(vector)
    return vector / length if length > 0.0 else np.array([1.0, 0.0, 0.0])


def _said(place: Float[np.ndarray, "3"]) -> str:
    return f"[{', '.join(f'{part:.2f}' for part in place)}] m"


def _left(edge: Frontier, tried: Tried) -> str:
    if len(edge.cells) == 0:
        return "no frontier is left"
    given_up = int(np.sum(tried.failures[tuple(edge.cells.T)] >= tried.patience))
    return (
        f"{len(edge.cells)} frontier cells are left in {len(edge.sizes)} places: {given_up} stayed closed in "
        f"{tried.patience} views, and no view from reachable room is expected to open the others"
    )


def _blocked(way: HopedWay, cells: Cells, tried: Tried, goal: Float[np.ndarray, "3"]) -> str:
    """Name what is unknown between the chaser and the goal."""
    first = way.places[np.argmax(way.blocked)] if way.blocked.any() else goal
    index = way.stages > 0
    count = int(index.sum())
    surface = int(np.sum(index & (cells.kinds == EXPLAINED)))
    given_up = int(np.sum(index & (cells.kinds != EXPLAINED) & (tried.failures >= tried.patience)))
    return (
        f"the way to {_said(goal)} is blocked from {_said(first)} on by {count} cells "
        f"({count * cells.edge**3:.2f} m³) that no view opened: {surface} lie within 0.35 m of the seen surface, "
        f"{given_up} stayed closed in {tried.patience} views, {count - surface - given_up} cannot be looked at from "
        "reachable room"
    )


def sphere(count: int) -> Float[np.ndarray, "count 3"]:
    """Spread unit vectors evenly over the sphere, on a Fibonacci spiral."""
    height = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    angle = math.pi * (3.0 - math.sqrt(5.0)) * np.arange(count)
    around = np.sqrt(1.0 - height**2)
    return np.stack([around * np.cos(angle), around * np.sin(angle), height], axis=1)


@kernel()
def _march(codes, worth, passes, places, rays, bins, farthest, empty, gains):
    """Write the worth, in cells, that each ray from each place is expected to open. All lengths are in cells.

    Args:
        codes: (nx, ny, nz) kinds of cells; 0 is known free.
        worth: by code, of opening a cell.
        passes: by code, confidence left after a cell; 0 where a ray ends with a return, negative where nothing is hoped
            of what lies behind.
        places: (n, 3) in cells from the corner of the first.
        rays: (m, 3) unit vectors, even over the sphere.
        bins: (b,) ranges at which the bins begin that what is opened is sorted into; cells nearer than the first are
            not.
        farthest: cells farther are not opened.
        empty: how far a ray without a return opens.
        gains: (b, n, m) zeros, to be written into.

    """
    count, solid = bins.shape[0], 4.0 * math.pi / rays.shape[0]
    unsure = np.zeros(count, dtype=np.float32)
    nx, ny, nz = codes.shape
    steps = int(farthest)
    for p in range(places.shape[0]):
        for r in range(rays.shape[0]):
            x, y, z = places[p, 0], places[p, 1], places[p, 2]
            dx, dy, dz = rays[r, 0], rays[r, 1], rays[r, 2]
            confidence = 1.0
            unsure[:] = 0.0  # opened only with a return
            returned = 0.0
            b = 0
            for step in range(1, steps + 1):
                i, j, k = int(x + step * dx), int(y + step * dy), int(z + step * dz)
                if x + step * dx < 0.0 or y + step * dy < 0.0 or z + step * dz < 0.0 or i >= nx or j >= ny or k >= nz:
                    break
                code = codes[i, j, k]
                if code == 0:
                    continue
                if passes[code] <= 0.0:
                    if passes[code] == 0.0:
                        returned += confidence
                    break
                if step >= bins[0]:
                    while b + 1 < count and step >= bins[b + 1]:
                        b += 1
                    volume = confidence * worth[code] * step * step
                    if step <= empty:
                        gains[b, p, r] += solid * volume
                    else:
                        unsure[b] += solid * volume
                returned += confidence * (1.0 - passes[code])
                confidence *= passes[code]
                if confidence < 0.02:
                    break
            for b in range(count):
                gains[b, p, r] += unsure[b] * min(returned, 1.0)
