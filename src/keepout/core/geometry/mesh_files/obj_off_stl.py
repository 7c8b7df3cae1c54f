"""The plain formats: OBJ and OFF, vertices and polygons line by line, and STL, triangles facet by facet."""

import re
from collections import Counter
from pathlib import Path

import numpy as np

from keepout.core.errors import MeshError
from keepout.core.geometry.mesh_files import contents

_ATTRIBUTES = ("vt", "vn", "vp", "g", "o", "s", "mg", "usemtl", "mtllib", "usemap", "maplib")
_DISPLAY = ("bevel", "c_interp", "d_interp", "lod", "shadow_obj", "trace_obj", "ctech", "stech")
_FREE_FORM_BODY = ("cstype", "deg", "bmat", "step", "parm", "trim", "hole", "scrv", "sp", "end", "con")
_NO_GEOMETRY = frozenset((*_ATTRIBUTES, *_DISPLAY, *_FREE_FORM_BODY))
"""Statements that place no surface of their own."""
_LEFT_OUT = {
    "l": "line element",
    "p": "point element",
    "curv": "free-form curve",
    "curv2": "free-form curve",
    "surf": "free-form surface",
    "bzp": "free-form patch",
    "bsp": "free-form patch",
    "cdc": "free-form curve",
    "cdp": "free-form patch",
    "res": "free-form reference",
}
_STATEMENTS = frozenset(("v", "f", "fo", *_LEFT_OUT, *_NO_GEOMETRY))


def read_obj(path: Path) -> contents.MeshContents:
    """Read an OBJ file. It declares no counts, so one cut short between lines cannot be told from a whole one.

    Raises:
        MeshError: with the line's number if a statement is unknown, a number is none, or an index points at no vertex.

    """
    lines, actions = contents.text_lines(path)
    words: list[str] = []
    corners: list[int] = []
    sizes: list[int] = []
    where: list[int] = []
    dropped: Counter[str] = Counter()
    held: list[str] = []
    held_from = 0
    for number, line in enumerate(lines, 1):
        text, remark, _ = line.partition("#")
        first = text.split(None, 1)[:1]
        if held_from and first and first[0].rstrip("\\") in _STATEMENTS:
            raise MeshError(
                f"line {number}: begins with {first[0][:20]!r}, and line {held_from} ends in a backslash, which would "
                "make it part of that line's statement"
            )
        # A remark ends with its line, whatever it ends in.
        if text.endswith("\\") and not remark:
            held.extend(text[:-1].split())
            held_from = held_from or number
            continue
        row = [*held, *text.split()]
        at, held, held_from = held_from or number, [], 0
        if not row:
            continue
        statement, values = row[0], row[1:]
        if statement == "v":
            if len(values) < 3:
                raise MeshError(f"line {at}: {contents.counted(len(values), 'number')}; a vertex needs three")
            words.extend(values[:3])
            # A weight or a colour; anything else is a statement that lost its line end.
            contents.to_numbers(values[3:], f"line {at}: after a vertex, ")
        elif statement in ("f", "fo"):
            indices = contents.to_indices([value.split("/", 1)[0] for value in values], f"line {at}: ")
            so_far = len(words) // 3
            corners.extend([_zero_based(index, so_far, at) for index in indices])
            sizes.append(len(indices))
            where.append(at)
        elif statement in _LEFT_OUT:
            dropped[_LEFT_OUT[statement]] += 1
        elif statement not in _NO_GEOMETRY:
            raise MeshError(f"line {at}: the statement {statement[:20]!r} is not OBJ, or names another file")
    if held_from:
        raise MeshError(f"line {held_from}: goes on past the end of the file")
    vertices = contents.to_numbers(words, "in the vertices, ").reshape(-1, 3)
    flat, counts = np.array(corners, dtype=np.int64), np.array(sizes, dtype=np.int64)
    if (flat >= len(vertices)).any():
        place = int(np.argmax(flat >= len(vertices)))
        at = where[int(np.searchsorted(np.cumsum(counts), place, side="right"))]
        raise MeshError(f"line {at}: the vertex index {flat[place] + 1}; valid is 1 to {len(vertices)}")
    faces, said = contents.fans(counts, flat, vertices)
    return contents.MeshContents(vertices, faces, (*actions, *said, *contents.left_out(dict(sorted(dropped.items())))))


def _zero_based(index: int, so_far: int, line: int) -> int:
    """Count a vertex from zero; a negative index counts back from the last vertex above its line."""
    if index == 0 or index < -so_far or index > 2**62:
        valid = f"1 and above, or -1 to -{so_far}" if so_far else "1 and above"
        raise MeshError(f"line {line}: the vertex index {index}; valid is {valid}")
    return index - 1 if index > 0 else so_far + index


_KEYWORD = re.compile(r"(ST)?(C)?(N)?(4)?(n)?OFF")


def read_off(path: Path) -> contents.MeshContents:
    """Read an OFF file (also COFF, NOFF, STOFF: colours, normals and texture places are passed over).

    Raises:
        MeshError: if the keyword is missing, the counts disagree with the lines, a line is no vertex or face, or an
            index points at no vertex.

    """
    lines, actions = contents.text_lines(path)
    rows = [(number, text) for number, line in enumerate(lines, 1) if (text := line.partition("#")[0].strip())]
    keyword, rest = (*rows[0][1].split(None, 1), "")[:2] if rows else ("", "")
    kind = _KEYWORD.fullmatch(keyword)
    if kind is None:
        raise MeshError(f"begins with {keyword[:20]!r}; it must be OFF, COFF, NOFF or STOFF")
    if kind[4] or kind[5] or rest.split() == ["BINARY"]:
        raise MeshError(f"{rows[0][1][:20]!r} is not supported; three coordinates in text are")
    rows = [(rows[0][0], rest.strip()), *rows[1:]] if rest.strip() else rows[1:]
    if not rows:
        raise MeshError("the line of vertex and face counts is missing")
    try:
        counts = contents.to_indices(rows[0][1].split(), f"line {rows[0][0]}: ")
    except MeshError as refusal:
        raise MeshError(f"{refusal}; vertex, face and edge counts belong there") from None
    if len(counts) not in (2, 3) or min(counts) < 0:
        raise MeshError(f"line {rows[0][0]}: {rows[0][1][:40]!r}; vertex, face and edge counts belong there")
    vertex_count, face_count = counts[:2]
    rows = rows[1:]
    if len(rows) != vertex_count + face_count:
        raise MeshError(
            f"the header declares {contents.counted(vertex_count, 'vertex line')} and "
            f"{contents.counted(face_count, 'face line')}; "
            f"there are {len(rows[:vertex_count])} and {len(rows[vertex_count:])}"
        )
    words, corners, sizes = [], [], []
    for number, text in rows[:vertex_count]:
        row = text.split()
        if len(row) < 3:
            raise MeshError(f"line {number}: {contents.counted(len(row), 'number')}; a vertex needs three")
        words.extend(row[:3])
    vertices = contents.to_numbers(words, "in the vertices, ").reshape(-1, 3)
    for number, text in rows[vertex_count:]:
        row = text.split()
        size = contents.to_indices(row[:1], f"line {number}: ")[0]
        face = contents.to_indices(row[1 : 1 + max(size, 0)], f"line {number}: ")
        if size < 0 or len(face) != size:
            raise MeshError(f"line {number}: the face declares {size} corners and has {len(face)}")
        if face and not 0 <= min(face) <= max(face) < vertex_count:
            raise contents.index_refusal(f"line {number}", min(face) if min(face) < 0 else max(face), vertex_count)
        corners.extend(face)
        sizes.append(size)
    faces, said = contents.fans(np.array(sizes, dtype=np.int64), np.array(corners, dtype=np.int64), vertices)
    return contents.MeshContents(vertices, faces, (*actions, *said))


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


def read_stl(path: Path) -> contents.MeshContents:
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
    elif data.lstrip()[:5].lower() == b"solid" and b"\0" not in data:
        triangles, actions = _ascii(contents.with_plain_line_ends(data.decode("utf-8", errors="replace")))
    elif declared is None:
        raise MeshError(f"not a valid STL: {len(data)} bytes, and a binary header alone has {_HEADER}")
    else:
        raise MeshError(
            f"not a valid STL: the header declares {contents.counted(declared, 'triangle')}, "
            f"{_HEADER + _TRIANGLE * declared} bytes in all, and the file has {len(data)}"
        )
    vertices = triangles.reshape(-1, 3).astype(np.float64)
    return contents.MeshContents(vertices, np.arange(len(vertices), dtype=np.int64).reshape(-1, 3), tuple(actions))


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
                f"not a valid STL: after {contents.counted(len(words) // 9, 'whole facet')}, "
                f"line {_line(text, position)} begins neither a whole facet nor endsolid"
            )
        if _LOST.match(end.group().strip()):
            raise MeshError(f"not a valid STL: line {_line(text, position)} has a facet where a name belongs")
        position = end.end()
    corners = contents.to_numbers(words, "not a valid STL: in a vertex, ")
    return corners.reshape(-1, 3, 3), [f"{solids} solids taken together"] if solids > 1 else []


def _line(text: str, position: int) -> int:
    while position < len(text) and text[position].isspace():
        position += 1
    return text.count("\n", 0, position) + 1
