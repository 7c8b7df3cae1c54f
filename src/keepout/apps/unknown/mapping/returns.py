"""The point cloud of a map: each return once on a fine lattice, so that neither order nor repetition changes it."""

import numpy as np
from jaxtyping import Float, Float32, Int64

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
