"""Meshes and point clouds as users bring them, good and bad."""

import json
import struct

import DracoPy
import numpy as np
import pytest
import trimesh

from keepout.errors import MeshError
from keepout.geometry import Target


def cube(size=2.0):
    return trimesh.creation.box(extents=(size, size, size))


@pytest.mark.parametrize("suffix", ["glb", "gltf", "obj", "stl", "ply", "off", "3mf"])
def test_every_format_gives_the_same_distances(tmp_path, suffix):
    path = tmp_path / f"cube.{suffix}"
    if suffix == "gltf":
        for name, content in trimesh.Scene(cube()).export(file_type="gltf").items():
            (tmp_path / name).write_bytes(content)
        path = tmp_path / "model.gltf"
    else:
        cube().export(path)
    target = Target.load(path, scale=1.0)  # this 3MF's numbers are metres, and it declares none: millimetres
    assert target.report.extents == pytest.approx((2.0, 2.0, 2.0))
    assert target.report.watertight
    assert target.distance.distance(np.array([[3.0, 0.0, 0.0], [2.0, 2.0, 0.0]])) == pytest.approx([2.0, 2**0.5])


def test_draco_compressed_glb(tmp_path):
    mesh = cube()
    data = DracoPy.encode(np.asarray(mesh.vertices, dtype=np.float32), faces=np.asarray(mesh.faces, dtype=np.uint32))
    data += b"\0" * (-len(data) % 4)
    position = {"componentType": 5126, "count": 8, "type": "VEC3", "min": [-1, -1, -1], "max": [1, 1, 1]}
    tree = {
        "asset": {"version": "2.0"},
        "extensionsUsed": ["KHR_draco_mesh_compression"],
        "extensionsRequired": ["KHR_draco_mesh_compression"],
        "buffers": [{"byteLength": len(data)}],
        "bufferViews": [{"buffer": 0, "byteLength": len(data)}],
        "accessors": [position, {"componentType": 5125, "count": 36, "type": "SCALAR"}],
        "meshes": [
            {
                "primitives": [
                    {
                        "attributes": {"POSITION": 0},
                        "indices": 1,
                        "extensions": {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {"POSITION": 0}}},
                    }
                ]
            }
        ],
        "nodes": [{"mesh": 0, "translation": [5.0, 0.0, 0.0]}],
        "scenes": [{"nodes": [0]}],
        "scene": 0,
    }
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(data), 0x004E4942) + data
    path = tmp_path / "draco.glb"
    path.write_bytes(struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks)
    report = Target.load(path).report
    assert report.triangles == 12
    assert report.lower == pytest.approx((4.0, -1.0, -1.0), abs=1e-3)


def test_scene_transforms_are_applied(tmp_path):
    scene = trimesh.Scene()
    scene.add_geometry(cube(1.0), transform=trimesh.transformations.translation_matrix((3.0, 0.0, 0.0)))
    scene.add_geometry(cube(1.0), transform=trimesh.transformations.rotation_matrix(np.pi / 4, (0, 0, 1)))
    scene.export(tmp_path / "scene.glb")
    target = Target.load(tmp_path / "scene.glb")
    assert target.report.parts == 2
    assert target.report.upper[0] == pytest.approx(3.5)
    assert target.report.lower[0] == pytest.approx(-(0.5**0.5), abs=1e-6)


@pytest.mark.parametrize(("units", "metres"), [("m", 1.0), ("cm", 0.01), ("mm", 0.001), ("in", 0.0254), ("ft", 0.3048)])
def test_units(tmp_path, units, metres):
    cube(2.0).export(tmp_path / "cube.stl")
    assert Target.load(tmp_path / "cube.stl", units=units).report.extents[0] == pytest.approx(2.0 * metres)
    assert Target.load(tmp_path / "cube.stl", scale=metres).report.extents[0] == pytest.approx(2.0 * metres)


@pytest.mark.parametrize("size", [0.4, 2000.0])
def test_implausible_size_is_questioned(tmp_path, size):
    cube(size).export(tmp_path / "cube.stl")
    with pytest.raises(MeshError, match="units"):
        Target.load(tmp_path / "cube.stl")
    assert Target.load(tmp_path / "cube.stl", units="m").report.extents[0] == pytest.approx(size)


def test_body_frame(tmp_path):
    cube(2.0).export(tmp_path / "cube.stl")
    turn = [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    target = Target.load(tmp_path / "cube.stl", rotation=turn, origin=(5.0, 0.0, 0.0))
    assert target.report.lower == pytest.approx((-1.0, 4.0, -1.0))
    with pytest.raises(MeshError, match="rotation"):
        Target.load(tmp_path / "cube.stl", rotation=np.diag([1.0, 1.0, -1.0]))
    with pytest.raises(MeshError, match="origin"):
        Target.load(tmp_path / "cube.stl", origin=(0.0, np.nan, 0.0))


def test_report_counts(tmp_path):
    mesh = cube()
    far = cube(0.5)
    far.apply_translation((60.0, 0.0, 0.0))
    vertices = np.concatenate([mesh.vertices, far.vertices])
    # One face left out, one repeated twice, one stray part, and one triangle without area.
    faces = np.concatenate([mesh.faces[1:], mesh.faces[3:5], far.faces + 8, [[0, 1, 0]]])
    trimesh.Trimesh(vertices, faces, process=False).export(tmp_path / "odd.ply")
    report = Target.load(tmp_path / "odd.ply").report
    assert (report.parts, report.open_edges, report.non_manifold_edges) == (2, 3, 0)
    assert (report.degenerate_faces, report.stray_parts) == (1, 1)
    assert any("2 duplicate" in line for line in report.actions)
    assert any("drop_stray" in line for line in report.warnings)
    kept = Target.load(tmp_path / "odd.ply", drop_stray=True).report
    assert (kept.parts, kept.stray_parts) == (1, 0)
    assert kept.extents == pytest.approx((2.0, 2.0, 2.0))


@pytest.mark.parametrize("suffix", ["ply", "xyz", "npy"])
def test_point_cloud_is_balls(tmp_path, suffix):
    points = np.random.default_rng(0).uniform(-2.0, 2.0, size=(500, 3))
    path = tmp_path / f"cloud.{suffix}"
    if suffix == "npy":
        np.save(path, points)
    elif suffix == "xyz":
        np.savetxt(path, points)
    else:
        trimesh.PointCloud(points).export(path)
    with pytest.raises(MeshError, match="thickness"):
        Target.load(path)
    target = Target.load(path, thickness=0.2)
    queries = np.random.default_rng(1).uniform(-3.0, 3.0, size=(200, 3))
    to_centre = np.linalg.norm(queries[:, None] - points, axis=2)
    truth = np.maximum(to_centre.min(axis=1) - 0.1, 0.0)
    np.testing.assert_allclose(target.distance.distance(queries), truth, atol=1e-6)
    distance, gradient = target.distance.distance_and_gradient(queries)
    np.testing.assert_allclose(np.linalg.norm(gradient, axis=1), distance > 0.0, atol=1e-12)
    _, closest, _ = target.distance.closest(queries)
    np.testing.assert_allclose(np.linalg.norm(queries - closest, axis=1), distance, atol=1e-12)


def test_hash_follows_geometry(tmp_path):
    cube().export(tmp_path / "cube.stl")
    one = Target.load(tmp_path / "cube.stl")
    again = Target.load(tmp_path / "cube.stl")
    other = Target.load(tmp_path / "cube.stl", scale=1.0000001)
    assert one.sha256 == again.sha256
    assert one.sha256 != other.sha256
    assert len(one.sha256) == 64


def write_bad(tmp_path, kind):
    path = tmp_path / f"{kind}.glb"
    if kind == "empty":
        path.write_bytes(b"")
    elif kind == "text":
        path.write_text("this is no mesh\n")
    elif kind == "truncated":
        whole = cube().export(file_type="glb")
        path.write_bytes(whole[: len(whole) // 2])
    elif kind == "no_vertices":
        path = tmp_path / "none.obj"
        path.write_text("# nothing\no part\n")
    elif kind in ("nan", "infinite"):
        path = tmp_path / "bad.off"
        word = "nan" if kind == "nan" else "inf"
        path.write_text(f"OFF\n4 2 0\n0 0 0\n1 0 0\n0 1 0\n{word} 1 1\n3 0 1 2\n3 1 2 3\n")
    elif kind == "no_area":
        path = tmp_path / "flat.off"
        path.write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n2 0 0\n3 0 1 2\n")
    elif kind == "directory":
        path.mkdir()
    elif kind == "suffix":
        path = tmp_path / "mesh.step"
        path.write_text("ISO-10303-21;")
    elif kind == "bad_points":
        path = tmp_path / "points.xyz"
        path.write_text("1 2\n3 4\n")
    elif kind == "pickle":
        path = tmp_path / "points.npy"
        np.save(path, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    return path


@pytest.mark.parametrize(
    ("kind", "word"),
    [
        ("empty", "empty"),
        ("text", "not readable"),
        ("truncated", "not readable"),
        ("no_vertices", "no triangles|not readable"),
        ("nan", "not finite"),
        ("infinite", "not finite"),
        ("no_area", "area"),
        ("directory", "directory"),
        ("missing", "no such file"),
        ("suffix", "suffix"),
        ("bad_points", "three numbers"),
        ("pickle", "not readable"),
    ],
)
def test_bad_files_are_refused_in_one_line(tmp_path, kind, word):
    with pytest.raises(MeshError, match=word) as refusal:
        Target.load(write_bad(tmp_path, kind))
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        ({"units": "km"}, "km"),
        ({"scale": -1.0}, "scale"),
        ({"scale": float("nan")}, "scale"),
        ({"units": "m", "scale": 1.0}, "one of them"),
        ({"thickness": 0.1}, "thickness"),
        ({"parameters": {"wing_angle": 0.1}}, "parameters"),
    ],
)
def test_bad_arguments_are_refused(tmp_path, arguments, word):
    cube().export(tmp_path / "cube.stl")
    with pytest.raises(MeshError, match=word):
        Target.load(tmp_path / "cube.stl", **arguments)


def test_cloud_thickness_must_be_positive(tmp_path):
    np.save(tmp_path / "cloud.npy", np.eye(3))
    with pytest.raises(MeshError, match="thickness"):
        Target.load(tmp_path / "cloud.npy", thickness=0.0)


def test_a_single_triangle_is_a_sheet(tmp_path):
    (tmp_path / "one.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    target = Target.load(tmp_path / "one.off")
    assert target.report.open_edges == 3
    assert target.distance.distance(np.array([[0.2, 0.2, 0.5]])) == pytest.approx([0.5])


@pytest.mark.parametrize("far", ["1e308", "1e200", "2e6"])
def test_endless_extents_are_refused_in_any_units(tmp_path, far):
    path = tmp_path / "endless.off"
    path.write_text(f"OFF\n4 2 0\n-{far} 0 0\n{far} 0 0\n0 {far} 0\n0 0 {far}\n3 0 1 2\n3 0 1 3\n")
    with pytest.raises(MeshError, match="largest extent"):
        Target.load(path, units="m")


@pytest.mark.slow
def test_a_million_triangles(tmp_path):
    mesh = trimesh.creation.icosphere(subdivisions=8)
    assert len(mesh.faces) > 1_000_000
    mesh.export(tmp_path / "large.stl")
    target = Target.load(tmp_path / "large.stl")
    points = np.random.default_rng(0).normal(size=(10_000, 3)) * 2.0
    truth = np.abs(np.linalg.norm(points, axis=1) - 1.0)
    np.testing.assert_allclose(target.distance.distance(points), truth, atol=1e-5)
