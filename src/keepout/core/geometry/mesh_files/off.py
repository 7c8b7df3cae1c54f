"""OFF: as many vertices and faces as the header declares, one to a line."""

import re
from pathlib import Path

import numpy as np

from keepout.core.errors import MeshError
from keepout.core.geometry.mesh_files.contents import (
    MeshContents,
    counted,
    fans,
    index_refusal,
    text_lines,
    to_indices,
    to_numbers,
)

_KEYWORD = re.compile(r"(ST)?(C)?(N)?(4)?(n)?OFF")


def read_off(path: Path) -> MeshContents:
    """Read an OFF file (also COFF, NOFF, STOFF: colours, normals and texture places are passed over).

    Raises:
        MeshError: if the keyword is missing, the counts disagree with the lines, a line is no vertex or face, or an
            index points at no vertex.

    """
    lines, actions = text_lines(path)
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
        counts = to_indices(rows[0][1].split(), f"line {rows[0][0]}: ")
    except MeshError as refusal:
        raise MeshError(f"{refusal}; vertex, face and edge counts belong there") from None
    if len(counts) not in (2, 3) or min(counts) < 0:
        raise MeshError(f"line {rows[0][0]}: {rows[0][1][:40]!r}; vertex, face and edge counts belong there")
    vertex_count, face_count = counts[:2]
    rows = rows[1:]
    if len(rows) != vertex_count + face_count:
        there = f"{len(rows[:vertex_count])} and {len(rows[vertex_count:])}"
        raise MeshError(
            f"the header declares {counted(vertex_count, 'vertex line')} and {counted(face_count, 'face line')}; "
            f"there are {there}"
        )
    words, corners, sizes = [], [], []
    for number, text in rows[:vertex_count]:
        row = text.split()
        if len(row) < 3:
            raise MeshError(f"line {number}: {counted(len(row), 'number')}; a vertex needs three")
        words.extend(row[:3])
    vertices = to_numbers(words, "in the vertices, ").reshape(-1, 3)
    for number, text in rows[vertex_count:]:
        row = text.split()
        size = to_indices(row[:1], f"line {number}: ")[0]
        face = to_indices(row[1 : 1 + max(size, 0)], f"line {number}: ")
        if size < 0 or len(face) != size:
            raise MeshError(f"line {number}: the face declares {size} corners and has {len(face)}")
        if face and not 0 <= min(face) <= max(face) < vertex_count:
            raise index_refusal(f"line {number}", min(face) if min(face) < 0 else max(face), vertex_count)
        corners.extend(face)
        sizes.append(size)
    faces, said = fans(np.array(sizes, dtype=np.int64), np.array(corners, dtype=np.int64), vertices)
    return MeshContents(vertices, faces, (*actions, *said))
