"""glTF's container: JSON, buffers, and the arrays that accessors describe."""

import base64
import binascii
import json
import struct
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from keepout.core.errors import MeshError

_JSON, _BIN = 0x4E4F534A, 0x004E4942
_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_MOST_ZEROS = 10_000_000
"""Entries of a sparse accessor without a view, which take no room in the file but do in memory."""
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


class GltfData:
    """A glTF 2 file's JSON tree with access to its numbers. Every look-up is checked; a wrong one is a `MeshError`."""

    def __init__(self, path: Path):
        data = path.read_bytes()
        self._folder = path.parent
        self._chunk: bytes | None = None
        if data[:4] == b"glTF":
            data, self._chunk = _chunks(data)
        try:
            tree = json.loads(data.decode("utf-8-sig"))
        except (UnicodeDecodeError, ValueError) as cause:
            raise MeshError(f"its JSON is damaged: {cause}") from None
        version = part(tree, "asset").get("version") if isinstance(tree, dict) else None
        if not (isinstance(version, str) and version.split(".")[0] == "2"):
            raise MeshError(f"its asset version is {version!r}; it must be 2.x")
        self.tree: dict[str, Any] = tree
        self._buffers: dict[int, bytes] = {}
        self._rows: dict[str, list[dict[str, Any]]] = {}

    def rows(self, kind: str) -> list[dict[str, Any]]:
        """All entries of one kind, such as "nodes"; none if the file has no such array."""
        if kind not in self._rows:
            self._rows[kind] = parts(self.tree, kind)
        return self._rows[kind]

    def entry(self, kind: str, index: Any) -> dict[str, Any]:
        """One entry by its index, which may neither be negative nor past the end."""
        entries = self.rows(kind)
        if type(index) is not int or not 0 <= index < len(entries):
            raise MeshError(f"{kind} index {index!r}; valid is 0 to {len(entries) - 1}")
        return entries[index]

    def view(self, index: Any) -> memoryview:
        """Look up the bytes of a buffer view."""
        view = self.entry("bufferViews", index)
        start, length = _whole(view, "byteOffset", 0), _whole(view, "byteLength")
        buffer = self._buffer(view.get("buffer"))
        if start + length > len(buffer):
            raise MeshError(f"bufferViews {index} ends at byte {start + length} of a buffer of {len(buffer)} bytes")
        return memoryview(buffer)[start : start + length]

    def numbers(self, index: Any, shape: str, *, kinds: str) -> np.ndarray:
        """Read an accessor.

        Args:
            index: of the accessor.
            shape: that it must have: SCALAR, VEC3 or VEC4.
            kinds: NumPy kinds of component that are valid: "f", "u", "iuf".

        Returns:
            (count,) or (count, width); float64 where `kinds` has "f", with normalised integers converted as the
            specification says, else int64.

        """
        accessor = self.entry("accessors", index)
        kind = _component(accessor)
        if accessor.get("type") != shape or kind is None or np.dtype(kind).kind not in kinds:
            found = f"type {accessor.get('type')!r}, componentType {accessor.get('componentType')!r}"
            raise MeshError(f"accessors {index} has {found}, which is not valid for what it holds")
        count, width = _whole(accessor, "count"), _WIDTHS[shape]
        sparse = part(accessor, "sparse") if "sparse" in accessor else None
        if "bufferView" in accessor:
            table = self._table(accessor, count, width, kind, stride=True)
        elif sparse is not None and count <= _MOST_ZEROS:
            table = np.zeros((count, width), dtype=kind)
        else:
            raise MeshError(f"accessors {index} of {count} entries has no bufferView, so its numbers are missing")
        if sparse is not None:
            table = self._with_sparse(table, sparse, kind)
        if "f" not in kinds:
            values = table.astype(np.int64)
        elif accessor.get("normalized", False) and np.dtype(kind).kind != "f":
            values = np.maximum(table.astype(np.float64) / np.iinfo(kind).max, -1.0)
        else:
            values = table.astype(np.float64)
        return values[:, 0] if shape == "SCALAR" else values

    def count(self, index: Any) -> int:
        """How many entries an accessor declares."""
        return _whole(self.entry("accessors", index), "count")

    def _table(self, accessor: dict[str, Any], count: int, width: int, kind: str, *, stride: bool) -> np.ndarray:
        data, start = self.view(accessor.get("bufferView")), _whole(accessor, "byteOffset", 0)
        view = self.entry("bufferViews", accessor.get("bufferView"))
        if "EXT_meshopt_compression" in part(view, "extensions"):
            raise MeshError("its numbers are compressed by EXT_meshopt_compression, which is not read")
        size = width * np.dtype(kind).itemsize
        step = _whole(view, "byteStride", size) if stride else size
        end = start + (count - 1) * step + size if count else start
        if end > len(data) or step < size:
            raise MeshError(f"an accessor of {count} entries ends at byte {end} of a view of {len(data)} bytes")
        if not count:
            return np.zeros((0, width), dtype=kind)
        table = np.ndarray(
            (count, width), dtype=kind, buffer=data, offset=start, strides=(step, np.dtype(kind).itemsize)
        )
        return table.copy()

    def _with_sparse(self, table: np.ndarray, sparse: dict[str, Any], kind: str) -> np.ndarray:
        count, places = _whole(sparse, "count"), part(sparse, "indices")
        place_kind = _component(places) or ""
        if place_kind not in ("<u1", "<u2", "<u4"):
            raise MeshError(f"sparse indices of componentType {places.get('componentType')!r}")
        rows = self._table(places, count, 1, place_kind, stride=False)[:, 0].astype(np.int64)
        if (rows >= len(table)).any():
            raise MeshError(f"a sparse accessor has the index {rows.max()}; valid is 0 to {len(table) - 1}")
        table[rows] = self._table(part(sparse, "values"), count, table.shape[1], kind, stride=False)
        return table

    def _buffer(self, index: Any) -> bytes:
        entry = self.entry("buffers", index)
        if index not in self._buffers:
            declared = _whole(entry, "byteLength")
            data = self._fetch(entry.get("uri"), index, declared)
            if len(data) < declared:
                raise MeshError(f"buffers {index} declares {declared} bytes and has {len(data)}")
            self._buffers[index] = data[:declared]
        return self._buffers[index]

    def _fetch(self, uri: Any, index: int, declared: int) -> bytes:
        if uri is None:
            if index != 0 or self._chunk is None:
                raise MeshError(f"buffers {index} has neither a uri nor a binary chunk")
            return self._chunk
        if not isinstance(uri, str):
            raise MeshError(f"buffers {index} has the uri {str(uri)[:60]}; text is valid")
        if uri.startswith("data:"):
            head, _, text = uri.partition(",")
            try:
                return base64.b64decode(text, validate=True) if head.endswith(";base64") else unquote(text).encode()
            except binascii.Error as cause:
                raise MeshError(f"buffers {index} is no base64: {cause}") from None
        return self._file(uri, index, declared)

    def _file(self, uri: str, index: int, declared: int) -> bytes:
        """Read a buffer from a file beside the mesh: a mesh from elsewhere is not to name any other of the machine."""
        place = f"buffers {index} is in the file {uri[:60]!r}"
        valid = "valid is the relative path of a regular file in or below the mesh's folder"
        try:
            folder = self._folder.resolve(strict=True)
            path = (folder / unquote(uri)).resolve(strict=True)
            if Path(unquote(uri)).is_absolute() or not path.is_relative_to(folder):
                raise MeshError(f"{place}, which is not in the mesh's folder; {valid}")
            if not path.is_file():
                raise MeshError(f"{place}, which is no regular file; {valid}")
            size = path.stat().st_size
            # As many bytes as declared, or up to three more that fill the last word.
            if not declared <= size <= declared + 3:
                raise MeshError(f"{place}; it declares {declared} bytes and has {size}")
            return path.read_bytes()
        except MeshError:
            raise
        except (OSError, ValueError, RuntimeError):  # RuntimeError: links in a circle
            raise MeshError(f"{place}, which cannot be read; {valid}") from None


def _chunks(data: bytes) -> tuple[bytes, bytes | None]:
    """Split GLB into its JSON and its binary chunk."""
    if len(data) < 20:
        raise MeshError(f"{len(data)} bytes, and a GLB header alone has 20")
    _, version, length, json_length, json_kind = struct.unpack_from("<5I", data)
    if version != 2:
        raise MeshError(f"GLB version {version}; it must be 2")
    if length != len(data):
        raise MeshError(f"the header declares {length} bytes and the file has {len(data)}")
    if json_kind != _JSON:
        raise MeshError("its first chunk is not JSON")
    position, found = 20 + json_length, None
    if position > length:
        raise MeshError(f"its JSON ends at byte {position} of {length}")
    while position < length:
        if position + 8 > length:
            raise MeshError(f"{length - position} bytes after its last chunk")
        size, kind = struct.unpack_from("<2I", data, position)
        if position + 8 + size > length:
            raise MeshError(f"a chunk ends at byte {position + 8 + size} of {length}")
        if kind == _BIN and found is None:
            found = data[position + 8 : position + 8 + size]
        position += 8 + size
    return data[20 : 20 + json_length], found


def _component(entry: dict[str, Any]) -> str | None:
    kind = entry.get("componentType")
    return _COMPONENTS.get(kind) if isinstance(kind, int) else None


def _whole(entry: dict[str, Any], key: str, absent: int | None = None) -> int:
    value = entry.get(key, absent)
    if type(value) is not int or value < 0:
        raise MeshError(f"{key} = {value!r}; it must be a whole number, zero or more")
    return value


def part(entry: dict[str, Any], key: str) -> dict[str, Any]:
    """Look up an object inside an entry; empty if it is absent."""
    found = entry.get(key, {})
    if not isinstance(found, dict):
        raise MeshError(f"{key} = {str(found)[:40]}; it must be an object")
    return found


def parts(entry: dict[str, Any], key: str) -> list[dict[str, Any]]:
    """Look up an array of objects inside an entry; empty if it is absent."""
    found = listed(entry, key)
    if not all(isinstance(item, dict) for item in found):
        raise MeshError(f"{key} = {str(found)[:40]}; it must be an array of objects")
    return found


def listed(entry: dict[str, Any], key: str) -> list[Any]:
    """Look up an array inside an entry; empty if it is absent."""
    found = entry.get(key, [])
    if not isinstance(found, list):
        raise MeshError(f"{key} = {str(found)[:40]}; it must be an array")
    return found
