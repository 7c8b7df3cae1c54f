"""Arrays that a process takes from the disk instead of computing them again: beside the kept programs, as private.

They are found by everything that they were computed from: all that the arguments hold, arrays and the rest, Keepout's
source files and constants, the versions of Python, JAX, Equinox, NumPy and of the libraries that are named, JAX's
settings; and by the processor, since last bits depend on it. Where something cannot be told apart that way, such as a
field that is a function of the user's, nothing is kept.
"""

import hashlib
import importlib.metadata
import io
import zipfile
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from keepout.core.compiled.kept_entries import read_entry, warn_of, write_entry
from keepout.core.compiled.kept_executables import told_apart
from keepout.core.compiled.kept_programs import folder_in_use

Arrays = dict[str, np.ndarray]


def kept_arrays(name: str, made_from: Any, make: Callable[[], Arrays], *, libraries: Sequence[str] = ()) -> Arrays:
    """Take arrays from the folder of kept programs, or make them and keep them there.

    Args:
        name: of what the arrays are, a word for the file's name.
        made_from: a tree of all that `make` depends on.
        make: gives the arrays, by name.
        libraries: distributions, by name, whose version matters beside those that Keepout's programs depend on.

    Returns:
        The arrays, the same bits whether they were kept or not.

    """
    folder = folder_in_use()
    told = told_apart(made_from) if folder is not None else None
    if folder is None or told is None:
        return make()
    versions = [(library, importlib.metadata.version(library)) for library in libraries]
    path = folder / f"{name}-{hashlib.sha256(told + repr(versions).encode()).hexdigest()}-cache"
    content = read_entry(path)
    if content is not None:
        try:
            with np.load(io.BytesIO(content), allow_pickle=False) as kept:
                return dict(kept)
        except (ValueError, OSError, KeyError, zipfile.BadZipFile) as error:
            warn_of(path, str(error))
    made = make()
    named: dict[str, Any] = dict(made)
    stream = io.BytesIO()
    np.savez(stream, **named)
    write_entry(path, stream.getvalue())
    return made
