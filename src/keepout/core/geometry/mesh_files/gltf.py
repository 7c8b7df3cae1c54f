"""glTF 2, text and binary: the shown scene's triangles, strips and fans, placed by their nodes and instances."""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from keepout.core.errors import MeshError
from keepout.core.geometry.mesh_files.contents import (
    FILE_AXES,
    MOST_PLACED,
    MeshContents,
    Place,
    Resolution,
    box,
    counted,
    left_out,
    require_countable,
)
from keepout.core.geometry.mesh_files.gltf_data import GltfData, listed, part, parts
from keepout.core.geometry.mesh_files.gltf_primitives import DRACO, QUANTIZATION, read_primitive

INSTANCING = "EXT_mesh_gpu_instancing"
_READ = (DRACO, INSTANCING, QUANTIZATION)
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


def read_gltf(path: Path) -> MeshContents:
    """Read a .gltf or .glb file.

    Raises:
        MeshError: if the file is not whole, requires an extension that is not read, has a skin or weighted morph
            targets, or an index points at nothing.

    """
    data = GltfData(path)
    passed_over = _extensions(data)
    scene = _Scene(data)
    with np.errstate(invalid="ignore", over="ignore"):  # what is not finite is refused where a triangle uses it
        scene.walk()
    return scene.contents(passed_over)


def _extensions(data: GltfData) -> list[str]:
    """Refuse a required extension that is not read, and say which others are passed over."""
    required, used = listed(data.tree, "extensionsRequired"), listed(data.tree, "extensionsUsed")
    for name in required:
        if not _known(str(name)):
            raise MeshError(
                f"it requires the extension {str(name)[:60]}, which is not read; those that change geometry and are "
                f"read: {', '.join(_READ)}"
            )
    primitives = [primitive for mesh in data.rows("meshes") for primitive in parts(mesh, "primitives")]
    holders = [*data.rows("nodes"), *data.rows("meshes"), *primitives]
    found = {*map(str, used), *(name for holder in holders for name in part(holder, "extensions"))}
    others = sorted(name for name in found if not _known(name))
    return [f"passed over the extension {name[:60]}, which the file does not require" for name in others]


def _known(name: str) -> bool:
    return name in _READ or name in _HARMLESS or name.startswith("KHR_materials_")


class _Scene:
    """The walk over the shown scene's nodes; gathers triangles, points and what is left out."""

    def __init__(self, data: GltfData):
        self._data = data
        self._vertices: list[np.ndarray] = []
        self._faces: list[np.ndarray] = []
        self._points: list[np.ndarray] = []
        self._vertex_count = 0
        self._left_out: Counter[str] = Counter()
        self._morph_targets = 0
        self._drawn: list[tuple[int, dict[str, Any], list[Place]]] = []
        self._resolution = Resolution()

    def walk(self) -> None:
        """Visit all nodes of the shown scene once, count what their meshes make, and make it."""
        nodes = self._data.rows("nodes")
        if not self._data.rows("scenes"):
            raise MeshError("no scene in it, so nothing says where its meshes are")
        scene = self._data.entry("scenes", self._data.tree.get("scene", 0))
        # The last node first: this order of the vertices is part of the target's hash, which learned fields carry.
        queue = [(index, FILE_AXES) for index in listed(scene, "nodes")]
        seen = set()
        while queue:
            index, parent = queue.pop()
            node = self._data.entry("nodes", index)
            if index in seen:
                raise MeshError(f"node {index} has two parents, or is its own ancestor")
            seen.add(index)
            place = parent.then(_placement(node, index))
            queue.extend((child, place) for child in listed(node, "children"))
            if "mesh" in node:
                self._node(node, index, place)
        self._count()
        for index, mesh, places in self._drawn:
            self._draw(index, mesh, places)
        self._resolution.require()
        placed = {node["mesh"] for node in nodes if type(node.get("mesh")) is int}
        self._left_out["node with a mesh, not in the shown scene"] = sum(
            "mesh" in node for index, node in enumerate(nodes) if index not in seen
        )
        self._left_out["mesh, placed by no node"] = sum(
            index not in placed for index in range(len(self._data.rows("meshes")))
        )

    def contents(self, passed_over: list[str]) -> MeshContents:
        """Triangles where there are any, else points, with the action lines."""
        actions = list(passed_over)
        if self._morph_targets:
            actions.append(f"took the shape without {counted(self._morph_targets, 'morph target')} of weight zero")
        if self._data.rows("animations"):
            actions.append(f"took the pose at rest, without {counted(len(self._data.rows('animations')), 'animation')}")
        points = np.concatenate([np.zeros((0, 3)), *self._points])
        if self._faces:
            self._left_out["point"] = len(points)
            vertices, faces = np.concatenate(self._vertices), np.concatenate(self._faces)
        else:
            vertices, faces = points, np.zeros((0, 3), dtype=np.int64)
        for noun, number in self._left_out.items():
            actions += left_out(number, noun)
        return MeshContents(vertices, faces, tuple(actions))

    def _node(self, node: dict[str, Any], index: int, place: Place) -> None:
        if "skin" in node:
            raise MeshError(f"node {index} has a skin, which joints bend; export the mesh in one pose without it")
        mesh = self._data.entry("meshes", node["mesh"])
        weights = listed(node if "weights" in node else mesh, "weights")
        if any(weights):
            raise MeshError(f"node {index} has morph targets of weights {weights}; export the shape that they make")
        places = [place]
        if INSTANCING in part(node, "extensions"):
            places = [place.then(instance) for instance in self._instances(part(node["extensions"], INSTANCING))]
        self._drawn.append((index, mesh, places))

    def _count(self) -> None:
        """Refuse more than can be built, by the numbers that the accessors declare."""
        placements = triangles = corners = 0
        for _, mesh, places in self._drawn:
            for entry in parts(mesh, "primitives"):
                declared = [part(entry, "attributes").get("POSITION"), entry.get("indices")]
                counts = [self._data.count(index) for index in declared if index is not None] or [0]
                # An empty primitive costs its reading too.
                corners += len(places) * max(1, *counts)
                drawn = counts[-1] // 3 if entry.get("mode", 4) == 4 else counts[-1]
                triangles += len(places) * drawn if entry.get("mode", 4) > 3 else 0
            placements += len(places)
        require_countable(placements, triangles, corners)

    def _draw(self, index: int, mesh: dict[str, Any], places: list[Place]) -> None:
        for entry in parts(mesh, "primitives"):
            primitive = read_primitive(self._data, entry)
            self._morph_targets += len(parts(entry, "targets"))
            self._left_out["line segment"] += primitive.segments * len(places)
            self._left_out["line primitive"] += len(places) if primitive.segments else 0
            self._left_out["joint, of strips or fans"] += primitive.joints * len(places)
            used = primitive.faces if len(primitive.faces) else primitive.points
            bounds = box(primitive.positions[used].reshape(-1, 3))
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
        attributes = part(extension, "attributes")
        for accessor in attributes.values():
            if self._data.count(accessor) > MOST_PLACED:
                raise MeshError(
                    f"{INSTANCING} with {self._data.count(accessor)} instances; at most {MOST_PLACED} are read"
                )
        tables = {
            key: self._data.numbers(attributes[key], shape, kinds=kinds)
            for key, shape, kinds in (("TRANSLATION", "VEC3", "f"), ("ROTATION", "VEC4", "if"), ("SCALE", "VEC3", "f"))
            if key in attributes
        }
        counts = {len(table) for table in tables.values()}
        if len(counts) != 1:
            raise MeshError(f"{INSTANCING} with {sorted(counts)} instances; its attributes must agree on one number")
        return [
            _matrix(**{key.lower(): table[number] for key, table in tables.items()}) for number in range(counts.pop())
        ]


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
