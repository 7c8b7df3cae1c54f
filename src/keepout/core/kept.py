"""What is kept on disk from one run to the next: each in a file of its own, found by all that it was made of.

What costs much to make (a compiled program, a guard's field, the flights of an experiment) is made once. A file is
written whole or not at all, under a digest of what it depends on: a change of that leads to another file, and never to
an old answer. By the same digests a field, a mesh or a flight is known again.
"""

import hashlib
import io
import zipfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from keepout.core.errors import KeepoutError


def digest(*parts: str | bytes | np.ndarray) -> str:
    """Give the SHA-256, in hex, of text (as UTF-8), bytes and arrays (their memory in C order), one after another.

    Two arrays of another shape or type can hold the same bytes: say both in a text before the array.
    """
    whole = hashlib.sha256()
    for part in parts:
        part = part.encode() if isinstance(part, str) else part
        whole.update(part if isinstance(part, bytes) else np.ascontiguousarray(part).tobytes())
    return whole.hexdigest()


UNREADABLE = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile)
"""What reading a damaged file raises; a `KeepoutError` is a `ValueError`."""


class Form(NamedTuple):
    """How a kind of thing stands in its file.

    Attributes:
        ending: of the file's name.
        read: from its path; raises one of `UNREADABLE` where it is damaged.
        write: to that path, whole or not at all; raises an `OSError` or a `KeepoutError` where that cannot be.

    """

    ending: str
    read: Callable[[Path], Any]
    write: Callable[[Path, Any], None]


@dataclass(frozen=True)
class Store:
    """A folder of things that are kept.

    Attributes:
        folder: that holds the files.
        digits: of the digest that stand in a name.
        unread: told of a file that cannot be used, and why: raises, or else the thing is made and kept anew.
        unkept: told of a file that cannot be written, and why: raises, or else the thing is not kept.

    """

    folder: Path
    digits: int
    unread: Callable[[Path, Exception], None]
    unkept: Callable[[Path, Exception], None]

    def take(self, name: str, made_of: str | bytes, make: Callable[[], Any], form: Form) -> Any:
        """Give a thing from its file, or make it and keep it there.

        Args:
            name: begins the file's name.
            made_of: all that the thing depends on.
            make: makes it.
            form: of the file.

        """
        path = self.folder / f"{name}-{digest(made_of)[: self.digits]}{form.ending}"
        if path.exists():
            try:
                with suppress(FileNotFoundError):  # another process may have taken it away
                    return form.read(path)
            except UNREADABLE as error:
                self.unread(path, error)
        made = make()
        try:
            form.write(path, made)
        except (OSError, KeepoutError) as error:
            self.unkept(path, error)
        return made


def packed(arrays: dict[str, np.ndarray], *, compressed: bool = False) -> bytes:
    """Give arrays by name as the bytes of an `.npz` file."""
    stream = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(stream, allow_pickle=False, **arrays)
    return stream.getvalue()


def unpacked(content: bytes) -> dict[str, np.ndarray]:
    """Give the arrays of an `.npz` file; raises one of `UNREADABLE` where it is damaged."""
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        return dict(arrays)
