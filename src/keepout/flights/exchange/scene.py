"""Mesh, envelope and path as binary glTF (GLB), in metres and in the body frame, as the scene's `extras` say.

The envelope is the surface {f̃ = R + e_h}: wherever the exact distance is at most the chaser's radius R, f̃ is not
above that level, so the centre of a chaser outside it touches nothing. It is cut into triangles to be looked at, at a
spacing that `extras` tell; the proof is of the field, not of the triangles. Coordinates are float32, and the body
frame's axes stay what they are: glTF's viewers show its y axis upwards.
"""

from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from keepout.core.errors import ExchangeError
from keepout.core.fields.model import Certificate, FieldModel
from keepout.core.geometry.target import Target
from keepout.core.measures.surface import default_spacing, extract_surface, steepest_slope
from keepout.core.progress import Progress, silent
from keepout.core.whole_file import write_whole

_COARSENESS = 3.0
"""Of the envelope, in units of the spacing with which surfaces are measured: a tenth of the triangles."""


def export_scene(
    target: Target,
    path: Path,
    *,
    model: FieldModel,
    certificate: Certificate | None,
    way: Float[np.ndarray, "n 3"] | None = None,
    told: dict[str, Any] | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Write a GLB file; its summary says what stands in it.

    Args:
        target: the mesh.
        path: the file.
        model: the field whose envelope is drawn.
        certificate: gives the level of the envelope; the zero level is drawn where there is none.
        way: positions of the chaser's centre in the body frame, m.
        told: further entries of the scene's extras.
        progress: called as the envelope is cut.

    Raises:
        ExchangeError: the file cannot be written.

    """
    level = 0.0 if certificate is None else certificate.chaser_radius + certificate.error_bound
    steepest = steepest_slope(model.field, target.distance) if certificate is None else certificate.gradient_bound
    spacing = _COARSENESS * default_spacing(target.distance)
    surface = extract_surface(
        model.field, target.distance, level, steepest=steepest, spacing=spacing, progress=progress
    )
    scene = trimesh.Scene()
    proper = target.faces[~(target.faces == target.faces[:, :1]).all(axis=1)]
    if len(proper):
        _add(scene, "target", target.vertices, proper, PBRMaterial(baseColorFactor=[190, 195, 205, 255]))
    else:  # a point cloud
        scene.add_geometry(trimesh.PointCloud(target.vertices), geom_name="target", node_name="target")
    glass = PBRMaterial(baseColorFactor=[60, 130, 220, 80], alphaMode="BLEND", doubleSided=True)
    _add(scene, "envelope", surface.vertices, surface.faces, glass)
    if way is not None:
        scene.add_geometry(trimesh.load_path(way), geom_name="path", node_name="path")
    extras: dict[str, Any] = {
        "format": "keepout-scene 1",
        "units": "m",
        "frame": "the target's body frame; its axes are the file's axes",
        "target_name": target.name,
        "target_sha256": target.sha256,
        "field_sha256": model.sha256,
        "envelope_level_m": level,
        "envelope_spacing_m": surface.spacing,
        "envelope_kind": "zero level" if certificate is None else certificate.kind,
        **({} if certificate is None else {"chaser_radius_m": certificate.chaser_radius}),
        **(told or {}),
    }
    scene.metadata["keepout"] = extras
    content = scene.export(file_type="glb")
    assert isinstance(content, bytes)
    write_whole(path, content, refusal=ExchangeError)
    drawn = {"target_triangles": len(proper), "envelope_triangles": len(surface.faces)}
    return {**extras, **drawn, "path_points": 0 if way is None else len(way)}


def _add(scene: trimesh.Scene, name: str, vertices: np.ndarray, faces: np.ndarray, material: PBRMaterial) -> None:
    mesh = trimesh.Trimesh(vertices, faces, process=False, visual=TextureVisuals(material=material))
    scene.add_geometry(mesh, geom_name=name, node_name=name)
