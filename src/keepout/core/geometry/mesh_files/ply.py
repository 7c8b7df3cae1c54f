"""PLY, in text and binary: every element that the header declares is there, and nothing after it."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Int

from keepout.core.errors import MeshError
from keepout.core.geometry.mesh_files import contents

_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
    "int64": "i8",
    "uint64": "u8",
    "float16": "f2",
}
_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_LISTS = ("vertex_indices", "vertex_index")


@dataclass
class _Property:
    name: str
    kind: str
    count_kind: str | None = None
    """Of a list: the type of its length."""


@dataclass
class _Element:
    name: str
    count: int
    properties: list[_Property] = field(default_factory=list)

    def has(self, name: str) -> bool:
        return any(entry.name == name for entry in self.properties)


_Values = dict[str, np.ndarray | tuple[np.ndarray, np.ndarray]]
"""By property: a column of an element's values, or a list's lengths and all its values one after the other."""


def read_ply(path: Path) -> contents.MeshContents:
    """Read a PLY file: polygons and triangle strips, or points where it has neither.

    Raises:
        MeshError: if the header is not PLY, an element is not there whole, or an index points at no vertex.

    """
    data = path.read_bytes()
    order, elements, start = _header(data)
    actions: list[str] = []
    if order == "":
        values = _read_text(data[start:], elements)
        actions += [] if data.endswith((b"\n", b"\r")) else [contents.UNENDED]
    else:
        values = _read_binary(data, start, order, elements)
    named = {element.name: element for element in elements}
    if "vertex" not in named:
        raise MeshError("no element 'vertex' in the header")
    columns = []
    for axis in "xyz":
        column = values["vertex"].get(axis)
        if not isinstance(column, np.ndarray):
            raise MeshError(f"the element 'vertex' has no single property {axis!r}")
        columns.append(column.astype(np.float64))
    vertices = np.stack(columns, axis=1)
    faces = [np.zeros((0, 3), dtype=np.int64)]
    for element in elements:
        if element.name == "face" and element.count:
            counts, corners = _corners(element, values["face"])
            contents.check_indices(corners, len(vertices), "a face")
            triangles, said = contents.fans(counts, corners, vertices)
            faces.append(triangles)
            actions += said
        elif element.name == "tristrips" and element.count:
            counts, corners = _corners(element, values["tristrips"])
            contents.check_indices(corners[corners != -1], len(vertices), "a triangle strip")
            triangles, joints = _strips(counts, corners)
            faces.append(triangles)
            actions += contents.left_out({"joint, of strips": joints})
        elif element.name != "vertex" and element.count:
            actions += contents.left_out({f"element, {element.name[:40]!r}": element.count})
    return contents.MeshContents(vertices, np.concatenate(faces), tuple(actions))


def _header(data: bytes) -> tuple[str, list[_Element], int]:
    """Byte order ("" for text), elements, and where the data begin."""
    position, number = 0, 0
    order: str | None = None
    elements: list[_Element] = []
    while True:
        end = data.find(b"\n", position)
        if end < 0:
            raise MeshError(f"the header has no end_header after {contents.counted(number, 'line')}")
        line = data[position:end].decode("utf-8", errors="replace").strip()
        position, number = end + 1, number + 1
        if number == 1:
            if line.lower() != "ply":
                raise MeshError(f"begins with {line[:20]!r}; it must be 'ply'")
            continue
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["end_header", *_]:
                if order is None:
                    raise MeshError("the header names no format")
                if len({element.name for element in elements}) < len(elements):
                    raise MeshError("the header declares an element twice")
                return order, elements, position
            case ["format", kind, _] if order is None and kind in _FORMATS:
                order = _FORMATS[kind]
            case ["element", name, count] if count.isascii() and count.isdigit() and len(count) <= 18:
                elements.append(_Element(name, int(count)))
            case ["property", "list", size, kind, name] if (
                elements and _TYPES.get(size, "f")[0] != "f" and kind in _TYPES and not elements[-1].has(name)
            ):
                elements[-1].properties.append(_Property(name, _TYPES[kind], _TYPES[size]))
            case ["property", kind, name] if elements and kind in _TYPES and not elements[-1].has(name):
                elements[-1].properties.append(_Property(name, _TYPES[kind]))
            case _:
                raise MeshError(f"line {number} of the header: {line[:60]!r} is not PLY")


def _short(element: _Element, there: int) -> MeshError:
    return MeshError(f"the header declares {element.count} elements {element.name[:40]!r} and {there} are there whole")


def _read_text(body: bytes, elements: list[_Element]) -> dict[str, _Values]:
    text = contents.with_plain_line_ends(body.decode("utf-8", errors="replace"))
    rows = [line.split() for line in text.split("\n")]
    rows = [row for row in rows if row]
    position, values = 0, {}
    for element in elements:
        mine = rows[position : position + element.count]
        position += element.count
        if len(mine) < element.count:
            raise _short(element, len(mine))
        values[element.name] = _columns(element, mine)
    if len(rows) > position:
        raise MeshError(f"the header declares {contents.counted(position, 'line')} of data and there are {len(rows)}")
    return values


def _columns(element: _Element, rows: list[list[str]]) -> _Values:
    """Sort an element's rows of words into its properties."""
    cells: list[list[str]] = [[] for _ in element.properties]
    lengths: list[list[int]] = [[] for _ in element.properties]
    for number, row in enumerate(rows):
        place = 0
        for cell, length, entry in zip(cells, lengths, element.properties):
            size = 1
            if entry.count_kind is not None:
                word = row[place] if place < len(row) else ""
                size = int(word) if word.isascii() and word.isdigit() and len(word) < 10 else len(row)
                length.append(size)
                place += 1
            cell.extend(row[place : place + size])
            place += size
        if place != len(row):
            raise MeshError(
                f"element {element.name[:40]!r} number {number}: {contents.counted(len(row), 'value')}, "
                "which is not what its properties need"
            )
    return _gathered(element, [_cast(element, *pair) for pair in zip(element.properties, cells)], lengths)


def _gathered(element: _Element, columns: Iterable[np.ndarray], lengths: list[list[int]]) -> _Values:
    """Give an element's values by property; a list's with the lengths of all rows."""
    return {
        entry.name: column if entry.count_kind is None else (np.array(length, dtype=np.int64), column)
        for entry, column, length in zip(element.properties, columns, lengths)
    }


def _cast(element: _Element, entry: _Property, words: list[str]) -> np.ndarray:
    """Round to the declared type, as the binary file would hold it."""
    place = f"property {entry.name[:40]!r} of element {element.name[:40]!r}"
    numbers = contents.to_numbers(words, f"{place}: ")
    with np.errstate(invalid="ignore", over="ignore"):
        column = numbers.astype(entry.kind)
    if entry.kind[0] != "f" and (column.astype(np.float64) != numbers).any():
        wrong = numbers[column.astype(np.float64) != numbers][0]
        raise MeshError(f"{place}: {wrong:.10g} is no whole number of its type")
    return column


def _read_binary(data: bytes, start: int, order: str, elements: list[_Element]) -> dict[str, _Values]:
    values = {}
    for element in elements:
        if element.count and element.properties:
            values[element.name], start = _binary(data, start, order, element)
        else:
            nothing = [np.zeros(0) for _ in element.properties]
            values[element.name] = _gathered(element, nothing, [[] for _ in element.properties])
    if start != len(data):
        raise MeshError(f"the header declares {start} bytes in all and the file has {len(data)}")
    return values


def _binary(data: bytes, start: int, order: str, element: _Element) -> tuple[_Values, int]:
    """Read an element: in one go where its lists all have the lengths of its first row, else row by row."""
    first, _ = _ragged(data, start, order, element, 1)
    fields: list[tuple[str, str] | tuple[str, str, int]] = []
    for number, entry in enumerate(element.properties):
        found = first[entry.name]
        if isinstance(found, tuple):
            fields.append((f"count{number}", order + str(entry.count_kind)))
            fields.append((f"value{number}", order + entry.kind, int(found[0][0])))
        else:
            fields.append((f"value{number}", order + entry.kind))
    row = np.dtype(fields)
    end = start + element.count * row.itemsize
    if end <= len(data):
        table = np.frombuffer(data, row, element.count, start)
        counts = [table[name].astype(np.int64) for name in row.names or () if name.startswith("count")]
        if all((count == count[0]).all() for count in counts):
            values: _Values = {}
            for number, entry in enumerate(element.properties):
                column = table[f"value{number}"]
                values[entry.name] = column if entry.count_kind is None else (counts.pop(0), column.reshape(-1))
            return values, end
    return _ragged(data, start, order, element, element.count)


def _ragged(data: bytes, start: int, order: str, element: _Element, rows: int) -> tuple[_Values, int]:
    """Read the first rows of an element one by one."""
    kinds = [
        (np.dtype(order + entry.kind), np.dtype(order + entry.count_kind) if entry.count_kind else None)
        for entry in element.properties
    ]
    cells: list[list[np.ndarray]] = [[] for _ in kinds]
    lengths: list[list[int]] = [[] for _ in kinds]
    place = start
    for row in range(rows):
        for cell, length, (kind, count_kind) in zip(cells, lengths, kinds):
            size = 1
            if count_kind is not None:
                if place + count_kind.itemsize > len(data):
                    raise _short(element, row)
                size = int(np.frombuffer(data, count_kind, 1, place)[0])
                place += count_kind.itemsize
                length.append(size)
            if size < 0:
                raise MeshError(f"element {element.name[:40]!r} number {row}: a list of {size} values")
            if place + size * kind.itemsize > len(data):
                raise _short(element, row)
            cell.append(np.frombuffer(data, kind, size, place))
            place += size * kind.itemsize
    return _gathered(element, map(np.concatenate, cells), lengths), place


def _corners(element: _Element, values: _Values) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "corners"]]:
    if all(element.has(name) for name in _LISTS):
        raise MeshError(f"element {element.name!r} has both {' and '.join(_LISTS)}; one list of corners is valid")
    for name in _LISTS:
        found = values.get(name)
        if isinstance(found, tuple):
            counts, corners = found
            if corners.dtype.kind == "f":
                raise MeshError(f"element {element.name!r}: the indices are of a floating type; they must be whole")
            if corners.dtype.kind == "u" and (corners > 2**62).any():
                raise MeshError(f"element {element.name!r} has the vertex index {int(corners.max())}")
            return counts, corners.astype(np.int64)
    raise MeshError(f"element {element.name!r} has no list property {_LISTS[0]} or {_LISTS[1]}")


def _strips(counts: Int[np.ndarray, "n"], corners: Int[np.ndarray, "corners"]) -> tuple[Int[np.ndarray, "f 3"], int]:
    """Triangles of all strips, which an index of -1 ends too, and the number of joints left out."""
    faces, joints = [np.zeros((0, 3), dtype=np.int64)], 0
    ends = np.concatenate([np.cumsum(counts), np.flatnonzero(corners == -1)])
    for strip in np.split(corners, np.unique(ends)):
        triangles, dropped = contents.strip_triangles(strip[strip != -1])
        faces.append(triangles)
        joints += dropped
    return np.concatenate(faces), joints
