"""A map of known-free room as a mesh: the skin of all that has not been seen free."""

from pathlib import Path

from keepout.apps.unknown.map_file import load
from keepout.apps.unknown.skin import skin
from keepout.core.errors import MapError, MeshError
from keepout.core.geometry.mesh_files.contents import MeshContents


def read_keepmap(path: Path) -> MeshContents:
    """Read a `.keepmap` file as the skin of its obstacle, in metres and in the map's frame.

    Raises:
        MeshError: if it is damaged or no map file.

    """
    try:
        known = load(path)
    except MapError as refusal:
        raise MeshError(str(refusal).removeprefix(f"{path}: ")) from refusal
    vertices, faces = skin(known)
    broken = known.assumptions_broken
    said = (f"took the skin of a map of {known.name} after {known.views} views", *broken)
    return MeshContents(vertices, faces, said, "meter", broken)
