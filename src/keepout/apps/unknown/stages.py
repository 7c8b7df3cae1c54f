"""How the map looked at some times of a flight, for pictures: at most eight, spread over what was opened."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, UInt8

from keepout.apps.unknown.exploration import Stage
from keepout.apps.unknown.mapping.known_free import KnownFreeMap
from keepout.apps.unknown.mapping.skin import skin_of

MOST = 8
"""Stages at the end, the beginning and the end among them."""
_FIRST_STEP = 1.0 / 1024.0
"""Share of the ball's volume that is opened between the first stages; it doubles whenever there are too many."""
_ACROSS = 128
"""Blocks across the map, at most, that a skin is made of."""


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
    blocks = _blocks(free, width)
    return Stage(time, *skin_of(blocks, known.origin, width * known.spacing))


def _blocks(free: Bool[np.ndarray, "n n n"], width: int) -> Bool[np.ndarray, "m m m"]:
    """Give the blocks, `width` cubes wide, of which every cube is free; beyond the map all is free."""
    across = -(-len(free) // width)
    padded = np.pad(free, (0, across * width - len(free)), constant_values=True)
    return np.asarray(padded.reshape(across, width, across, width, across, width).all(axis=(1, 3, 5)))


def skin_spacing(known: KnownFreeMap) -> float:
    """Give the edge of the blocks that a stage's skin is made of, m."""
    return -(-len(known.free) // _ACROSS) * known.spacing
