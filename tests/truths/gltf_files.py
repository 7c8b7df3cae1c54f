"""glTF files written by hand, so that each oddity of the format can be put in alone."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

_COMPONENTS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
_SHAPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


class GltfFile:
    """A tree that grows: arrays become accessors, primitives become one mesh in one node unless said otherwise."""

    def __init__(self) -> None:
        self.data = b""
        self.tree: dict[str, Any] = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": []}],
            "accessors": [],
            "bufferViews": [],
        }

    def view(self, data: bytes) -> int:
        self.data += b"\0" * (-len(self.data) % 4)
        self.tree["bufferViews"].append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data)})
        self.data += data
        return len(self.tree["bufferViews"]) - 1

    def array(self, values: Any, kind: str, **entries: Any) -> int:
        table = np.ascontiguousarray(values, dtype=f"<{kind}")
        width = 1 if table.ndim == 1 else table.shape[1]
        accessor = {
            "bufferView": self.view(table.tobytes()),
            "componentType": _COMPONENTS[kind],
            "count": len(table),
            "type": _SHAPES[width],
            **entries,
        }
        self.tree["accessors"].append(accessor)
        return len(self.tree["accessors"]) - 1

    def primitive(self, positions: Any, indices: Any = None, mode: int | None = None, **entries: Any) -> dict[str, Any]:
        made: dict[str, Any] = {"attributes": {"POSITION": self.array(positions, "f4")}, **entries}
        if indices is not None:
            made["indices"] = self.array(indices, "u2")
        if mode is not None:
            made["mode"] = mode
        self.tree["meshes"][0]["primitives"].append(made)
        return made

    def write(self, path: Path) -> Path:
        """As GLB, or as glTF with a buffer of its own, by the path's suffix."""
        self.tree["buffers"] = [{"byteLength": len(self.data)}]
        if path.suffix == ".gltf":
            self.tree["buffers"][0]["uri"] = "its%20numbers.bin"
            (path.parent / "its numbers.bin").write_bytes(self.data)
            path.write_text(json.dumps(self.tree))
            return path
        text = json.dumps(self.tree).encode()
        text += b" " * (-len(text) % 4)
        data = self.data + b"\0" * (-len(self.data) % 4)
        chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(data), 0x004E4942) + data
        path.write_bytes(struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks)
        return path
