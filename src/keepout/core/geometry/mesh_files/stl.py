"""STL: binary by the length that its header declares, or else ASCII facet by facet."""

import re
from pathlib import Path

import numpy as np

from keepout.core.errors import MeshError
from keepout.core.geometry.mesh_files.contents import MeshContents, counted, to_numbers, with_plain_line_ends

_HEADER, _TRIANGLE = 84, 50
_VERTEX = r"\s+vertex\s+(\S+)\s+(\S+)\s+(\S+)"
_FACET = re.compile(
    rf"\s*facet\s+normal\s+\S+\s+\S+\s+\S+\s+outer\s+loop{3 * _VERTEX}\s+endloop\s+endfacet(?=\s)", re.IGNORECASE
)
_LOST = re.compile(r"[^\n]*(?<!\S)endfacet(?!\S)", re.IGNORECASE)
"""A whole facet on the line of a solid's name, where it would be taken for the name."""
_SOMETHING = re.compile(r"\S")
_BEGIN = re.compile(r"\s*solid(?:[^\S\n][^\n]*)?(?:\n|$)", re.IGNORECASE)
_END = re.compile(r"\s*end\s?solid(?:[^\S\n][^\n]*)?(?:\n|$)", re.IGNORECASE)


def read_stl(path: Path) -> MeshContents:
    """Read an STL file.

    Raises:
        MeshError: if the file is neither as long as its binary header says nor whole ASCII STL.

    """
    data = path.read_bytes()
    declared = int.from_bytes(data[80:84], "little") if len(data) >= _HEADER else None
    if declared is not None and len(data) == _HEADER + _TRIANGLE * declared:
        record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
        triangles = np.frombuffer(data, dtype=record, offset=_HEADER)["corners"]
        actions = []
    elif _looks_like_text(data):
        triangles, actions = _ascii(with_plain_line_ends(data.decode("utf-8", errors="replace")))
    elif declared is None:
        raise MeshError(f"not a valid STL: {len(data)} bytes, and a binary header alone has {_HEADER}")
    else:
        raise MeshError(
            f"not a valid STL: the header declares {counted(declared, 'triangle')}, {_HEADER + _TRIANGLE * declared} "
            f"bytes in all, and the file has {len(data)}"
        )
    vertices = triangles.reshape(-1, 3).astype(np.float64)
    return MeshContents(vertices, np.arange(len(vertices), dtype=np.int64).reshape(-1, 3), tuple(actions))


def _looks_like_text(data: bytes) -> bool:
    return data.lstrip()[:5].lower() == b"solid" and b"\0" not in data


def _ascii(text: str) -> tuple[np.ndarray, list[str]]:
    words: list[str] = []
    position, solids = 0, 0
    while _SOMETHING.search(text, position):
        begin = _BEGIN.match(text, position)
        if begin is None:
            raise MeshError(f"not a valid STL: line {_line(text, position)} should begin a solid")
        if _LOST.match(begin.group().strip()):
            raise MeshError(f"not a valid STL: line {_line(text, position)} has a facet where a name belongs")
        position, solids = begin.end(), solids + 1
        while facet := _FACET.match(text, position):
            words.extend(facet.groups())
            position = facet.end()
        end = _END.match(text, position)
        if end is None:
            raise MeshError(
                f"not a valid STL: after {counted(len(words) // 9, 'whole facet')}, line {_line(text, position)} "
                "begins neither a whole facet nor endsolid"
            )
        if _LOST.match(end.group().strip()):
            raise MeshError(f"not a valid STL: line {_line(text, position)} has a facet where a name belongs")
        position = end.end()
    corners = to_numbers(words, "not a valid STL: in a vertex, ")
    return corners.reshape(-1, 3, 3), [f"{solids} solids taken together"] if solids > 1 else []


def _line(text: str, position: int) -> int:
    while position < len(text) and text[position].isspace():
        position += 1
    return text.count("\n", 0, position) + 1
