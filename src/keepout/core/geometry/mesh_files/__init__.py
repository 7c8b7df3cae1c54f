"""One strict reader for each mesh format: what a file declares is there whole, or the file is refused.

Nothing is left out without a line that says so with its number; an index points at a vertex or the file is refused.
"""

from collections.abc import Callable
from pathlib import Path

from keepout.core.geometry.mesh_files.contents import MeshContents
from keepout.core.geometry.mesh_files.gltf import read_gltf
from keepout.core.geometry.mesh_files.obj_off_stl import read_obj, read_off, read_stl
from keepout.core.geometry.mesh_files.ply import read_ply
from keepout.core.geometry.mesh_files.three_mf import read_three_mf
from keepout.core.plug_ins import load, names

READERS: dict[str, Callable[[Path], MeshContents]] = {
    ".glb": read_gltf,
    ".gltf": read_gltf,
    ".obj": read_obj,
    ".stl": read_stl,
    ".ply": read_ply,
    ".off": read_off,
    ".3mf": read_three_mf,
    **{suffix: lambda path, suffix=suffix: load("mesh_readers", suffix)(path) for suffix in names("mesh_readers")},
}
"""By file suffix. Each raises `MeshError` with the reason alone; the caller names the file."""
