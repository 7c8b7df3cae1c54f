"""Mesh files that ask for more than they are: refused before it is built, or read whole, and always said."""

import json
import os
import struct
import zipfile
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from truths.gltf_files import GltfFile
from truths.small_files import BODY, FACES, ITEM, SQUARE, refused, three_mf, within, written

from keepout.core.errors import MeshError
from keepout.core.geometry.target import Target

# 3MF ------------------------------------------------------------------------------------------------------------------


def nested(levels, wide, leaf=BODY):
    """Objects of `wide` components each, `levels` deep over the object 1, and the item of the outermost."""
    below, resources = 1, leaf
    for number in range(100, 100 + levels):
        components = f'<component objectid="{below}"/>' * wide
        resources += f'<object id="{number}"><components>{components}</components></object>'
        below = number
    return resources, f'<item objectid="{below}"/>'


def circle():
    return "".join(
        f'<object id="{i}"><components><component objectid="{(i + 1) % 5}"/></components></object>' for i in range(5)
    )


def archive(path, content, compression=zipfile.ZIP_DEFLATED):
    with zipfile.ZipFile(path, "w", compression, compresslevel=1) as made:
        made.writestr("3D/3dmodel.model", content)
    return path


@pytest.mark.long
def test_an_archive_that_inflates_is_refused_unread(tmp_path):
    path = archive(tmp_path / "a.3mf", b" " * (300 << 20))
    refused(path, str(300 << 20), str(256 << 20))
    # One that says less than it inflates to.
    path.write_bytes(path.read_bytes().replace(struct.pack("<I", 300 << 20), struct.pack("<I", 1000)))
    refused(path)
    refused(archive(path, b" " * 1000, zipfile.ZIP_BZIP2), "compress")


@pytest.mark.slow
def test_more_elements_than_memory_holds_are_refused_unparsed(tmp_path):
    refused(written(tmp_path / "a.3mf", three_mf("<a/>" * 42_000_000)), "40000000")


def entities(encoding):
    """Declared entities: in attributes a parser expands them whatever it is told about entities."""
    declared = '<!ENTITY a0 "0">' + "".join(f'<!ENTITY a{i + 1} "{f"&a{i};" * 10}">' for i in range(8))
    head = f'<?xml version="1.0" encoding="{encoding}"?><!DOCTYPE model [{declared}]>'
    return three_mf(BODY.replace('x="1"', 'x="&a8;"', 1), head=head, encoding=encoding)


def strip_of(triangles):
    return BODY.replace(FACES, "".join(f'<triangle v1="0" v2="{1 + i % 2}" v3="3"/>' for i in range(triangles)))


FAR_ITEM = '<item objectid="1" transform="1 0 0 0 1 0 0 0 1 1e17 0 0"/>'


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (lambda: entities("utf-8"), ["DOCTYPE"]),
        (lambda: entities("utf-16"), ["DOCTYPE"]),
        (lambda: three_mf(circle(), '<item objectid="3"/>'), ["component of itself"]),
        # Components are counted before they are built, whether there is anything in them or not.
        (lambda: three_mf(*nested(5, 10)), ["111111", "100000"]),
        (lambda: three_mf(*nested(3000, 2, '<object id="1"><components/></object>')), ["100000"]),
        (lambda: three_mf(*nested(4, 10, strip_of(3000))), ["30000000 triangles", "20000000"]),
        (lambda: three_mf(build=FAR_ITEM), ["object '1'", "1e+17"]),
    ],
)
def test_a_three_mf_that_makes_more_or_goes_farther_than_can_be_is_refused(tmp_path, content, words):
    refused(written(tmp_path / "a.3mf", content()), *words)


# Transforms -----------------------------------------------------------------------------------------------------------


def square():
    file = GltfFile()
    file.primitive(SQUARE, [0, 1, 2, 0, 2, 3])
    return file


def scene(path, *translations):
    """A square under a chain of nodes, the outermost first."""
    file = square()
    nodes = [{"translation": list(t), "children": [i + 1]} for i, t in enumerate(translations)]
    file.tree["nodes"] = [*nodes, {"mesh": 0}]
    return file.write(path)


@given(st.lists(st.floats(-1e20, 1e20), max_size=4))
@example([1e17])
@example([1e17, 0.5, -1e17])
@example([1e5, -1e5])
def test_a_move_keeps_the_shape_or_is_refused(tmp_path_factory, along):
    path = tmp_path_factory.mktemp("moved") / "a.glb"
    scene(path, *((x, 0.0, 0.0) for x in along))
    try:
        target = Target.load(path, units="m")
    except MeshError as refusal:
        assert "node" in str(refusal) or "extent" in str(refusal) or "million" in str(refusal)  # noqa: PT017
        assert sum(map(abs, along)) > 1e6
        return
    exact = float(sum(map(Fraction, along)))
    assert abs(target.vertices[:, 0].min() - exact) < 1e-5
    assert target.report.extents == pytest.approx((1.0, 1.0, 0.0), abs=1e-5)


def test_what_is_moved_too_far_is_named(tmp_path):
    refused(scene(tmp_path / "a.glb", (1e17, 0.0, 0.0)), "node 1", "1e+17", units="m")
    far = "OFF\n3 1 0\n1e13 0 0\n10000000000001 0 0\n1e13 1 0\n3 0 1 2\n"
    refused(written(tmp_path / "a.off", far), "1e+13", "rounding")


def test_a_node_of_scale_zero_is_flat_as_it_says(tmp_path):
    file = square()
    file.tree["nodes"] = [{"mesh": 0}, {"mesh": 0, "scale": [0.0, 0.0, 0.0]}]
    file.tree["scenes"] = [{"nodes": [0, 1]}]
    assert Target.load(file.write(tmp_path / "a.glb"), units="m").report.extents == (1.0, 1.0, 0.0)


# glTF -----------------------------------------------------------------------------------------------------------------


def many_nodes(file):
    file.primitive(np.zeros((30_000, 3)))
    file.tree["nodes"] = [{"mesh": 0}] * 3000
    file.tree["scenes"] = [{"nodes": list(range(3000))}]


def many_primitives(file):
    file.tree["meshes"][0]["primitives"] = [file.primitive(np.zeros((30_000, 3)))] * 3000


def many_instances(file):
    """Instances that take no bytes."""
    file.primitive(SQUARE, [0, 1, 2])
    rows, zero = file.view(b"\0\0\0\0"), file.view(b"\0" * 12)
    sparse = {"count": 1, "indices": {"bufferView": rows, "componentType": 5125}, "values": {"bufferView": zero}}
    file.tree["accessors"].append({"componentType": 5126, "type": "VEC3", "count": 9_000_000, "sparse": sparse})
    attributes = {"TRANSLATION": len(file.tree["accessors"]) - 1}
    file.tree["nodes"] = [{"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {"attributes": attributes}}}]


@pytest.mark.parametrize(
    ("made", "words"),
    [
        (many_nodes, ["30000000 triangles", "20000000"]),
        (many_primitives, ["30000000 triangles", "20000000"]),
        (many_instances, ["9000000", "100000"]),
    ],
)
def test_what_a_scene_makes_is_counted_before_it_is_built(tmp_path, made, words):
    file = GltfFile()
    made(file)
    refused(file.write(tmp_path / "a.glb"), *words)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A mesh in its folder, with a buffer of the right length in each forbidden place."""
    top = tmp_path_factory.mktemp("places")
    (top / "in" / "deep").mkdir(parents=True)
    file = square()
    file.write(top / "in" / "a.gltf")
    (top / "in" / "its numbers.bin").unlink()
    for place in ("out.bin", "in/b.bin", "in/deep/b.bin"):
        (top / place).write_bytes(file.data)
    for link, to in (("link.bin", top / "out.bin"), ("zero.bin", "/dev/zero"), ("up", top), ("near.bin", "deep/b.bin")):
        (top / "in" / link).symlink_to(to)
    (top / "in" / "long.bin").write_bytes(file.data + b"\0" * 4)
    (top / "in" / "short.bin").write_bytes(file.data[:-1])
    os.mkfifo(top / "in" / "pipe.bin")
    return top


def named(folder, uri):
    path = folder / "in" / "a.gltf"
    tree = json.loads(path.read_text())
    tree["buffers"][0]["uri"] = uri
    path.write_text(json.dumps(tree))
    return path


@pytest.mark.parametrize("uri", ["b.bin", "./b.bin", "deep/b.bin", "deep/../b.bin", "%62.bin", "near.bin"])
def test_a_buffer_in_or_below_the_folder_is_read(folder, uri):
    assert Target.load(named(folder, uri), units="m").report.triangles == 2


@pytest.mark.parametrize(
    ("uri", "said"),
    [
        ("../out.bin", "not in the mesh's folder"),
        ("..%2Fout.bin", "not in the mesh's folder"),
        ("link.bin", "not in the mesh's folder"),
        ("up/out.bin", "not in the mesh's folder"),
        ("zero.bin", "not in the mesh's folder"),
        ("pipe.bin", "no regular file"),
        ("", "no regular file"),
        ("long.bin", "bytes"),
        ("short.bin", "declares"),
        ("none%20there.bin", "none%20there.bin"),
        ("http://example.com/b.bin", "cannot be read"),
        ("b.bin\0", "cannot be read"),
        (17, "uri"),
        # Absolute paths and file URLs are refused even where they lead inside.
        ("{}/in/b.bin", "buffers 0"),
        ("file://{}/in/b.bin", "buffers 0"),
    ],
)
def test_a_buffer_elsewhere_is_refused(folder, uri, said):
    refused(named(folder, uri.format(folder) if isinstance(uri, str) else uri), said, "buffers 0")


@given(
    st.lists(st.sampled_from(["..", "%2e.", "up", "in", "deep", ".", "", "out.bin", "link.bin", "b.bin"]), max_size=5)
)
def test_no_name_reaches_out_of_the_folder(folder, steps):
    uri = "/".join(steps)
    try:
        Target.load(named(folder, uri), units="m")
    except MeshError:
        return
    found = os.path.realpath(os.path.join(folder / "in", uri.replace("%2e", ".")))
    assert found in (str(folder / "in" / "b.bin"), str(folder / "in" / "deep" / "b.bin"))


# Many of one kind, and counts that are not there ----------------------------------------------------------------------


OBJ = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"


def chain(path):
    """A square under thousands of nodes, one below the other."""
    file = square()
    file.tree["nodes"] = [{"children": [i + 1]} for i in range(8_000)] + [{"mesh": 0}]
    return file.write(path)


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "made"),
    [
        ("a.glb", chain),
        ("a.3mf", lambda path: written(path, three_mf(build=ITEM * 4_000))),
        ("a.obj", lambda path: written(path, OBJ + "f 1 2 \\\n" + "3 4 \\\n" * 20_000 + "1\n")),
        ("a.obj", lambda path: written(path, OBJ + "f " + "1 2 3 4 " * 15_000)),
    ],
)
def test_time_is_linear_in_nodes_items_lines_and_corners(tmp_path, name, made):
    """A time that grows with the square of them would be minutes."""
    path = made(tmp_path / name)
    with within(12.0):
        assert Target.load(path, units="m").report.triangles <= 4


def declared(kind, count, properties="property float x\nproperty float y\nproperty float z\n"):
    head = f"ply\nformat {kind} 1.0\nelement vertex {count}\n{properties}"
    return head + "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n"


@pytest.mark.parametrize("count", [4_000_000_000, 10**17])
def test_elements_that_are_declared_alone_are_refused(tmp_path, count):
    for kind in ("ascii", "binary_little_endian"):
        refused(written(tmp_path / "a.ply", declared(kind, count)))
        refused(written(tmp_path / "a.ply", declared(kind, count, "")))
    stl = b"\0" * 80 + struct.pack("<I", count % 2**32) + b"\0" * 50
    refused(written(tmp_path / "a.stl", stl), str(count % 2**32))
    refused(written(tmp_path / "a.off", f"OFF\n{count} {count} 0\n0 0 0\n"), str(count))
    np.save(tmp_path / "a.npy", np.zeros((4, 3)))
    path = tmp_path / "a.npy"
    refused(written(path, path.read_bytes().replace(b"(4, 3)", f"({count}, 3)".encode())), thickness=0.1)
