"""Files cut short or with wrong bytes, in every format: one line of refusal, or nothing missing without a word."""

import warnings
import zipfile

import numpy as np
import pytest
import trimesh
from hypothesis import example, given, settings
from hypothesis import strategies as st
from truths.gltf_files import GltfFile

from keepout.errors import MeshError
from keepout.geometry import Target

MESH = trimesh.creation.box(extents=(2.0, 3.0, 4.0)).subdivide()
FACES = len(MESH.faces)
TEXT = ("off", "obj", "ascii.ply", "ascii.stl", "gltf", "xyz")
KINDS = ("glb", "stl", "ply", "3mf", "npy", *TEXT)
UNDECLARED = ("obj", "xyz")
"""Formats that declare no counts: cut between lines, such a file is a whole one."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The bytes of one good file of each kind."""
    folder = tmp_path_factory.mktemp("whole")
    files = {kind: MESH.export(file_type=kind) for kind in ("stl", "ply", "3mf", "off", "obj")}
    files["ascii.ply"] = MESH.export(file_type="ply", encoding="ascii")
    files["ascii.stl"] = MESH.export(file_type="stl_ascii")
    for suffix in ("glb", "gltf"):
        file = GltfFile()
        file.primitive(MESH.vertices, MESH.faces.reshape(-1))
        file.tree["nodes"] = [
            {"children": [1], "translation": [1.0, 2.0, 3.0]},
            {"mesh": 0, "rotation": [0, 0, 0.6, 0.8]},
        ]
        files[suffix] = file.write(folder / f"a.{suffix}").read_bytes()
    files["its numbers.bin"] = (folder / "its numbers.bin").read_bytes()
    np.save(folder / "a.npy", MESH.vertices)
    np.savetxt(folder / "a.xyz", MESH.vertices)
    files |= {kind: (folder / f"a.{kind}").read_bytes() for kind in ("npy", "xyz")}
    return {kind: data.encode() if isinstance(data, str) else data for kind, data in files.items()}


def read(folder, kind, files, data):
    """A target, or None where the file is refused as it should be: by a MeshError of one line that names the file."""
    path = folder / f"a.{kind}"
    path.write_bytes(data)
    if kind == "gltf":
        (folder / "its numbers.bin").write_bytes(files["its numbers.bin"])
    cloud = kind in ("xyz", "npy")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            return Target.load(path, scale=1.0, thickness=0.1 if cloud else None)
    except MeshError as refusal:
        said = str(refusal)
        assert "\n" not in said
        assert path.name in said
        assert "TypeCheckError" not in said
        assert "Warning" not in said
        return None


def surface(target):
    return target.vertices[target.faces]


@pytest.mark.parametrize("kind", KINDS)
def test_the_whole_file_is_read(tmp_path, whole, kind):
    target = read(tmp_path, kind, whole, whole[kind])
    assert target is not None
    assert len(target.faces) == (FACES if kind not in ("xyz", "npy") else len(MESH.vertices))
    assert not any("last line" in line or "left out" in line for line in target.report.actions)


@pytest.mark.parametrize("kind", KINDS)
def test_cut_short_anywhere(tmp_path, whole, kind):
    """About a hundred prefixes of the file, and all that lack up to forty of its last bytes."""
    data = whole[kind]
    good = surface(read(tmp_path, kind, whole, data))
    lengths = [*range(0, len(data) - 40, 1 + len(data) // 100), *range(len(data) - 40, len(data))]
    for length in lengths:
        cut = data[:length]
        target = read(tmp_path, kind, whole, cut)
        if target is None or np.array_equal(surface(target), good):
            continue
        assert kind in TEXT
        said = any("last line has no line end" in line for line in target.report.actions)
        between_lines = kind in UNDECLARED and cut.endswith(b"\n")
        assert said or between_lines, f"cut to {length} bytes"
        if kind not in UNDECLARED:
            assert len(target.faces) >= FACES - 1 - sum("left out" in line for line in target.report.actions)


def declared_faces(target):
    """Triangles kept, and those that action lines account for."""
    left_out = [int(line.split()[2]) for line in target.report.actions if line.startswith("left out")]
    return len(target.faces) + sum(left_out)


COUNTED = ("stl", "ply", "off", "ascii.ply", "ascii.stl")
"""Formats of plain records, where no wrong byte can make a face into something else."""


@settings(max_examples=120)
@given(st.sampled_from(KINDS), st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), min_size=1, max_size=4))
@example("off", [(0.0, ord("N"))])
def test_wrong_bytes(tmp_path_factory, whole, kind, changes):
    data = bytearray(whole[kind])
    for place, byte in changes:
        data[min(int(place * len(data)), len(data) - 1)] = byte
    target = read(tmp_path_factory.mktemp("wrong"), kind, whole, bytes(data))
    if target is None:
        return
    assert np.isfinite(surface(target)).all()
    if kind in COUNTED:
        assert declared_faces(target) >= FACES


@settings(max_examples=120)
@given(st.sampled_from(KINDS), st.floats(0, 1), st.floats(0, 0.2), st.binary(max_size=8))
def test_pieces_cut_out_and_put_in(tmp_path_factory, whole, kind, place, share, new):
    data = whole[kind]
    start = int(place * len(data))
    spoiled = data[:start] + new + data[start + int(share * len(data)) :]
    target = read(tmp_path_factory.mktemp("pieces"), kind, whole, spoiled)
    if target is not None:
        assert np.isfinite(surface(target)).all()
        if kind in COUNTED and kind != "ascii.stl":
            assert declared_faces(target) >= FACES


@settings(max_examples=80)
@given(st.sampled_from([*KINDS]), st.binary(max_size=400))
def test_random_bytes_are_refused(tmp_path_factory, kind, data):
    assert read(tmp_path_factory.mktemp("random"), kind, {"its numbers.bin": b""}, data) is None or kind in (
        "xyz",
        "obj",
    )


@settings(max_examples=60)
@given(st.integers(0, 10**6), st.integers(0, 255), st.booleans())
def test_the_json_of_a_scene_with_wrong_bytes(tmp_path_factory, whole, place, byte, second):
    """The tree itself is hit, not the numbers: never another exception than a refusal."""
    data = bytearray(whole["gltf"])
    data[place % len(data)] = byte
    if second:
        data[(place * 7919) % len(data)] = (byte * 31) % 256
    target = read(tmp_path_factory.mktemp("tree"), "gltf", whole, bytes(data))
    assert target is None or np.isfinite(surface(target)).all()


def places(tree, above=()):
    """Paths to all entries of a JSON tree."""
    entries = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, entry in entries:
        yield (*above, key)
        yield from places(entry, (*above, key))


WRONG = [
    None,
    True,
    -1,
    0,
    1,
    7,
    10**12,
    1e300,
    float("inf"),
    float("nan"),
    "x",
    [],
    [0],
    {},
    {"a": 1},
    "POSITION",
    5123,
]


@settings(max_examples=250)
@given(st.integers(0, 10**6), st.one_of(st.just("drop"), st.sampled_from(WRONG)))
def test_a_scene_with_one_wrong_entry(tmp_path_factory, place, value):
    file = GltfFile()
    file.primitive(MESH.vertices, MESH.faces.reshape(-1))
    instances = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": file.array(np.eye(3), "f4")}}}
    file.tree["nodes"] = [{"children": [1], "translation": [1.0, 2.0, 3.0]}, {"mesh": 0, "extensions": instances}]
    *above, last = sorted(places(file.tree), key=str)[place % len(list(places(file.tree)))]
    entry = file.tree
    for key in above:
        entry = entry[key]
    if value == "drop":
        del entry[last]
    else:
        entry[last] = value
    folder = tmp_path_factory.mktemp("entry")
    target = read(folder, "glb", {}, file.write(folder / "a.glb").read_bytes())
    assert target is None or np.isfinite(surface(target)).all()


@settings(max_examples=60)
@given(st.floats(0, 1), st.sampled_from(["", "0", "9", "-", "x", '"', "<", ">", " ", "/"]))
def test_the_model_of_a_three_mf_with_wrong_characters(tmp_path_factory, whole, place, character):
    folder = tmp_path_factory.mktemp("model")
    (folder / "good.3mf").write_bytes(whole["3mf"])
    with zipfile.ZipFile(folder / "good.3mf") as good, zipfile.ZipFile(folder / "bad.3mf", "w") as bad:
        for name in good.namelist():
            content = good.read(name)
            if name.lower().endswith(".model"):
                at = min(int(place * len(content)), len(content) - 1)
                content = content[:at] + character.encode() + content[at + 1 :]
            bad.writestr(name, content)
    target = read(folder, "3mf", whole, (folder / "bad.3mf").read_bytes())
    assert target is None or np.isfinite(surface(target)).all()
