"""Where entries stand in a scenario file, so that a refusal names the line."""

import tomllib
from collections.abc import Mapping
from typing import Any

Path = tuple[Any, ...]
"""Keys from the outermost table to an entry; places in an array are numbers."""


def entry_lines(text: str) -> dict[Path, int]:
    """Give the line, counted from 1, on which each table and entry of a valid TOML text begins.

    TOML is made of statements of whole lines, a header or a `key = value`, and no part of one is a statement. So lines
    are gathered until the TOML reader itself takes them; there is no second grammar here.
    """
    lines: dict[Path, int] = {}
    header: Path = ()
    counts: dict[Path, int] = {}
    gathered, first = "", 0
    for number, line in enumerate(text.replace("\r\n", "\n").split("\n"), start=1):
        if not gathered:
            first = number
        gathered = f"{gathered}\n{line}" if gathered else line
        try:
            tree = tomllib.loads(gathered)
        except tomllib.TOMLDecodeError:
            continue
        if tree and gathered.lstrip().startswith("["):
            header = _header(tree, counts)
            for length in range(1, len(header) + 1):  # a table is there from the first header that names it
                lines.setdefault(header[:length], first)
        else:
            _note(tree, header, first, lines)
        gathered = ""
    return lines


def line_of(lines: Mapping[Path, int], path: Path) -> int | None:
    """Give the line of an entry, or of the closest table around it that the file names; None where there is none."""
    for length in range(len(path), 0, -1):
        if path[:length] in lines:
            return lines[path[:length]]
    return None


def _header(tree: dict[str, Any], counts: dict[Path, int]) -> Path:
    """Give the path that a header opens; of an array of tables with the place of the table in it."""
    path: Path = ()
    inner: Any = tree
    while inner:
        if isinstance(inner, list):
            counts[path] = counts.get(path, -1) + 1
            return (*path, counts[path])
        [(key, inner)] = inner.items()
        path = (*path, key)
    return path


def _note(tree: Any, path: Path, number: int, lines: dict[Path, int]) -> None:
    for key, value in tree.items() if isinstance(tree, dict) else enumerate(tree):
        lines.setdefault((*path, key), number)
        if isinstance(value, dict | list):
            _note(value, (*path, key), number, lines)
