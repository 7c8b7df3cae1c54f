"""OBJ: vertices and polygons, relative indices included; lines, points and free forms are counted and left out."""

from collections import Counter
from pathlib import Path

import numpy as np

from keepout.core.errors import MeshError
from keepout.core.geometry.mesh_files.contents import (
    MeshContents,
    counted,
    fans,
    left_out,
    text_lines,
    to_indices,
    to_numbers,
)

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


def read_obj(path: Path) -> MeshContents:
    """Read an OBJ file. It declares no counts, so one cut short between lines cannot be told from a whole one.

    Raises:
        MeshError: with the line's number if a statement is unknown, a number is none, or an index points at no vertex.

    """
    lines, actions = text_lines(path)
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
                raise MeshError(f"line {at}: {counted(len(values), 'number')}; a vertex needs three")
            words.extend(values[:3])
            # A weight or a colour; anything else is a statement that lost its line end.
            to_numbers(values[3:], f"line {at}: after a vertex, ")
        elif statement in ("f", "fo"):
            indices = to_indices([value.split("/", 1)[0] for value in values], f"line {at}: ")
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
    vertices = to_numbers(words, "in the vertices, ").reshape(-1, 3)
    flat, counts = np.array(corners, dtype=np.int64), np.array(sizes, dtype=np.int64)
    if (flat >= len(vertices)).any():
        place = int(np.argmax(flat >= len(vertices)))
        at = where[int(np.searchsorted(np.cumsum(counts), place, side="right"))]
        raise MeshError(f"line {at}: the vertex index {flat[place] + 1}; valid is 1 to {len(vertices)}")
    faces, said = fans(counts, flat, vertices)
    for kind, number in sorted(dropped.items()):
        said += left_out(number, kind)
    return MeshContents(vertices, faces, (*actions, *said))


def _zero_based(index: int, so_far: int, line: int) -> int:
    """Count a vertex from zero; a negative index counts back from the last vertex above its line."""
    if index == 0 or index < -so_far or index > 2**62:
        valid = f"1 and above, or -1 to -{so_far}" if so_far else "1 and above"
        raise MeshError(f"line {line}: the vertex index {index}; valid is {valid}")
    return index - 1 if index > 0 else so_far + index
