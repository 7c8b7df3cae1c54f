"""glTF: every triangle of the shown scene in its place, and a word on all that is not taken."""

import DracoPy
import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from truths.gltf_files import GltfFile
from truths.small_files import refused, soup

from keepout.core.geometry.target import Target

CUBE = trimesh.creation.box(extents=(2.0, 2.0, 2.0))
POINTS, FACES = np.asarray(CUBE.vertices), np.asarray(CUBE.faces)
RING = np.array([(0.0, 0, 0), (2, 0, 0), (2, 1, 0), (1, 2, 0), (0, 1, 1)])
BAND = np.array([(0.0, 0, 0), (0, 1, 0), (1, 0, 0), (1, 1, 0), (2, 0, 0), (2, 1, 0)])


def cube(**entries):
    """A file of one cube."""
    file = GltfFile()
    file.primitive(POINTS, FACES.reshape(-1), **entries)
    return file


@pytest.fixture(params=["glb", "gltf"])
def path(request, tmp_path):
    return tmp_path / f"model.{request.param}"


@pytest.fixture
def glb(tmp_path):
    return tmp_path / "model.glb"


FAN = [RING[[0, i, i + 1]] for i in (1, 2, 3)]
STRIP = [BAND[i : i + 3] for i in range(4)]
# Two strips joined by repeated indices; the joints (2, 2, 3) ... would be segments between the strips.
APART = np.array([(0.0, 0, 0), (0, 1, 0), (1, 0, 0), (8, 0, 0), (8, 1, 0), (9, 0, 0)])
JOINED = [0, 1, 2, 2, 3, 3, 4, 5]


@pytest.mark.parametrize(
    ("points", "order", "mode", "triangles", "said"),
    [
        (RING, range(5), 6, FAN, ()),
        (RING, None, 6, FAN, ()),
        (BAND, range(6), 5, STRIP, ()),
        (BAND, None, 5, STRIP, ()),
        (APART, JOINED, 5, [APART[:3], APART[3:]], ("left out 4 joints, of strips or fans",)),
    ],
)
def test_fans_and_strips_are_their_triangles_and_all_face_one_way(path, points, order, mode, triangles, said):
    file = GltfFile()
    file.primitive(points, None if order is None else np.array(order), mode=mode)
    target = Target.load(file.write(path))
    assert soup(target.vertices[target.faces]) == soup(triangles)
    assert target.report.actions == said
    a, b, c = np.moveaxis(target.vertices[target.faces], 1, 0)
    assert said or len(np.unique(np.sign(np.cross(b - a, c - a)[:, 2]))) == 1


def test_instances_are_multiplied_out(path):
    rng = np.random.default_rng(5)
    shifts = np.array([(0.0, 0, 0), (5, 0, 0), (0, 7, 1)], dtype=np.float32)
    turns = rng.normal(size=(3, 4))
    turns = (turns / np.linalg.norm(turns, axis=1, keepdims=True)).astype(np.float32)
    scales = np.array([(1.0, 1, 1), (0.5, 2, 1), (1, 1, -1)], dtype=np.float32)
    file = cube()
    given = {"TRANSLATION": shifts, "ROTATION": turns, "SCALE": scales}
    instances = {name: file.array(table, "f4") for name, table in given.items()}
    file.tree["nodes"] = [
        {"children": [1], "translation": [0.0, 0.0, 20.0]},
        {"mesh": 0, "scale": [2.0, 1.0, 1.0], "extensions": {"EXT_mesh_gpu_instancing": {"attributes": instances}}},
    ]
    file.tree["extensionsUsed"] = file.tree["extensionsRequired"] = ["EXT_mesh_gpu_instancing"]
    target = Target.load(file.write(path))
    truth = [
        (Rotation.from_quat(q).apply(POINTS * s) + t) * [2.0, 1.0, 1.0] + [0.0, 0.0, 20.0]
        for t, q, s in zip(shifts.astype(float), turns.astype(float), scales.astype(float))
    ]
    assert target.report.triangles == 36
    np.testing.assert_allclose(target.vertices, np.concatenate(truth), atol=1e-6)


def hidden_mesh(file):
    file.tree["meshes"].append(file.tree["meshes"][0])
    file.tree["nodes"].append({"mesh": 0})


def morphed(file, **node):
    file.tree["meshes"][0]["primitives"][0]["targets"] = [{"POSITION": file.array(POINTS, "f4")}]
    file.tree["nodes"][0].update(node)


def requires(*names):
    return lambda file: file.tree.update(extensionsUsed=list(names), extensionsRequired=list(names))


SAID = [
    # Looks move no vertex; what else is not required is said.
    (requires("KHR_materials_unlit", "KHR_texture_transform", "EXT_texture_webp", "KHR_lights_punctual"), 12),
    (lambda file: file.tree.update(extensionsUsed=["VENDOR_outer"]), 12, "passed over the extension VENDOR_outer"),
    (
        lambda file: file.tree["meshes"][0]["primitives"][0].update(extensions={"VENDOR_inner": {}}),
        12,
        "passed over the extension VENDOR_inner",
    ),
    *(
        (
            lambda file, mode=mode: file.primitive(RING, mode=mode),
            12,
            f"left out {segments} line segments",
            "left out 1 line primitive",
        )
        for mode, segments in ((1, 2), (2, 5), (3, 4))
    ),
    (lambda file: file.primitive(RING, mode=0), 12, "left out 5 points"),
    (lambda file: file.primitive(RING + 5.0, mode=6), 15),
    (hidden_mesh, 12, "left out 1 node with a mesh, not in the shown scene", "left out 1 mesh, placed by no node"),
    (lambda file: morphed(file, weights=[0.0]), 12, "1 morph target"),
]


@pytest.mark.parametrize("case", SAID)
def test_what_is_not_taken_is_said(glb, case):
    change, triangles, *said = case
    file = cube()
    change(file)
    report = Target.load(file.write(glb)).report
    assert report.triangles == triangles
    assert len(report.actions) == len(said)
    for word in said:
        assert any(word in line for line in report.actions)


def test_points_alone_are_a_cloud(glb):
    file = GltfFile()
    file.primitive(RING, [0, 2], mode=0)
    assert Target.load(file.write(glb), thickness=0.1).report.points == 2


def disagreeing(file):
    attributes = {"TRANSLATION": file.array(np.zeros((3, 3)), "f4"), "SCALE": file.array(np.ones((2, 3)), "f4")}
    file.tree["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": attributes}}


def in_tree(change):
    return lambda file: change(file.tree)


def in_node(**entries):
    return lambda file: file.tree["nodes"][0].update(entries)


def drawn(**entries):
    return lambda file: file.tree["meshes"][0]["primitives"][0].update(entries)


REFUSED = [
    *((requires(name), name, "KHR_draco_mesh_compression") for name in ("EXT_meshopt_compression", "VENDOR_anything")),
    # Compressed views, even where the extension is not required.
    (in_tree(lambda tree: tree["bufferViews"][0].update(extensions={"EXT_meshopt_compression": {}})), "EXT_meshopt"),
    (disagreeing, "[2, 3] instances"),
    *((drawn(mode=mode), "mode") for mode in (-1, 7, 4.5, True, "4")),
    *((lambda file, m=mode: file.primitive(POINTS, [0, 1, 8], mode=m), "index 8", "0 to 7") for mode in (4, 5, 6)),
    (lambda file: file.primitive(POINTS, FACES.reshape(-1)[:-1]), "35 corners"),
    (lambda file: morphed(file, weights=[0.5]), "morph"),
    (in_node(skin=0), "skin"),
    (in_node(mesh=-1), "meshes index -1"),
    (in_node(children=[0]), "ancestor"),
    (in_node(matrix=[1.0] * 16), "last row"),
    (in_node(translation=[1, 2]), "translation"),
    (in_node(rotation=[0, 0, 0, 0]), "quaternion"),
    (in_tree(lambda tree: tree["accessors"][0].update(count=9)), "ends at byte"),
    (drawn(attributes={}), "POSITION"),
    (in_tree(lambda tree: tree["asset"].update(version="1.0")), "version"),
    (in_tree(lambda tree: tree.update(nodes="none")), "nodes"),
    (in_tree(lambda tree: tree.pop("scenes")), "no scene"),
]


@pytest.mark.parametrize("case", REFUSED)
def test_a_wrong_tree_is_refused(glb, case):
    change, *words = case
    file = cube()
    change(file)
    refused(file.write(glb), *words, units="m")


def sparse(file):
    """One corner farther out, by a sparse accessor; give where all corners are."""
    moved = POINTS.copy()
    moved[3] *= 4.0
    file.tree["accessors"][0]["sparse"] = {
        "count": 1,
        "indices": {"bufferView": file.view(np.array([3], dtype="<u2").tobytes()), "componentType": 5123},
        "values": {"bufferView": file.view(moved[3:4].astype("<f4").tobytes())},
    }
    return moved


def strided(file):
    """Positions in rows of six numbers."""
    mixed = np.column_stack([POINTS, np.full((8, 3), 7.0)]).astype("<f4")
    view = file.tree["accessors"][0]["bufferView"] = file.view(mixed.tobytes())
    file.tree["bufferViews"][view]["byteStride"] = 24
    return POINTS


def quantized(file, normalized, scale, indices="u1"):
    """Positions of sixteen bits, which only a required extension allows."""
    position = file.array((POINTS * 100).astype(np.int64), "i2", normalized=normalized)
    file.tree["meshes"][0]["primitives"] = [
        {"attributes": {"POSITION": position}, "indices": file.array(FACES.reshape(-1), indices)}
    ]
    file.tree["nodes"][0]["scale"] = 3 * [scale]
    requires("KHR_mesh_quantization")(file)
    return POINTS


@pytest.mark.parametrize(
    "change",
    [sparse, strided, lambda file: quantized(file, True, 327.67), lambda file: quantized(file, False, 0.01)],
)
def test_positions_of_every_storage_are_read(path, change):
    file = cube()
    corners = change(file)
    target = Target.load(file.write(path))
    assert soup(target.vertices[target.faces]) == soup(corners[FACES])
    if file.tree.pop("extensionsRequired", None):
        del file.tree["extensionsUsed"]
        refused(file.write(path), "componentType")


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
    requires("KHR_draco_mesh_compression")(file)
    file.tree["nodes"][0]["translation"] = [5.0, 0.0, 0.0]
    change(primitive, file.tree)
    if word:
        refused(file.write(path), word)
    else:
        report = Target.load(file.write(path)).report
        assert report.triangles == 12
        assert report.extents == pytest.approx((2.0, 2.0, 2.0), abs=1e-3)
        assert report.lower == pytest.approx((4.0, -1.0, -1.0), abs=1e-3)


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
    truth = np.concatenate([part.triangles for part in trimesh.load_scene(path, process=False).dump()])
    target = Target.load(path, units="m")
    np.testing.assert_allclose(target.vertices[target.faces], truth, atol=1e-12 * np.abs(truth).max())
