"""glTF: every triangle of the shown scene in its place, and a word on all that is not taken."""

import DracoPy
import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from truths.gltf_files import GltfFile

from keepout.errors import MeshError
from keepout.geometry import Target

CUBE = trimesh.creation.box(extents=(2.0, 2.0, 2.0))
POINTS, FACES = np.asarray(CUBE.vertices), np.asarray(CUBE.faces)


def soup(target):
    """Triangles as a sorted set of sorted corners: the surface, whatever the order."""
    corners = target.vertices[target.faces].round(6) + 0.0
    return sorted(tuple(sorted(map(tuple, triangle))) for triangle in corners.tolist())


def soup_of(triangles):
    return sorted(tuple(sorted(map(tuple, t))) for t in (np.asarray(triangles).round(6) + 0.0).tolist())


def refused(path):
    with pytest.raises(MeshError) as refusal:
        Target.load(path, units="m")
    assert "\n" not in str(refusal.value)
    assert path.name in str(refusal.value)
    return str(refusal.value)


@pytest.fixture(params=["glb", "gltf"])
def path(request, tmp_path):
    return tmp_path / f"model.{request.param}"


RING = np.array([(0.0, 0, 0), (2, 0, 0), (2, 1, 0), (1, 2, 0), (0, 1, 1)])


@pytest.mark.parametrize("indexed", [False, True])
def test_a_fan_is_its_triangles(path, indexed):
    file = GltfFile()
    file.primitive(RING, [0, 1, 2, 3, 4] if indexed else None, mode=6)
    target = Target.load(file.write(path))
    assert soup(target) == soup_of([RING[[0, i, i + 1]] for i in (1, 2, 3)])
    assert target.report.actions == ()


def test_a_fan_beside_a_mesh_is_not_lost(path):
    file = GltfFile()
    file.primitive(POINTS, FACES.reshape(-1))
    file.primitive(RING + 5.0, mode=6)
    assert Target.load(file.write(path)).report.triangles == 15


@pytest.mark.parametrize("indexed", [False, True])
def test_a_strip_is_its_triangles_and_all_face_one_way(path, indexed):
    strip = np.array([(0.0, 0, 0), (0, 1, 0), (1, 0, 0), (1, 1, 0), (2, 0, 0), (2, 1, 0)])
    file = GltfFile()
    file.primitive(strip, np.arange(6) if indexed else None, mode=5)
    target = Target.load(file.write(path))
    assert soup(target) == soup_of([strip[i : i + 3] for i in range(4)])
    a, b, c = np.moveaxis(target.vertices[target.faces], 1, 0)
    assert len(np.unique(np.sign(np.cross(b - a, c - a)[:, 2]))) == 1


def test_joints_between_strips_are_no_surface_and_are_said(path):
    # Two strips joined by repeated indices; the joints (2, 2, 3) ... would be segments between the strips.
    apart = np.array([(0.0, 0, 0), (0, 1, 0), (1, 0, 0), (8, 0, 0), (8, 1, 0), (9, 0, 0)])
    file = GltfFile()
    file.primitive(apart, [0, 1, 2, 2, 3, 3, 4, 5], mode=5)
    target = Target.load(file.write(path))
    assert soup(target) == soup_of([apart[:3], apart[3:]])
    assert any("left out 4 joints" in line for line in target.report.actions)


def rotation_from(quaternion):
    x, y, z, w = quaternion / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


@pytest.mark.parametrize("required", [False, True])
def test_instances_are_multiplied_out(path, required):
    rng = np.random.default_rng(5)
    shifts = np.array([(0.0, 0, 0), (5, 0, 0), (0, 7, 1)], dtype=np.float32)
    turns = rng.normal(size=(3, 4))
    turns = (turns / np.linalg.norm(turns, axis=1, keepdims=True)).astype(np.float32)
    scales = np.array([(1.0, 1, 1), (0.5, 2, 1), (1, 1, -1)], dtype=np.float32)
    file = GltfFile()
    file.primitive(POINTS, FACES.reshape(-1))
    instances = {
        "TRANSLATION": file.array(shifts, "f4"),
        "ROTATION": file.array(turns, "f4"),
        "SCALE": file.array(scales, "f4"),
    }
    file.tree["nodes"] = [
        {"children": [1], "translation": [0.0, 0.0, 20.0]},
        {"mesh": 0, "scale": [2.0, 1.0, 1.0], "extensions": {"EXT_mesh_gpu_instancing": {"attributes": instances}}},
    ]
    file.tree["extensionsUsed"] = ["EXT_mesh_gpu_instancing"]
    if required:
        file.tree["extensionsRequired"] = ["EXT_mesh_gpu_instancing"]
    target = Target.load(file.write(path))
    truth = [
        (POINTS * s @ rotation_from(q).T + t) * [2.0, 1.0, 1.0] + [0.0, 0.0, 20.0]
        for t, q, s in zip(shifts.astype(float), turns.astype(float), scales.astype(float))
    ]
    assert target.report.triangles == 36
    np.testing.assert_allclose(target.vertices, np.concatenate(truth), atol=1e-6)


def test_instances_that_disagree_are_refused(path):
    file = GltfFile()
    file.primitive(POINTS, FACES.reshape(-1))
    attributes = {"TRANSLATION": file.array(np.zeros((3, 3)), "f4"), "SCALE": file.array(np.ones((2, 3)), "f4")}
    file.tree["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": attributes}}
    assert "[2, 3] instances" in refused(file.write(path))


@pytest.mark.parametrize(
    "name", ["EXT_meshopt_compression", "KHR_gaussian_splatting", "VENDOR_anything", "AGI_articulations"]
)
def test_an_unknown_required_extension_is_refused_by_name(path, name):
    file = GltfFile()
    file.primitive(POINTS, FACES.reshape(-1))
    file.tree["extensionsUsed"] = file.tree["extensionsRequired"] = [name]
    said = refused(file.write(path))
    assert name in said
    assert "KHR_draco_mesh_compression" in said


@pytest.mark.parametrize(
    "name", ["KHR_materials_unlit", "KHR_texture_transform", "EXT_texture_webp", "KHR_lights_punctual"]
)
def test_a_required_extension_of_looks_is_harmless(path, name):
    file = GltfFile()
    file.primitive(POINTS, FACES.reshape(-1))
    file.tree["extensionsUsed"] = file.tree["extensionsRequired"] = [name]
    report = Target.load(file.write(path)).report
    assert (report.triangles, report.actions) == (12, ())


def test_an_unknown_extension_that_is_not_required_is_said(path):
    file = GltfFile()
    file.primitive(POINTS, FACES.reshape(-1), extensions={"VENDOR_inner": {}})
    file.tree["extensionsUsed"] = ["VENDOR_outer"]
    actions = Target.load(file.write(path)).report.actions
    assert [name for name in ("VENDOR_inner", "VENDOR_outer") if any(name in line for line in actions)] == [
        "VENDOR_inner",
        "VENDOR_outer",
    ]


def test_compressed_views_are_refused_even_where_they_are_not_required(path):
    file = GltfFile()
    file.primitive(POINTS, FACES.reshape(-1))
    file.tree["bufferViews"][0]["extensions"] = {"EXT_meshopt_compression": {}}
    assert "EXT_meshopt_compression" in refused(file.write(path))


@pytest.mark.parametrize(("mode", "segments"), [(1, 2), (2, 5), (3, 4)])
def test_lines_are_left_out_with_their_number(path, mode, segments):
    file = GltfFile()
    file.primitive(POINTS, FACES.reshape(-1))
    file.primitive(RING, mode=mode)
    report = Target.load(file.write(path)).report
    assert report.triangles == 12
    assert f"left out {segments} line segments" in report.actions
    assert "left out 1 line primitive" in report.actions


def test_points_beside_triangles_are_left_out_with_their_number(path):
    file = GltfFile()
    file.primitive(POINTS, FACES.reshape(-1))
    file.primitive(RING, mode=0)
    assert Target.load(file.write(path)).report.actions == ("left out 5 points",)


def test_points_alone_are_a_cloud(path):
    file = GltfFile()
    file.primitive(RING, [0, 2], mode=0)
    assert Target.load(file.write(path), thickness=0.1).report.points == 2


@pytest.mark.parametrize("mode", [-1, 7, 4.5, True, "4"])
def test_an_unknown_mode_is_refused(path, mode):
    file = GltfFile()
    file.primitive(POINTS, FACES.reshape(-1), mode=mode)
    assert "mode" in refused(file.write(path))


@pytest.mark.parametrize("mode", [4, 5, 6])
def test_an_index_out_of_range_is_refused(path, mode):
    file = GltfFile()
    file.primitive(POINTS, [0, 1, 8], mode=mode)
    said = refused(file.write(path))
    assert "index 8" in said
    assert "0 to 7" in said


def test_corners_that_three_does_not_divide_are_refused(path):
    file = GltfFile()
    file.primitive(POINTS, FACES.reshape(-1)[:-1])
    assert "35 corners" in refused(file.write(path))


def test_skins_and_weighted_morph_targets_are_refused(path):
    file = GltfFile()
    primitive = file.primitive(POINTS, FACES.reshape(-1))
    primitive["targets"] = [{"POSITION": file.array(POINTS, "f4")}]
    resting = Target.load(file.write(path)).report
    assert any("1 morph target" in line for line in resting.actions)
    file.tree["meshes"][0]["weights"] = [0.5]
    assert "morph" in refused(file.write(path))
    file.tree["nodes"][0]["weights"] = [0.0]
    assert Target.load(file.write(path)).sha256
    file.tree["nodes"][0]["skin"] = 0
    assert "skin" in refused(file.write(path))


def test_a_mesh_with_a_camera_and_children_keeps_its_place(path):
    file = GltfFile()
    file.primitive(POINTS, FACES.reshape(-1))
    file.tree["cameras"] = [{"type": "perspective", "perspective": {"yfov": 1.0, "znear": 0.1}}]
    file.tree["nodes"] = [
        {"mesh": 0, "camera": 0, "translation": [9.0, 0, 0], "children": [1]},
        {"mesh": 0, "scale": [1, 1, 3]},
    ]
    report = Target.load(file.write(path)).report
    assert report.triangles == 24
    assert report.lower == pytest.approx((8.0, -1.0, -3.0))


def test_sparse_positions_are_read(path):
    moved = POINTS.copy()
    moved[3] *= 4.0
    file = GltfFile()
    primitive = file.primitive(POINTS, FACES.reshape(-1))
    file.tree["accessors"][primitive["attributes"]["POSITION"]]["sparse"] = {
        "count": 1,
        "indices": {"bufferView": file.view(np.array([3], dtype="<u2").tobytes()), "componentType": 5123},
        "values": {"bufferView": file.view(moved[3:4].astype("<f4").tobytes())},
    }
    assert soup(Target.load(file.write(path))) == soup_of(moved[FACES])


@pytest.mark.parametrize("normalized", [False, True])
def test_quantized_positions(path, normalized):
    file = GltfFile()
    whole = (POINTS * 100).astype(np.int64)
    position = file.array(np.column_stack([whole, np.zeros(8)])[:, :3], "i2", normalized=normalized)
    file.tree["meshes"][0]["primitives"] = [
        {"attributes": {"POSITION": position}, "indices": file.array(FACES.reshape(-1), "u1")}
    ]
    file.tree["nodes"][0]["scale"] = [327.67, 327.67, 327.67] if normalized else [0.01, 0.01, 0.01]
    assert "componentType" in refused(file.write(path))
    file.tree["extensionsUsed"] = file.tree["extensionsRequired"] = ["KHR_mesh_quantization"]
    assert soup(Target.load(file.write(path))) == soup_of(POINTS[FACES])


def test_strided_positions(path):
    file = GltfFile()
    mixed = np.column_stack([POINTS, np.full((8, 3), 7.0)]).astype("<f4")
    primitive = file.primitive(POINTS, FACES.reshape(-1))
    accessor = file.tree["accessors"][primitive["attributes"]["POSITION"]]
    accessor["bufferView"] = file.view(mixed.tobytes())
    file.tree["bufferViews"][accessor["bufferView"]]["byteStride"] = 24
    assert soup(Target.load(file.write(path))) == soup_of(POINTS[FACES])


def test_what_the_scene_does_not_show_is_said(path):
    file = GltfFile()
    file.primitive(POINTS, FACES.reshape(-1))
    file.tree["meshes"].append(file.tree["meshes"][0])
    file.tree["nodes"].append({"mesh": 0})
    assert Target.load(file.write(path)).report.actions == (
        "left out 1 node with a mesh, not in the shown scene",
        "left out 1 mesh, placed by no node",
    )
    del file.tree["scenes"]
    assert "no scene" in refused(file.write(path))


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (lambda tree: tree["nodes"][0].update(mesh=-1), "meshes index -1"),
        (lambda tree: tree["nodes"][0].update(mesh=1), "0 to 0"),
        (lambda tree: tree["nodes"][0].update(children=[0]), "ancestor"),
        (lambda tree: tree["nodes"][0].update(matrix=[1.0] * 16), "last row"),
        (lambda tree: tree["nodes"][0].update(translation=[1, 2]), "translation"),
        (lambda tree: tree["nodes"][0].update(rotation=[0, 0, 0, 0]), "quaternion"),
        (lambda tree: tree["accessors"][0].update(count=9), "ends at byte"),
        (lambda tree: tree["accessors"][0].pop("bufferView"), "missing"),
        (lambda tree: tree["bufferViews"][0].update(byteLength=10**6), "ends at byte"),
        (lambda tree: tree["meshes"][0]["primitives"][0]["attributes"].clear(), "POSITION"),
        (lambda tree: tree["asset"].update(version="1.0"), "version"),
        (lambda tree: tree.update(nodes="none"), "nodes"),
        (lambda tree: tree.update(extensionsRequired="one"), "array"),
    ],
)
def test_a_wrong_tree_is_refused(path, change, word):
    file = GltfFile()
    file.primitive(POINTS, FACES.reshape(-1))
    change(file.tree)
    assert word in refused(file.write(path))


def test_a_buffer_cut_short_or_missing_is_refused(tmp_path):
    file = GltfFile()
    file.primitive(POINTS, FACES.reshape(-1))
    path = file.write(tmp_path / "model.gltf")
    numbers = tmp_path / "its numbers.bin"
    whole = numbers.read_bytes()
    numbers.write_bytes(whole[:-1])
    assert f"declares {len(whole)} bytes and has {len(whole) - 1}" in refused(path)
    numbers.unlink()
    assert "its%20numbers.bin" in refused(path)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (lambda primitive, tree: None, ""),
        (lambda primitive, tree: tree["accessors"][0].update(count=9), "declares 9 positions and has 8"),
        (lambda primitive, tree: tree["accessors"][1].update(count=33), "declares 33 corners and has 36"),
        (lambda primitive, tree: primitive.update(mode=6), "no triangles"),
        (lambda primitive, tree: primitive["extensions"].popitem(), "missing"),
    ],
)
def test_compressed_primitives_are_as_many_as_declared(path, change, word):
    file = GltfFile()
    packed = file.view(DracoPy.encode(POINTS.astype(np.float32), faces=FACES.astype(np.uint32)))
    file.tree["accessors"] = [
        {"componentType": 5126, "count": 8, "type": "VEC3"},
        {"componentType": 5125, "count": 36, "type": "SCALAR"},
    ]
    draco = {"KHR_draco_mesh_compression": {"bufferView": packed, "attributes": {"POSITION": 0}}}
    primitive = {"attributes": {"POSITION": 0}, "indices": 1, "extensions": draco}
    file.tree["meshes"][0]["primitives"].append(primitive)
    change(primitive, file.tree)
    if word:
        assert word in refused(file.write(path))
    else:
        target = Target.load(file.write(path))
        assert target.report.triangles == 12
        assert target.report.extents == pytest.approx((2.0, 2.0, 2.0), abs=1e-3)


@given(st.integers(0, 2**32 - 1), st.integers(1, 9))
def test_scenes_agree_with_another_reader(tmp_path_factory, seed, count):
    """Random trees of moved, turned and stretched boxes, written and read again by trimesh."""
    rng = np.random.default_rng(seed)
    scene = trimesh.Scene()
    for number in range(count):
        matrix = trimesh.transformations.random_rotation_matrix(rng.random(3))
        matrix[:3, :3] *= rng.uniform(0.5, 2.0, size=3) * rng.choice([-1.0, 1.0])
        matrix[:3, 3] = rng.uniform(-5.0, 5.0, size=3)
        box = trimesh.creation.box(extents=rng.uniform(0.5, 2.0, size=3))
        parent = None if number == 0 else f"part{rng.integers(number)}"
        scene.add_geometry(box, node_name=f"part{number}", parent_node_name=parent, transform=matrix)
    path = tmp_path_factory.mktemp("scenes") / "scene.glb"
    scene.export(path)
    again = trimesh.load_scene(path, process=False).dump()
    truth = np.concatenate([part.triangles for part in again])
    target = Target.load(path, units="m")
    np.testing.assert_allclose(target.vertices[target.faces], truth, atol=1e-12 * np.abs(truth).max())
