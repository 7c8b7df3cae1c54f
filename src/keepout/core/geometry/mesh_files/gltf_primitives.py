"""One glTF primitive: its positions and triangles, Draco's included, or what else it draws."""

from dataclasses import dataclass
from typing import Any

import DracoPy
import numpy as np
from jaxtyping import Float, Int

from keepout.core.errors import MeshError
from keepout.core.geometry.mesh_files.contents import check_indices
from keepout.core.geometry.mesh_files.gltf_data import GltfData, listed, part
from keepout.core.geometry.mesh_files.strips import fan_triangles, strip_triangles

DRACO, QUANTIZATION = "KHR_draco_mesh_compression", "KHR_mesh_quantization"
_POINTS, _LINES, _LOOP, _LINE_STRIP, _TRIANGLES, _STRIP, _FAN = range(7)


@dataclass(frozen=True, eq=False)
class Primitive:
    """What one primitive draws, in its mesh's own axes."""

    positions: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    points: Int[np.ndarray, "p"]
    """Indices of the positions that it draws as points."""
    segments: int = 0
    """Of lines, which are not kept."""
    joints: int = 0
    """Triangles of a strip or fan that repeat a corner, which are not kept."""


def read_primitive(data: GltfData, primitive: dict[str, Any]) -> Primitive:
    """Read a primitive of any mode.

    Raises:
        MeshError: if its mode, its numbers or its indices are not valid.

    """
    mode = primitive.get("mode", _TRIANGLES)
    if type(mode) is not int or not _POINTS <= mode <= _FAN:
        raise MeshError(f"a primitive has the mode {mode!r}; valid is 0 to 6")
    extensions = part(primitive, "extensions")
    if DRACO in extensions:
        positions, faces = _draco(data, primitive, part(extensions, DRACO), mode)
        check_indices(faces, len(positions), "a primitive")
        return Primitive(positions, faces, np.zeros(0, dtype=np.int64))
    position = part(primitive, "attributes").get("POSITION")
    if position is None:
        raise MeshError("a primitive has no POSITION, so its shape is not in the file")
    quantized = QUANTIZATION in [*listed(data.tree, "extensionsUsed"), *listed(data.tree, "extensionsRequired")]
    positions = data.numbers(position, "VEC3", kinds="iuf" if quantized else "f")
    order = np.arange(len(positions))
    if "indices" in primitive:
        order = data.numbers(primitive["indices"], "SCALAR", kinds="u")
        check_indices(order, len(positions), "a primitive")
    none = np.zeros((0, 3), dtype=np.int64)
    if mode == _POINTS:
        return Primitive(positions, none, order)
    points = np.zeros(0, dtype=np.int64)
    if mode < _TRIANGLES:
        segments = {_LINES: len(order) // 2, _LOOP: len(order), _LINE_STRIP: max(len(order) - 1, 0)}[mode]
        return Primitive(positions, none, points, segments=segments)
    if mode == _TRIANGLES:
        if len(order) % 3:
            raise MeshError(f"a primitive of triangles has {len(order)} corners, which three does not divide")
        return Primitive(positions, order.reshape(-1, 3), points)
    faces, joints = strip_triangles(order) if mode == _STRIP else fan_triangles(order)
    return Primitive(positions, faces, points, joints=joints)


def _draco(
    data: GltfData, primitive: dict[str, Any], packed: dict[str, Any], mode: int
) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Positions and triangles of a compressed primitive; a strip is unpacked into triangles too."""
    decoded = DracoPy.decode(bytes(data.view(packed.get("bufferView"))))
    wanted = part(packed, "attributes").get("POSITION")
    found = [entry["data"] for entry in decoded.attributes if entry["unique_id"] == wanted]
    faces = getattr(decoded, "faces", None)
    if len(found) != 1 or faces is None or mode not in (_TRIANGLES, _STRIP):
        raise MeshError("a primitive's compressed data have no positions or no triangles")
    positions = np.asarray(found[0])
    if positions.dtype.kind != "f" or positions.ndim != 2 or positions.shape[1] != 3:
        raise MeshError(f"a primitive's compressed positions are {positions.dtype} of shape {positions.shape}")
    faces = np.asarray(faces).astype(np.int64).reshape(-1, 3)
    declared = data.count(part(primitive, "attributes").get("POSITION"))
    if declared != len(positions):
        raise MeshError(f"a compressed primitive declares {declared} positions and has {len(positions)}")
    if mode == _TRIANGLES and "indices" in primitive and data.count(primitive["indices"]) != faces.size:
        raise MeshError(
            f"a compressed primitive declares {data.count(primitive['indices'])} corners and has {faces.size}"
        )
    return positions.astype(np.float64), faces
