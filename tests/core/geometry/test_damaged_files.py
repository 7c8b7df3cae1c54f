"""Files cut short or with wrong bytes, in every format: one line of refusal, or nothing missing without a word."""

import io
import warnings
import zipfile

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from truths.gltf_files import GltfFile

from keepout.core.errors import MeshError
from keepout.core.geometry.target import Target

MESH = trimesh.creation.box(extents=(2.0, 3.0, 4.0)).subdivide()
FACES = len(MESH.faces)
TEXT = ("off", "obj", "ascii.ply", "ascii.stl", "gltf", "xyz")
KINDS = ("glb", "stl", "ply", "3mf", "npy", *TEXT)
CLOUDS = ("xyz", "npy")
UNDECLARED = ("obj", "xyz")
"""Formats that declare no counts: cut between lines, such a file is a whole one."""
COUNTED = ("stl", "ply", "off", "ascii.ply")
"""Formats of plain records, where nothing wrong can make a face into something else."""

SHARED_BY_ALL = settings(max_examples=4 * settings().max_examples)
"""Eleven formats share the examples."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The bytes of one good file of each kind."""
    folder = tmp_path_factory.mktemp("whole")
    files = {kind: MESH.export(file_type=kind) for kind in ("stl", "ply", "3mf", "off", "obj")}
    files["ascii.ply"] = MESH.export(file_type="ply", encoding="ascii")
    files["ascii.stl"] = MESH.export(file_type="stl_ascii")
    for suffix in ("glb", "gltf"):
        files[suffix] = scene().write(folder / f"a.{suffix}").read_bytes()
    files["its numbers.bin"] = (folder / "its numbers.bin").read_bytes()
    np.save(folder / "a.npy", MESH.vertices)
    np.savetxt(folder / "a.xyz", MESH.vertices)
    files |= {kind: (folder / f"a.{kind}").read_bytes() for kind in CLOUDS}
    return {kind: data.encode() if isinstance(data, str) else data for kind, data in files.items()}


def scene():
    file = GltfFile()
    file.primitive(MESH.vertices, MESH.faces.reshape(-1))
    file.tree["nodes"] = [{"children": [1], "translation": [1.0, 2.0, 3.0]}, {"mesh": 0, "rotation": [0, 0, 0.6, 0.8]}]
    return file


def read(folder, kind, files, data):
    """A target, or None where the file is refused as it should be: by a MeshError of one line that names the file."""
    path = folder / f"a.{kind}"
    path.write_bytes(data)
    if kind == "gltf":
        (folder / "its numbers.bin").write_bytes(files["its numbers.bin"])
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            target = Target.load(path, scale=1.0, thickness=0.1 if kind in CLOUDS else None)
    except MeshError as refusal:
        said = str(refusal)
        assert "\n" not in said
        assert path.name in said
        assert "TypeCheckError" not in said
        assert "Warning" not in said
        return None
    assert np.isfinite(surface(target)).all()
    return target


def surface(target):
    return target.vertices[target.faces]


@pytest.mark.parametrize("kind", KINDS)
def test_cut_short_anywhere(tmp_path, whole, kind):
    """The whole file is read; so are about fifty prefixes of it, and all that lack up to twenty of its last bytes."""
    data = whole[kind]
    target = read(tmp_path, kind, whole, data)
    good = surface(target)
    assert len(target.faces) == (FACES if kind not in CLOUDS else len(MESH.vertices))
    assert not any("last line" in line or "left out" in line for line in target.report.actions)
    for length in [*range(0, len(data) - 20, 1 + len(data) // 50), *range(len(data) - 20, len(data))]:
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


def overwritten(data, changes):
    data = bytearray(data)
    for place, byte in changes:
        data[min(int(place * len(data)), len(data) - 1)] = byte
    return bytes(data)


def exchanged(data, place, share, new):
    start = int(place * len(data))
    return data[:start] + new + data[start + int(share * len(data)) :]


SHARE = st.floats(0, 1)
DAMAGES = {
    overwritten: st.tuples(st.lists(st.tuples(SHARE, st.integers(0, 255)), min_size=1, max_size=4)),
    exchanged: st.tuples(SHARE, st.floats(0, 0.2), st.binary(max_size=8)),
    lambda data, new: new: st.tuples(st.binary(max_size=400)),
}


@pytest.mark.parametrize("damage", DAMAGES, ids=["overwritten", "exchanged", "replaced"])
@SHARED_BY_ALL
@given(st.data())
def test_wrong_bytes(tmp_path_factory, whole, damage, data):
    kind, changes = data.draw(st.sampled_from(KINDS)), data.draw(DAMAGES[damage])
    target = read(tmp_path_factory.mktemp("wrong"), kind, whole, damage(whole[kind], *changes))
    if target is not None and (kind in COUNTED or (kind == "ascii.stl" and damage is overwritten)):
        # Triangles kept, and those that action lines account for, are as many as were declared.
        left_out = [int(line.split()[2]) for line in target.report.actions if line.startswith("left out")]
        assert len(target.faces) + sum(left_out) >= FACES


def places(tree, above=()):
    """Paths to all entries of a JSON tree."""
    entries = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, entry in entries:
        yield (*above, key)
        yield from places(entry, (*above, key))


WRONG = ["drop", None, True, -1, 0, 7, 10**12, 1e300, float("inf"), float("nan"), "x", [], [0], {"a": 1}, 5123]


@SHARED_BY_ALL
@given(st.integers(0, 10**6), st.sampled_from(WRONG))
def test_a_scene_with_one_wrong_entry(tmp_path_factory, place, value):
    file = scene()
    instances = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": file.array(np.eye(3), "f4")}}}
    file.tree["nodes"][1]["extensions"] = instances
    *above, last = sorted(places(file.tree), key=str)[place % len(list(places(file.tree)))]
    entry = file.tree
    for key in above:
        entry = entry[key]
    if value == "drop":
        del entry[last]
    else:
        entry[last] = value
    folder = tmp_path_factory.mktemp("entry")
    read(folder, "glb", {}, file.write(folder / "a.glb").read_bytes())


@given(st.floats(0, 1), st.sampled_from(["", "0", "9", "-", "x", '"', "<", ">", " ", "/"]))
def test_the_model_of_a_three_mf_with_wrong_characters(tmp_path_factory, whole, place, character):
    spoiled = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(whole["3mf"])) as good, zipfile.ZipFile(spoiled, "w") as bad:
        for name in good.namelist():
            content = good.read(name)
            if name.lower().endswith(".model"):
                at = min(int(place * len(content)), len(content) - 1)
                content = content[:at] + character.encode() + content[at + 1 :]
            bad.writestr(name, content)
    read(tmp_path_factory.mktemp("model"), "3mf", whole, spoiled.getvalue())
