"""3MF: the build's items, with their components and their placements."""

import graphlib
import zipfile
from collections import Counter
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from jaxtyping import Float

from keepout.core.errors import MeshError
from keepout.core.geometry.mesh_files import contents

_MODEL = "http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"
_CORE = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
_READ = {
    _CORE: "core",
    "http://schemas.microsoft.com/3dmanufacturing/production/2015/06": "production",
    "http://schemas.microsoft.com/3dmanufacturing/material/2015/02": "material",
    "http://schemas.microsoft.com/3dmanufacturing/core/2021/07": "triangle sets",
}
_PLAIN = frozenset(("vertices", "triangles", "trianglesets", "metadatagroup", "metadata", "mesh", "components"))
_MOST_BYTES, _MOST_NODES = 256 << 20, 40_000_000
"""Of the parts of an archive that are read: bytes when inflated, and elements and attributes of their XML."""

_Key = tuple[str, str]
"""A model part's name and an object's id in it."""


def read_three_mf(path: Path) -> contents.MeshContents:
    """Read a 3MF file.

    Raises:
        MeshError: if the archive is damaged, an extension is required that is not read, a reference leads nowhere or
            into a circle, or an index points at no vertex.

    """
    try:
        archive = zipfile.ZipFile(path)
    except zipfile.BadZipFile as cause:
        raise MeshError(f"no whole ZIP archive: {cause}") from None
    with archive:
        return _Package(archive).whole()


class _Package:
    """The model parts of an archive, read as they are asked for."""

    def __init__(self, archive: zipfile.ZipFile):
        self._archive = archive
        names = [name.lower().strip("/") for name in archive.namelist()]
        twice = [name for name, number in Counter(names).items() if number > 1]
        if twice:
            raise MeshError(f"its archive has the part {twice[0][:60]!r} {names.count(twice[0])} times; once is valid")
        self._names = dict(zip(names, archive.namelist()))
        self._objects: dict[_Key, Element] = {}
        self._read: set[str] = set()
        self._meshes: dict[_Key, tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]] = {}
        self._components: dict[_Key, list[tuple[_Key, np.ndarray]]] = {}
        self._inflated = 0
        self._left_out: Counter[str] = Counter()
        self._kept: Counter[str] = Counter()

    def whole(self) -> contents.MeshContents:
        """Triangles of all build items."""
        main = self._main_part()
        root = self._part(main)
        build = _only(root, "build")
        if build is None:
            raise MeshError("its model has no build, so nothing says what belongs to it")
        items = [(self._key(item, main), _transform(item)) for item in build.iterfind("{*}item")]
        unprinted = [item.get("printable") for item in build.iterfind("{*}item") if item.get("printable") is not None]
        self._kept["build item that is not to be printed"] = sum(value not in ("1", "true") for value in unprinted)
        self._count(items)
        vertices, faces = self._placed(items)
        unplaced = sum(
            entry.find("{*}mesh") is not None for key, entry in self._objects.items() if key not in self._components
        )
        self._left_out["mesh object, not in the build"] = unplaced
        actions = contents.left_out(self._left_out)
        # Geometry is the target whatever a printer makes of it: what is left out, a chaser may fly into.
        for noun, number in self._kept.items():
            if number:
                first, _, rest = noun.partition(" of ")
                aside = f" of {rest}" if rest else ""
                actions.append(f"kept {contents.counted(number, first)}{aside}, as part of the target")
        # Points without triangles are no point cloud here: the format has none.
        if not len(faces):
            vertices = np.zeros((0, 3))
        return contents.MeshContents(vertices, faces, tuple(actions), root.get("unit", "millimeter"))

    def _count(self, items: list[tuple[_Key, np.ndarray]]) -> None:
        """Find all objects that the items lead to, and count what placing them makes before anything is placed."""
        waiting = [key for key, _ in items]
        while waiting:
            key = waiting.pop()
            if key in self._components:
                continue
            entry = self._objects[key]
            self._components[key] = [
                (self._key(component, key[0]), _transform(component))
                for component in entry.iterfind("{*}components/{*}component")
            ]
            waiting.extend(child for child, _ in self._components[key])
        graph = {key: {child for child, _ in children} for key, children in self._components.items()}
        try:
            order = list(graphlib.TopologicalSorter(graph).static_order())
        except graphlib.CycleError as cause:
            raise MeshError(f"the object {cause.args[1][0][1]!r} is a component of itself") from None
        made: dict[_Key, tuple[int, int, int]] = {}
        for key in order:
            mesh = _only(self._objects[key], "mesh")
            own = (0, 0) if mesh is None else (_number(mesh, "triangles"), _number(mesh, "vertices"))
            below = [made[child] for child, _ in self._components[key]]
            placements, triangles, vertices = (sum(column) for column in zip(*below)) if below else (0, 0, 0)
            made[key] = (1 + placements, own[0] + triangles, own[1] + vertices)
        totals = [made[key] for key, _ in items] or [(0, 0, 0)]
        placements, triangles, vertices = (sum(column) for column in zip(*totals))
        contents.require_countable(placements, triangles, vertices)

    def _placed(self, items: list[tuple[_Key, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
        """Vertices and faces of all items, each object before its components, in the file's order."""
        all_vertices, all_faces = [np.zeros((0, 3))], [np.zeros((0, 3), dtype=np.int64)]
        number, resolution = 0, contents.Resolution()
        waiting = [(key, contents.FILE_AXES.then(own)) for key, own in reversed(items)]
        while waiting:
            key, place = waiting.pop()
            self._note(key)
            if _only(self._objects[key], "mesh") is not None:
                if key not in self._meshes:
                    vertices, faces = self._mesh(self._objects[key])
                    self._meshes[key] = vertices, faces, contents.box(vertices[faces].reshape(-1, 3))
                vertices, faces, bounds = self._meshes[key]
                with np.errstate(invalid="ignore", over="ignore"):  # refused where a triangle uses it
                    all_vertices.append(vertices @ place.matrix[:3, :3].T + place.matrix[:3, 3])
                    resolution.note(f"the object {key[1][:40]!r}", bounds, place)
                all_faces.append(faces + number)
                number += len(vertices)
            with np.errstate(invalid="ignore", over="ignore"):
                waiting.extend((child, place.then(own)) for child, own in reversed(self._components[key]))
        resolution.require()
        return np.concatenate(all_vertices), np.concatenate(all_faces)

    def _note(self, key: _Key) -> None:
        """Note what one placement of an object leaves out, and what it keeps that a printer would not."""
        entry = self._objects[key]
        kind = entry.get("type", "model")
        if kind != "model":
            self._kept[f"placement of an object of type {kind[:40]!r}"] += 1
        for child in entry:
            name = _name(child.tag)
            if name not in _PLAIN:
                self._left_out[f"element, '{name[:40]}' of an object"] += 1

    def _main_part(self) -> str:
        if "_rels/.rels" in self._names:
            for relation in self._parse("_rels/.rels")[0]:
                if relation.get("Type") == _MODEL:
                    return relation.get("Target", "").lower().strip("/")
        return "3d/3dmodel.model"

    def _part(self, name: str) -> Element:
        """Parse one model part and note its objects."""
        if name not in self._names:
            raise MeshError(f"its archive has no part {name[:60]!r}")
        root, namespaces = self._parse(name)
        for prefix in root.get("requiredextensions", "").split():
            namespace = namespaces.get(prefix, prefix)
            if namespace not in _READ:
                raise MeshError(
                    f"it requires the extension {namespace[:100]}, which is not read; those read: "
                    f"{', '.join(_READ.values())}"
                )
        for entry in root.iterfind("{*}resources/{*}object"):
            key = (name, entry.get("id", ""))
            if key in self._objects:
                raise MeshError(f"two objects have the id {key[1]!r}")
            self._objects[key] = entry
        self._read.add(name)
        return root

    def _parse(self, name: str) -> tuple[Element, dict[str, str]]:
        """Inflate and parse one part of the archive, within the limits of all parts: its root, and namespaces."""
        entry = self._archive.getinfo(self._names[name])
        if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise MeshError(
                f"its part {name[:60]!r} is compressed by the method {entry.compress_type}; 0 and 8 are valid"
            )
        self._inflated += entry.file_size
        if self._inflated > _MOST_BYTES:
            raise MeshError(f"its parts inflate to {self._inflated} bytes or more; at most {_MOST_BYTES} are read")
        with self._archive.open(entry) as stream:
            data = stream.read(entry.file_size)  # `read` of an archive inflates what is there, whatever it declares
        if data.startswith((b"\xff\xfe", b"\xfe\xff")):
            data = data.decode("utf-16").encode()
        nodes = data.count(b"<") + data.count(b"=")
        if nodes > _MOST_NODES:
            raise MeshError(
                f"its part {name[:60]!r} has about {nodes} elements and attributes; at most {_MOST_NODES} are read"
            )
        # The format forbids document types; their entities make much of little.
        if b"<!DOCTYPE" in data:
            raise MeshError(f"its part {name[:60]!r} has a DOCTYPE, which 3MF forbids")
        prefixes = _Prefixes()
        try:
            root = ElementTree.fromstring(data, ElementTree.XMLParser(target=prefixes, encoding="utf-8"))
        except ElementTree.ParseError as cause:
            raise MeshError(f"its XML is damaged: {cause}") from None
        return root, prefixes.namespaces

    def _key(self, reference: Element, part: str) -> _Key:
        """Object that an item or a component refers to, in another part where it gives a path."""
        path = next((value for key, value in reference.attrib.items() if _name(key) == "path"), None)
        part = part if path is None else str(path).lower().strip("/")
        if part not in self._read:
            self._part(part)
        key = (part, reference.get("objectid", ""))
        if key not in self._objects:
            raise MeshError(f"it refers to the object {key[1][:40]!r}, which is not there")
        return key

    def _mesh(self, entry: Element) -> tuple[np.ndarray, np.ndarray]:
        mesh = entry.find("{*}mesh")
        assert mesh is not None
        for child in mesh:
            name = _name(child.tag)
            if name == "beamlattice":
                self._left_out["lattice beam"] += sum(_name(part.tag) == "beam" for part in child.iter())
            elif name not in _PLAIN:
                self._left_out[f"element, '{name[:40]}' of a mesh"] += 1
        for child in mesh.iterfind("{*}triangles/*"):
            name = _name(child.tag)
            if name != "triangle":
                self._left_out[f"element, '{name[:40]}' among triangles"] += 1
        words = [v.get(axis, "") for v in mesh.iterfind("{*}vertices/{*}vertex") for axis in "xyz"]
        corners = [t.get(v, "") for t in mesh.iterfind("{*}triangles/{*}triangle") for v in ("v1", "v2", "v3")]
        name = f"the object {entry.get('id', '')[:40]!r}"
        vertices = contents.to_numbers(words, f"{name}: ").reshape(-1, 3)
        try:
            faces = np.array(contents.to_indices(corners, f"{name}: "), dtype=np.int64).reshape(-1, 3)
        except OverflowError as cause:
            raise MeshError(f"{name}: {cause}") from None
        contents.check_indices(faces, len(vertices), name)
        return vertices, faces


class _Prefixes(ElementTree.TreeBuilder):
    """Builds the tree of a part, and notes which namespace each prefix stands for."""

    def __init__(self):
        super().__init__()
        self.namespaces: dict[str, str] = {}

    def start_ns(self, prefix: str | None, uri: str) -> None:
        """Note the first meaning of a prefix: the root's, which comes first."""
        self.namespaces.setdefault(prefix or "", uri)


def _name(tag: str) -> str:
    """Give a name without its namespace."""
    return tag.rpartition("}")[2]


def _only(parent: Element, name: str) -> Element | None:
    """Find a child that there may be one of at most."""
    children = parent.findall(f"{{*}}{name}")
    if len(children) > 1:
        raise MeshError(f"{_name(parent.tag)} has {len(children)} elements {name!r}; one is valid")
    return children[0] if children else None


def _number(mesh: Element, name: str) -> int:
    """How many elements the lists of this name in a mesh hold."""
    return sum(len(entries) for entries in mesh.iterfind(f"{{*}}{name}"))


def _transform(element: Element) -> Float[np.ndarray, "4 4"]:
    """Column-vector matrix of a transform attribute, which lists the rows of a row-vector one."""
    matrix = np.eye(4)
    words = element.get("transform", "").split()
    if words:
        values = contents.to_numbers(words, "a transform: ")
        if len(values) != 12 or not np.isfinite(values).all():
            raise MeshError(f"a transform has {len(values)} numbers; twelve finite ones are valid")
        matrix[:3] = values.reshape(4, 3).T
    return matrix
