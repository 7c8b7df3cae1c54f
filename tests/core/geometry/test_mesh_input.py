"""Meshes and point clouds as users bring them: one surface whatever the format, in metres and in body axes."""

import numpy as np
import pytest
import trimesh
from truths.small_files import refused

from keepout.core.errors import MeshError
from keepout.core.geometry.target import Target


def cube(size=2.0):
    return trimesh.creation.box(extents=(size, size, size))


@pytest.fixture
def stl(tmp_path):
    cube().export(tmp_path / "cube.stl")
    return tmp_path / "cube.stl"


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


@pytest.mark.parametrize(("units", "metres"), [("m", 1.0), ("cm", 0.01), ("mm", 0.001), ("in", 0.0254), ("ft", 0.3048)])
def test_units_and_the_body_frame(stl, units, metres):
    turn = [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    for told in ({"units": units}, {"scale": metres}):
        report = Target.load(stl, rotation=turn, origin=(5.0, 0.0, 0.0), **told).report
        assert report.lower == pytest.approx((-metres, 5.0 - metres, -metres))
        assert report.upper == pytest.approx((metres, 5.0 + metres, metres))


@pytest.mark.parametrize("size", [0.4, 2000.0])
def test_implausible_size_is_questioned(tmp_path, size):
    path = tmp_path / "cube.stl"
    cube(size).export(path)
    refused(path, "units")
    assert Target.load(path, units="m").report.extents[0] == pytest.approx(size)


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        ({"units": "km"}, "km"),
        ({"scale": -1.0}, "scale"),
        ({"scale": float("nan")}, "scale"),
        ({"units": "m", "scale": 1.0}, "one of them"),
        ({"thickness": 0.1}, "thickness"),
        ({"parameters": {"wing_angle": 0.1}}, "parameters"),
        ({"rotation": np.diag([1.0, 1.0, -1.0])}, "rotation"),
        ({"origin": (0.0, np.nan, 0.0)}, "origin"),
        ({"origin": [1e17, 0.0, 0.0]}, r"origin.*1e\+17"),
    ],
)
def test_bad_arguments_are_refused(stl, arguments, word):
    with pytest.raises(MeshError, match=word):
        Target.load(stl, **arguments)


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
    refused(path, "thickness")
    refused(path, "thickness", thickness=0.0)
    target = Target.load(path, thickness=0.2)
    queries = np.random.default_rng(1).uniform(-3.0, 3.0, size=(200, 3))
    to_centre = np.linalg.norm(queries[:, None] - points, axis=2)
    truth = np.maximum(to_centre.min(axis=1) - 0.1, 0.0)
    np.testing.assert_allclose(target.distance.distance(queries), truth, atol=1e-6)
    distance, gradient = target.distance.distance_and_gradient(queries)
    np.testing.assert_allclose(np.linalg.norm(gradient, axis=1), distance > 0.0, atol=1e-12)
    _, closest, _ = target.distance.closest(queries)
    np.testing.assert_allclose(np.linalg.norm(queries - closest, axis=1), distance, atol=1e-12)


def test_hash_follows_geometry(stl):
    one, again, other = Target.load(stl), Target.load(stl), Target.load(stl, scale=1.0000001)
    assert one.sha256 == again.sha256
    assert one.sha256 != other.sha256
