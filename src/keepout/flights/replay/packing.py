"""Arrays as a page carries them: one compressed run of bytes, and where in it each array lies."""

import base64
import zlib
from typing import Any

import numpy as np

_ALIGNMENT = 4
"""Bytes: JavaScript reads an array of 32-bit numbers only from a multiple of four."""
_STEPS = 32767
"""Steps of a 16-bit number to either side of 0."""


class Packing:
    """Collects arrays, and gives a reference to each that JSON can hold.

    A reference holds `offset` (bytes), `type` (a NumPy name), `shape`, and, for numbers stored in steps, `scale` and
    `origin`: the number is origin + scale × what is stored, one of each for each column.
    """

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._length = 0

    def exact(self, array: np.ndarray, kind: str = "float32") -> dict[str, Any]:
        """Store an array in a NumPy type, and give its reference; None stands for nothing more than that."""
        stored = np.ascontiguousarray(array, dtype=np.dtype(kind).newbyteorder("<"))
        reference = {"offset": self._length, "type": kind, "shape": list(stored.shape)}
        content = stored.tobytes()
        padding = -len(content) % _ALIGNMENT
        self._parts.append(content + bytes(padding))
        self._length += len(content) + padding
        return reference

    def steps(self, array: np.ndarray) -> dict[str, Any]:
        """Store finite numbers in 16 bits each, in 65 534 even steps over the range of each column.

        What is read back is off by half a step at most: the column's range divided by 131 068.
        """
        rows = np.asarray(array, np.float64)
        columns = rows.reshape(len(rows), -1)
        lower = columns.min(axis=0, initial=np.inf) if len(columns) else np.zeros(columns.shape[1])
        upper = columns.max(axis=0, initial=-np.inf) if len(columns) else np.zeros(columns.shape[1])
        origin, scale = 0.5 * (lower + upper), (upper - lower) / (2 * _STEPS)
        stored = np.rint((columns - origin) / np.where(scale > 0.0, scale, 1.0))
        reference = self.exact(stored.reshape(rows.shape), "int16")
        return reference | {"origin": origin.tolist(), "scale": scale.tolist()}

    def indices(self, array: np.ndarray) -> dict[str, Any]:
        """Store indices in the smallest of the two types that a graphics card takes."""
        small = array.size == 0 or int(array.max()) < 2**16
        return self.exact(array, "uint16" if small else "uint32")

    def text(self) -> str:
        """Give all bytes, compressed (zlib) and as base64."""
        return base64.b64encode(zlib.compress(b"".join(self._parts), 9)).decode("ascii")
