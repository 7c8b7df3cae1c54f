"""3MF: the build's items, with their components and their placements."""

import zipfile
from collections import Counter
from pathlib import Path

import numpy as np
from jaxtyping import Float
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]  (lxml has no types)

from keepout.errors import MeshError
from keepout.geometry.mesh_files.contents import (
    MeshContents,
    check_indices,
    left_out,
    to_indices,
    to_numbers,
)

_MODEL = "http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"
_CORE = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
_READ = {
    _CORE: "core",
    "http://schemas.microsoft.com/3dmanufacturing/production/2015/06": "production",
    "http://schemas.microsoft.com/3dmanufacturing/material/2015/02": "material",
    "http://schemas.microsoft.com/3dmanufacturing/core/2021/07": "triangle sets",
}
_PLAIN = frozenset(("vertices", "triangles", "trianglesets", "metadatagroup", "metadata", "mesh", "components"))
_MOST_TRIANGLES = 50_000_000

_Key = tuple[str, str]
"""A model part's name and an object's id in it."""


def read_three_mf(path: Path) -> MeshContents:
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
        package = _Package(archive)
        return package.contents()


class _Package:
    """The model parts of an archive, read as they are asked for."""

    def __init__(self, archive: zipfile.ZipFile):
        self._archive = archive
        names = [name.lower().strip("/") for name in archive.namelist()]
        twice = [name for name, number in Counter(names).items() if number > 1]
        if twice:
            raise MeshError(f"its archive has the part {twice[0][:60]!r} {names.count(twice[0])} times; once is valid")
        self._names = dict(zip(names, archive.namelist()))
        self._objects: dict[_Key, etree._Element] = {}
        self._read: set[str] = set()
        self._meshes: dict[_Key, tuple[np.ndarray, np.ndarray]] = {}
        self._vertices: list[np.ndarray] = [np.zeros((0, 3))]
        self._faces: list[np.ndarray] = [np.zeros((0, 3), dtype=np.int64)]
        self._count = 0
        self._left_out: Counter[str] = Counter()

    def contents(self) -> MeshContents:
        """Triangles of all build items."""
        main = self._main_part()
        root = self._part(main)
        build = _only(root, "build")
        if build is None:
            raise MeshError("its model has no build, so nothing says what belongs to it")
        placed: set[_Key] = set()
        for item in build.iterfind("{*}item"):
            self._place(self._key(item, main), _transform(item), (), placed)
        unplaced = sum(entry.find("{*}mesh") is not None for key, entry in self._objects.items() if key not in placed)
        self._left_out["mesh object, not in the build"] = unplaced
        actions = []
        for noun, number in self._left_out.items():
            actions += left_out(number, noun)
        vertices, faces = np.concatenate(self._vertices), np.concatenate(self._faces)
        # Points without triangles are no point cloud here: the format has none.
        if not len(faces):
            vertices = np.zeros((0, 3))
        return MeshContents(vertices, faces, tuple(actions), root.get("unit", "millimeter"))

    def _main_part(self) -> str:
        if "_rels/.rels" in self._names:
            for relation in _parse(self._archive.read(self._names["_rels/.rels"])):
                if relation.get("Type") == _MODEL:
                    return relation.get("Target", "").lower().strip("/")
        return "3d/3dmodel.model"

    def _part(self, name: str) -> etree._Element:
        """Parse one model part and note its objects."""
        if name not in self._names:
            raise MeshError(f"its archive has no part {name[:60]!r}")
        root = _parse(self._archive.read(self._names[name]))
        for prefix in root.get("requiredextensions", "").split():
            namespace = root.nsmap.get(prefix, prefix)
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

    def _key(self, reference: etree._Element, part: str) -> _Key:
        """Object that an item or a component refers to, in another part where it gives a path."""
        path = next((value for key, value in reference.attrib.items() if etree.QName(key).localname == "path"), None)
        part = part if path is None else str(path).lower().strip("/")
        if part not in self._read:
            self._part(part)
        key = (part, reference.get("objectid", ""))
        if key not in self._objects:
            raise MeshError(f"it refers to the object {key[1][:40]!r}, which is not there")
        return key

    def _place(self, key: _Key, matrix: Float[np.ndarray, "4 4"], above: tuple[_Key, ...], placed: set[_Key]) -> None:
        if key in above:
            raise MeshError(f"the object {key[1]!r} is a component of itself")
        placed.add(key)
        entry = self._objects[key]
        for child in entry:
            name = etree.QName(child).localname if isinstance(child.tag, str) else "metadata"
            if name not in _PLAIN:
                self._left_out[f"element, '{name[:40]}' of an object"] += 1
        if _only(entry, "mesh") is not None:
            if key not in self._meshes:
                self._meshes[key] = self._mesh(entry)
            vertices, faces = self._meshes[key]
            with np.errstate(invalid="ignore", over="ignore"):  # what is not finite is refused where a triangle uses it
                self._vertices.append(vertices @ matrix[:3, :3].T + matrix[:3, 3])
            self._faces.append(faces + self._count)
            self._count += len(vertices)
            if sum(map(len, self._faces)) > _MOST_TRIANGLES:
                raise MeshError(f"its components make more than {_MOST_TRIANGLES} triangles")
        for component in entry.iterfind("{*}components/{*}component"):
            self._place(self._key(component, key[0]), matrix @ _transform(component), (*above, key), placed)

    def _mesh(self, entry: etree._Element) -> tuple[np.ndarray, np.ndarray]:
        mesh = entry.find("{*}mesh")
        assert mesh is not None
        for child in mesh:
            name = etree.QName(child).localname if isinstance(child.tag, str) else "metadata"
            if name == "beamlattice":
                self._left_out["lattice beam"] += sum(1 for _ in child.iter("{*}beam"))
            elif name not in _PLAIN:
                self._left_out[f"element, '{name[:40]}' of a mesh"] += 1
        for child in mesh.iterfind("{*}triangles/*"):
            name = etree.QName(child).localname
            if name != "triangle":
                self._left_out[f"element, '{name[:40]}' among triangles"] += 1
        words = [v.get(axis, "") for v in mesh.iterfind("{*}vertices/{*}vertex") for axis in "xyz"]
        corners = [t.get(v, "") for t in mesh.iterfind("{*}triangles/{*}triangle") for v in ("v1", "v2", "v3")]
        name = f"the object {entry.get('id', '')[:40]!r}"
        vertices = to_numbers(words, f"{name}: ").reshape(-1, 3)
        try:
            faces = np.array(to_indices(corners, f"{name}: "), dtype=np.int64).reshape(-1, 3)
        except OverflowError as cause:
            raise MeshError(f"{name}: {cause}") from None
        check_indices(faces, len(vertices), name)
        return vertices, faces


def _only(parent: etree._Element, name: str) -> etree._Element | None:
    """Find a child that there may be one of at most."""
    children = parent.findall(f"{{*}}{name}")
    if len(children) > 1:
        raise MeshError(f"{etree.QName(parent).localname} has {len(children)} elements {name!r}; one is valid")
    return children[0] if children else None


def _parse(data: bytes) -> etree._Element:
    parser = etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False, huge_tree=True)
    try:
        return etree.fromstring(data, parser)
    except etree.XMLSyntaxError as cause:
        raise MeshError(f"its XML is damaged: {cause}") from None


def _transform(element: etree._Element) -> Float[np.ndarray, "4 4"]:
    """Column-vector matrix of a transform attribute, which lists the rows of a row-vector one."""
    matrix = np.eye(4)
    words = element.get("transform", "").split()
    if words:
        values = to_numbers(words, "a transform: ")
        if len(values) != 12 or not np.isfinite(values).all():
            raise MeshError(f"a transform has {len(values)} numbers; twelve finite ones are valid")
        matrix[:3] = values.reshape(4, 3).T
    return matrix
