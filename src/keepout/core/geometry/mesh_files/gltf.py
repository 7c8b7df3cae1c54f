"""glTF 2, text and binary: the shown scene's triangles, strips and fans, placed by their nodes and instances."""

import base64
import binascii
import json
import struct
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import DracoPy
import numpy as np
from jaxtyping import Float, Int

from keepout.core.errors import MeshError
from keepout.core.geometry.mesh_files import contents

_DRACO, _INSTANCING, _QUANTIZATION = "KHR_draco_mesh_compression", "EXT_mesh_gpu_instancing", "KHR_mesh_quantization"
_READ = (_DRACO, _INSTANCING, _QUANTIZATION)
_HARMLESS = (
    "KHR_texture_basisu",
    "KHR_texture_transform",
    "EXT_texture_webp",
    "EXT_texture_avif",
    "MSFT_texture_dds",
    "KHR_lights_punctual",
    "EXT_lights_image_based",
    "EXT_lights_ies",
    "KHR_xmp",
    "KHR_xmp_json_ld",
)
"""Extensions of look and description, which move no vertex; all of KHR_materials_ too."""
_POINTS, _LINES, _LOOP, _LINE_STRIP, _TRIANGLES, _STRIP, _FAN = range(7)
_JSON, _BIN = 0x4E4F534A, 0x004E4942
_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_MOST_ZEROS = 10_000_000
"""Entries of a sparse accessor without a view, which take no room in the file but do in memory."""
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


class _Data:
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
        version = _part(tree, "asset").get("version") if isinstance(tree, dict) else None
        if not (isinstance(version, str) and version.split(".")[0] == "2"):
            raise MeshError(f"its asset version is {version!r}; it must be 2.x")
        self.tree: dict[str, Any] = tree
        self._buffers: dict[int, bytes] = {}
        self._rows: dict[str, list[dict[str, Any]]] = {}

    def rows(self, kind: str) -> list[dict[str, Any]]:
        """All entries of one kind, such as "nodes"; none if the file has no such array."""
        if kind not in self._rows:
            self._rows[kind] = _parts(self.tree, kind)
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
        sparse = _part(accessor, "sparse") if "sparse" in accessor else None
        if "bufferView" in accessor:
            table = self._table(accessor, count, width, kind, stride=True)
        elif sparse is not None and count <= _MOST_ZEROS:
            table = np.zeros((count, width), dtype=kind)
        else:
            raise MeshError(f"accessors {index} of {count} entries has no bufferView, so its numbers are missing")
        if sparse is not None:
            table = self._with_sparse(table, sparse, kind)
        values = table.astype(np.float64 if "f" in kinds else np.int64)
        if "f" in kinds and accessor.get("normalized", False) and np.dtype(kind).kind != "f":
            values = np.maximum(values / np.iinfo(kind).max, -1.0)
        return values[:, 0] if shape == "SCALAR" else values

    def count(self, index: Any) -> int:
        """How many entries an accessor declares."""
        return _whole(self.entry("accessors", index), "count")

    def _table(self, accessor: dict[str, Any], count: int, width: int, kind: str, *, stride: bool) -> np.ndarray:
        data, start = self.view(accessor.get("bufferView")), _whole(accessor, "byteOffset", 0)
        view = self.entry("bufferViews", accessor.get("bufferView"))
        if "EXT_meshopt_compression" in _part(view, "extensions"):
            raise MeshError("its numbers are compressed by EXT_meshopt_compression, which is not read")
        item = np.dtype(kind).itemsize
        size = width * item
        step = _whole(view, "byteStride", size) if stride else size
        end = start + (count - 1) * step + size if count else start
        if end > len(data) or step < size:
            raise MeshError(f"an accessor of {count} entries ends at byte {end} of a view of {len(data)} bytes")
        if not count:
            return np.zeros((0, width), dtype=kind)
        return np.ndarray((count, width), dtype=kind, buffer=data, offset=start, strides=(step, item)).copy()

    def _with_sparse(self, table: np.ndarray, sparse: dict[str, Any], kind: str) -> np.ndarray:
        count, places = _whole(sparse, "count"), _part(sparse, "indices")
        place_kind = _component(places) or ""
        if place_kind not in ("<u1", "<u2", "<u4"):
            raise MeshError(f"sparse indices of componentType {places.get('componentType')!r}")
        rows = self._table(places, count, 1, place_kind, stride=False)[:, 0].astype(np.int64)
        if (rows >= len(table)).any():
            raise MeshError(f"a sparse accessor has the index {rows.max()}; valid is 0 to {len(table) - 1}")
        table[rows] = self._table(_part(sparse, "values"), count, table.shape[1], kind, stride=False)
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


def _part(entry: dict[str, Any], key: str) -> dict[str, Any]:
    """Look up an object inside an entry; empty if it is absent."""
    found = entry.get(key, {})
    if not isinstance(found, dict):
        raise MeshError(f"{key} = {str(found)[:40]}; it must be an object")
    return found


def _parts(entry: dict[str, Any], key: str) -> list[dict[str, Any]]:
    """Look up an array of objects inside an entry; empty if it is absent."""
    found = _listed(entry, key)
    if not all(isinstance(item, dict) for item in found):
        raise MeshError(f"{key} = {str(found)[:40]}; it must be an array of objects")
    return found


def _listed(entry: dict[str, Any], key: str) -> list[Any]:
    """Look up an array inside an entry; empty if it is absent."""
    found = entry.get(key, [])
    if not isinstance(found, list):
        raise MeshError(f"{key} = {str(found)[:40]}; it must be an array")
    return found


@dataclass(frozen=True, eq=False)
class _Primitive:
    """What one primitive draws, in its mesh's own axes.

    `points` are indices of the positions that it draws as points. Not kept are `segments` of lines, and `joints`:
    triangles of a strip or fan that repeat a corner.
    """

    positions: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"] = field(default_factory=lambda: np.zeros((0, 3), dtype=np.int64))
    points: Int[np.ndarray, "p"] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    segments: int = 0
    joints: int = 0


def _read_primitive(data: _Data, primitive: dict[str, Any]) -> _Primitive:
    """Read a primitive of any mode.

    Raises:
        MeshError: if its mode, its numbers or its indices are not valid.

    """
    mode = primitive.get("mode", _TRIANGLES)
    if type(mode) is not int or not _POINTS <= mode <= _FAN:
        raise MeshError(f"a primitive has the mode {mode!r}; valid is 0 to 6")
    extensions = _part(primitive, "extensions")
    if _DRACO in extensions:
        positions, faces = _draco(data, primitive, _part(extensions, _DRACO), mode)
        contents.check_indices(faces, len(positions), "a primitive")
        return _Primitive(positions, faces)
    position = _part(primitive, "attributes").get("POSITION")
    if position is None:
        raise MeshError("a primitive has no POSITION, so its shape is not in the file")
    quantized = _QUANTIZATION in [*_listed(data.tree, "extensionsUsed"), *_listed(data.tree, "extensionsRequired")]
    positions = data.numbers(position, "VEC3", kinds="iuf" if quantized else "f")
    order = np.arange(len(positions))
    if "indices" in primitive:
        order = data.numbers(primitive["indices"], "SCALAR", kinds="u")
        contents.check_indices(order, len(positions), "a primitive")
    if mode == _POINTS:
        return _Primitive(positions, points=order)
    if mode < _TRIANGLES:
        segments = {_LINES: len(order) // 2, _LOOP: len(order), _LINE_STRIP: max(len(order) - 1, 0)}[mode]
        return _Primitive(positions, segments=segments)
    if mode == _TRIANGLES:
        if len(order) % 3:
            raise MeshError(f"a primitive of triangles has {len(order)} corners, which three does not divide")
        return _Primitive(positions, order.reshape(-1, 3))
    faces, joints = contents.strip_triangles(order) if mode == _STRIP else contents.fan_triangles(order)
    return _Primitive(positions, faces, joints=joints)


def _draco(
    data: _Data, primitive: dict[str, Any], packed: dict[str, Any], mode: int
) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Positions and triangles of a compressed primitive; a strip is unpacked into triangles too."""
    decoded = DracoPy.decode(bytes(data.view(packed.get("bufferView"))))
    wanted = _part(packed, "attributes").get("POSITION")
    found = [entry["data"] for entry in decoded.attributes if entry["unique_id"] == wanted]
    faces = getattr(decoded, "faces", None)
    if len(found) != 1 or faces is None or mode not in (_TRIANGLES, _STRIP):
        raise MeshError("a primitive's compressed data have no positions or no triangles")
    positions = np.asarray(found[0])
    if positions.dtype.kind != "f" or positions.ndim != 2 or positions.shape[1] != 3:
        raise MeshError(f"a primitive's compressed positions are {positions.dtype} of shape {positions.shape}")
    faces = np.asarray(faces).astype(np.int64).reshape(-1, 3)
    held = [(_part(primitive, "attributes").get("POSITION"), len(positions), "positions")]
    if mode == _TRIANGLES and "indices" in primitive:
        held.append((primitive["indices"], faces.size, "corners"))
    for accessor, there, what in held:
        if (declared := data.count(accessor)) != there:
            raise MeshError(f"a compressed primitive declares {declared} {what} and has {there}")
    return positions.astype(np.float64), faces


def read_gltf(path: Path) -> contents.MeshContents:
    """Read a .gltf or .glb file.

    Raises:
        MeshError: if the file is not whole, requires an extension that is not read, has a skin or weighted morph
            targets, or an index points at nothing.

    """
    data = _Data(path)
    passed_over = _extensions(data)
    scene = _Scene(data)
    with np.errstate(invalid="ignore", over="ignore"):  # what is not finite is refused where a triangle uses it
        scene.walk()
    return scene.whole(passed_over)


def _extensions(data: _Data) -> list[str]:
    """Refuse a required extension that is not read, and say which others are passed over."""
    required, used = _listed(data.tree, "extensionsRequired"), _listed(data.tree, "extensionsUsed")
    for name in required:
        if not _known(str(name)):
            raise MeshError(
                f"it requires the extension {str(name)[:60]}, which is not read; those that change geometry and are "
                f"read: {', '.join(_READ)}"
            )
    primitives = [primitive for mesh in data.rows("meshes") for primitive in _parts(mesh, "primitives")]
    holders = [*data.rows("nodes"), *data.rows("meshes"), *primitives]
    found = {*map(str, used), *(name for holder in holders for name in _part(holder, "extensions"))}
    others = sorted(name for name in found if not _known(name))
    return [f"passed over the extension {name[:60]}, which the file does not require" for name in others]


def _known(name: str) -> bool:
    return name in _READ or name in _HARMLESS or name.startswith("KHR_materials_")


class _Scene:
    """The walk over the shown scene's nodes; gathers triangles, points and what is left out."""

    def __init__(self, data: _Data):
        self._data = data
        self._vertices: list[np.ndarray] = []
        self._faces: list[np.ndarray] = []
        self._points: list[np.ndarray] = []
        self._vertex_count = 0
        self._left_out: Counter[str] = Counter()
        self._morph_targets = 0
        self._drawn: list[tuple[int, dict[str, Any], list[contents.Place]]] = []
        self._resolution = contents.Resolution()

    def walk(self) -> None:
        """Visit all nodes of the shown scene once, count what their meshes make, and make it."""
        nodes = self._data.rows("nodes")
        if not self._data.rows("scenes"):
            raise MeshError("no scene in it, so nothing says where its meshes are")
        scene = self._data.entry("scenes", self._data.tree.get("scene", 0))
        # The last node first: this order of the vertices is part of the target's hash, which learned fields carry.
        queue = [(index, contents.FILE_AXES) for index in _listed(scene, "nodes")]
        seen = set()
        while queue:
            index, parent = queue.pop()
            node = self._data.entry("nodes", index)
            if index in seen:
                raise MeshError(f"node {index} has two parents, or is its own ancestor")
            seen.add(index)
            place = parent.then(_placement(node, index))
            queue.extend((child, place) for child in _listed(node, "children"))
            if "mesh" in node:
                self._node(node, index, place)
        self._count()
        for index, mesh, places in self._drawn:
            self._draw(index, mesh, places)
        self._resolution.require()
        placed = {node["mesh"] for node in nodes if type(node.get("mesh")) is int}
        hidden = [index for index, node in enumerate(nodes) if "mesh" in node and index not in seen]
        self._left_out["node with a mesh, not in the shown scene"] = len(hidden)
        self._left_out["mesh, placed by no node"] = len({*range(len(self._data.rows("meshes")))} - placed)

    def whole(self, passed_over: list[str]) -> contents.MeshContents:
        """Triangles where there are any, else points, with the action lines."""
        actions = list(passed_over)
        morphs, animations = self._morph_targets, len(self._data.rows("animations"))
        if morphs:
            actions.append(f"took the shape without {contents.counted(morphs, 'morph target')} of weight zero")
        if animations:
            actions.append(f"took the pose at rest, without {contents.counted(animations, 'animation')}")
        points = np.concatenate([np.zeros((0, 3)), *self._points])
        if self._faces:
            self._left_out["point"] = len(points)
            vertices, faces = np.concatenate(self._vertices), np.concatenate(self._faces)
        else:
            vertices, faces = points, np.zeros((0, 3), dtype=np.int64)
        return contents.MeshContents(vertices, faces, (*actions, *contents.left_out(self._left_out)))

    def _node(self, node: dict[str, Any], index: int, place: contents.Place) -> None:
        if "skin" in node:
            raise MeshError(f"node {index} has a skin, which joints bend; export the mesh in one pose without it")
        mesh = self._data.entry("meshes", node["mesh"])
        weights = _listed(node if "weights" in node else mesh, "weights")
        if any(weights):
            raise MeshError(f"node {index} has morph targets of weights {weights}; export the shape that they make")
        places = [place]
        if _INSTANCING in _part(node, "extensions"):
            places = [place.then(instance) for instance in self._instances(_part(node["extensions"], _INSTANCING))]
        self._drawn.append((index, mesh, places))

    def _count(self) -> None:
        """Refuse more than can be built, by the numbers that the accessors declare."""
        placements = triangles = corners = 0
        for _, mesh, places in self._drawn:
            for entry in _parts(mesh, "primitives"):
                declared = [_part(entry, "attributes").get("POSITION"), entry.get("indices")]
                counts = [self._data.count(index) for index in declared if index is not None] or [0]
                # An empty primitive costs its reading too.
                corners += len(places) * max(1, *counts)
                drawn = counts[-1] // 3 if entry.get("mode", 4) == 4 else counts[-1]
                triangles += len(places) * drawn if entry.get("mode", 4) > 3 else 0
            placements += len(places)
        contents.require_countable(placements, triangles, corners)

    def _draw(self, index: int, mesh: dict[str, Any], places: list[contents.Place]) -> None:
        for entry in _parts(mesh, "primitives"):
            primitive = _read_primitive(self._data, entry)
            self._morph_targets += len(_parts(entry, "targets"))
            self._left_out["line segment"] += primitive.segments * len(places)
            self._left_out["line primitive"] += len(places) if primitive.segments else 0
            self._left_out["joint, of strips or fans"] += primitive.joints * len(places)
            used = primitive.faces if len(primitive.faces) else primitive.points
            bounds = contents.box(primitive.positions[used].reshape(-1, 3))
            for place in places:
                matrix = place.matrix
                self._resolution.note(f"what node {index} places", bounds, place)
                if len(primitive.points):
                    self._points.append(_moved(primitive.positions[primitive.points], matrix))
                if len(primitive.faces):
                    # A mirroring turns the triangles round.
                    mirrored = np.linalg.det(matrix[:3, :3]) < 0.0
                    faces = primitive.faces[:, ::-1] if mirrored else primitive.faces
                    self._vertices.append(_moved(primitive.positions, matrix))
                    self._faces.append(faces + self._vertex_count)
                    self._vertex_count += len(primitive.positions)

    def _instances(self, extension: dict[str, Any]) -> list[Float[np.ndarray, "4 4"]]:
        """One matrix for each instance of a node's mesh."""
        attributes = _part(extension, "attributes")
        for accessor in attributes.values():
            count, most = self._data.count(accessor), contents.MOST_PLACED
            if count > most:
                raise MeshError(f"{_INSTANCING} with {count} instances; at most {most} are read")
        tables = {
            key.lower(): self._data.numbers(attributes[key], shape, kinds=kinds)
            for key, shape, kinds in (("TRANSLATION", "VEC3", "f"), ("ROTATION", "VEC4", "if"), ("SCALE", "VEC3", "f"))
            if key in attributes
        }
        counts = {len(table) for table in tables.values()}
        if len(counts) != 1:
            raise MeshError(f"{_INSTANCING} with {sorted(counts)} instances; its attributes must agree on one number")
        return [_matrix(**{key: table[row] for key, table in tables.items()}) for row in range(counts.pop())]


def _placement(node: dict[str, Any], index: int) -> Float[np.ndarray, "4 4"]:
    """Compose a node's own matrix, parent from child."""
    given = {key: node[key] for key in ("translation", "rotation", "scale") if key in node}
    if "matrix" not in node:
        sizes = {"translation": 3, "rotation": 4, "scale": 3}
        return _matrix(**{key: _values(value, sizes[key], index, key) for key, value in given.items()})
    matrix = _values(node["matrix"], 16, index, "matrix").reshape(4, 4).T
    if given:
        raise MeshError(f"node {index} has a matrix and {', '.join(given)}; one or the other is valid")
    if (matrix[3] != [0.0, 0.0, 0.0, 1.0]).any():
        raise MeshError(f"node {index} has a matrix whose last row is {matrix[3].tolist()}; it must be 0, 0, 0, 1")
    return matrix


def _values(value: Any, size: int, index: int, key: str) -> Float[np.ndarray, "n"]:
    numbers = isinstance(value, list) and all(type(entry) in (int, float) for entry in value)
    if not numbers or len(value) != size or not np.isfinite(np.array(value, dtype=np.float64)).all():
        raise MeshError(f"node {index} has the {key} {str(value)[:60]}; {size} finite numbers are valid")
    return np.array(value, dtype=np.float64)


def _matrix(
    translation: Float[np.ndarray, "3"] | None = None,
    rotation: Float[np.ndarray, "4"] | None = None,
    scale: Float[np.ndarray, "3"] | None = None,
) -> Float[np.ndarray, "4 4"]:
    """First scale, then rotate (quaternion, scalar last), then translate."""
    matrix = np.eye(4)
    if rotation is not None:
        if not 0.5 < np.linalg.norm(rotation) < 2.0:
            raise MeshError(f"a rotation is the quaternion {rotation.tolist()}; it must have length one")
        from trimesh.transformations import quaternion_matrix  # trimesh takes half a second, and few files turn parts

        matrix = np.asarray(quaternion_matrix(rotation[[3, 0, 1, 2]]), dtype=np.float64)
    if scale is not None:
        matrix = matrix @ np.diag([*scale, 1.0])
    if translation is not None:
        matrix = matrix.copy()
        matrix[:3, 3] = translation
    return matrix


def _moved(points: Float[np.ndarray, "v 3"], matrix: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "v 3"]:
    if (matrix == np.eye(4)).all():
        return points
    return np.dot(matrix, np.column_stack([points, np.ones(len(points))]).T).T[:, :3]
