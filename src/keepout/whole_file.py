"""Files written whole or not at all: a reader sees the old file or the new one, never half of either."""

import os
import secrets
from pathlib import Path

from keepout.errors import KeepoutError


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
