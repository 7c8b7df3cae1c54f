"""Files of the folder for kept programs: each with its own checksum, written whole, and young as long as it is used."""

import hashlib
import warnings
from contextlib import suppress
from pathlib import Path

from keepout.core.compiled.kept_programs import KeptProgramsWarning
from keepout.core.errors import KeepoutError
from keepout.core.whole_file import write_whole


def read_entry(path: Path) -> bytes | None:
    """Read what `write_entry` wrote; None where it is not there, with a warning where it is damaged."""
    try:
        whole = path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        warn_of(path, str(error.strerror))
        return None
    check, content = whole[:32], whole[32:]
    if hashlib.sha256(content).digest() != check:
        warn_of(path, "it is damaged")
        return None
    with suppress(OSError):
        path.touch()  # what is used stays when the folder is full
    return content


def write_entry(path: Path, content: bytes) -> None:
    """Write an entry whole, or warn that it cannot be kept."""
    try:
        write_whole(path, hashlib.sha256(content).digest() + content)
    except KeepoutError as error:
        warn_of(path, str(error))


def warn_of(path: Path, why: str) -> None:
    """Warn that an entry cannot be used or kept."""
    said = f"compiled programs are not all kept: {path}: {why}"
    warnings.warn(said, KeptProgramsWarning, stacklevel=2)
