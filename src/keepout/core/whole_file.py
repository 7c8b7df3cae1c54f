"""Files written whole or not at all: a reader sees the old file or the new one, never half of either."""

import errno
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from keepout.core.errors import KeepoutError


def require_place(path: Path, *, refusal: type[KeepoutError] = KeepoutError) -> None:
    """Refuse a file that could not be written, before the work whose result it is to hold; nothing is left there.

    Args:
        path: the file; its folder may be missing, and is then made and taken away again.
        refusal: the error to raise.

    Raises:
        KeepoutError: of the kind `refusal`: the place cannot be written to.

    """
    if path.is_dir():
        raise refusal(f"{path}: cannot be written: {os.strerror(errno.EISDIR)}")
    with removed_again(path.parent):
        temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            temporary.open("xb").close()
            temporary.unlink()
        except OSError as error:
            raise refusal(f"{path}: cannot be written: {error.strerror or error}") from error


@contextmanager
def removed_again(folder: Path, *, only_on_failure: bool = False) -> Iterator[None]:
    """Take away folders that the block makes, this one and those above it, as far as they are empty at its end."""
    missing = [each for each in (folder, *folder.parents) if not each.exists()]
    failed = True
    try:
        yield
        failed = False
    finally:
        for each in missing if failed or not only_on_failure else ():
            with suppress(OSError):  # not made, or not empty
                each.rmdir()


def write_whole(path: Path, content: bytes | str, *, refusal: type[KeepoutError] = KeepoutError) -> None:
    """Write a file by way of a new one beside it that takes its place when it is complete and on the disk.

    Args:
        path: the file; its folder is made where it is missing.
        content: bytes, or text to be written as UTF-8.
        refusal: the error to raise.

    Raises:
        KeepoutError: of the kind `refusal`: the place cannot be written to. What stood there before still does.

    """
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with temporary.open("xb") as stream:
                stream.write(content.encode() if isinstance(content, str) else content)
                stream.flush()
                os.fsync(stream.fileno())
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        raise refusal(f"{path}: cannot be written: {error.strerror or error}") from error
