"""Digests of text and arrays, by which a field, a mesh or a flight is known again."""

import hashlib

import numpy as np


def digest(*parts: str | bytes | np.ndarray) -> str:
    """Give the SHA-256, in hex, of text (as UTF-8), bytes and arrays (their memory in C order), one after another.

    Two arrays of another shape or type can hold the same bytes: say both in a text before the array.
    """
    whole = hashlib.sha256()
    for part in parts:
        part = part.encode() if isinstance(part, str) else part
        whole.update(part if isinstance(part, bytes) else np.ascontiguousarray(part).tobytes())
    return whole.hexdigest()
