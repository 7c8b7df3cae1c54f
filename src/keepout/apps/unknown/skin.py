"""The skin of a map: the surface between cubes that are not known free and free room that is reached from outside.

For pictures of a flight it is kept at some times: at most eight, spread over what was opened.
"""

from dataclasses import dataclass

import numpy as np
import scipy.ndimage
from jaxtyping import Bool, Float, Int, Int64, UInt8

from keepout.apps.unknown.known_free import KnownFreeMap, whole_blocks


def reachable_cubes(free: Bool[np.ndarray, "n n n"]) -> Bool[np.ndarray, "n n n"]:
    """Give the free cubes that a path through faces of free cubes joins to the box's border."""
    joined = np.empty(np.add(free.shape, 2), dtype=np.int32)
    scipy.ndimage.label(np.pad(free, 1, constant_values=True), output=joined)
    return (joined == joined[0, 0, 0])[1:-1, 1:-1, 1:-1]


def skin(known: KnownFreeMap) -> tuple[Float[np.ndarray, "v 3"], Int64[np.ndarray, "f 3"]]:
    """Give the closed triangle mesh of the map's obstacle, as seen from outside; see `skin_of`."""
    return skin_of(known.free, known.origin, known.spacing)


def skin_of(
    free: Bool[np.ndarray, "n n n"], origin: Float[np.ndarray, "3"], spacing: float
) -> tuple[Float[np.ndarray, "v 3"], Int64[np.ndarray, "f 3"]]:
    """Give the closed triangle mesh of the obstacle among cubes of edge `spacing` (m) from corner `origin` (m) on.

    The obstacle is every cube that is not free, and free room that is shut in by such cubes. Each square between the
    obstacle and free room is two triangles that face the free room. Squares share vertices, and the surface is the
    boundary of a solid: every edge has an even number of triangles, two nearly everywhere, four where two cubes
    touch along an edge alone.

    Returns:
        Vertices in the map's frame, m, and vertex indices of the triangles.

    """
    solid = ~reachable_cubes(free)
    nodes = len(solid) + 1
    strides = (nodes * nodes, nodes, 1)
    quads = []
    for axis in range(3):
        low = tuple(slice(None, -1) if other == axis else slice(None) for other in range(3))
        high = tuple(slice(1, None) if other == axis else slice(None) for other in range(3))
        one, two = strides[(axis + 1) % 3], strides[(axis + 2) % 3]
        for inner, outer, corners in (
            (low, high, (0, one, one + two, two)),  # faces the axis
            (high, low, (0, two, one + two, one)),
        ):
            # The square's own node is the lower corner of the upper of the two cubes.
            i, j, k = np.nonzero(solid[inner] & ~solid[outer])
            corner = i * strides[0] + j * strides[1] + k * strides[2] + strides[axis]
            quads.append(corner[:, None] + np.array(corners))
    square = np.concatenate(quads)
    used, index = np.unique(square, return_inverse=True)
    index = index.reshape(-1, 4)
    faces = np.concatenate([index[:, [0, 1, 2]], index[:, [0, 2, 3]]]).astype(np.int64)
    places = np.stack([used // strides[0], used // strides[1] % nodes, used % nodes], axis=1)
    return origin + spacing * places, faces


MOST = 8
"""Stages at the end, the beginning and the end among them."""
_FIRST_STEP = 1.0 / 1024.0
"""Share of the ball's volume that is opened between the first stages; it doubles whenever there are too many."""
_ACROSS = 128
"""Blocks across the map, at most, that a skin is made of."""


@dataclass(frozen=True)
class Stage:
    """The skin of the map at some time (s): vertices (v, 3) m and faces (f, 3)."""

    time: float
    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]


@dataclass(frozen=True)
class _Kept:
    time: float
    volume: float
    cubes: UInt8[np.ndarray, " bytes"]


class Stages:
    """Remembers a map, a bit a cube, each time that enough more of it is free."""

    def __init__(self, known: KnownFreeMap, now: float) -> None:
        self._kept = [_Kept(now, 0.0, np.packbits(known.free))]
        self._step = _FIRST_STEP * 4.0 / 3.0 * np.pi * known.radius**3

    def note(self, known: KnownFreeMap, now: float, free_volume: float) -> None:
        """Remember the map at `now` (s) if its known-free room inside the ball (m³) has grown enough."""
        if free_volume < self._kept[-1].volume + self._step:
            return
        self._kept.append(_Kept(now, free_volume, np.packbits(known.free)))
        while len(self._kept) >= MOST:
            self._step *= 2.0
            spread = self._kept[:1]
            for kept in self._kept[1:]:
                if kept.volume >= spread[-1].volume + self._step:
                    spread.append(kept)
            self._kept = spread

    def at_the_end(self, known: KnownFreeMap, now: float) -> tuple[Stage, ...]:
        """Give the skins at the times remembered and at the end, in order of time.

        Where the map is more than 128 cubes across, a skin is that of blocks of cubes: it lies no nearer to the target.
        """
        shape = known.free.shape
        stages = []
        for kept in self._kept:
            free = np.unpackbits(kept.cubes, count=int(np.prod(shape))).reshape(shape).astype(bool)
            if kept.time < now:
                stages.append(_stage(kept.time, free, known))
        return (*stages, _stage(now, known.free, known))


def _stage(time: float, free: Bool[np.ndarray, "n n n"], known: KnownFreeMap) -> Stage:
    width = -(-len(free) // _ACROSS)
    return Stage(time, *skin_of(whole_blocks(free, width), known.origin, width * known.spacing))


def skin_spacing(known: KnownFreeMap) -> float:
    """Give the edge of the blocks that a stage's skin is made of, m."""
    return -(-len(known.free) // _ACROSS) * known.spacing
