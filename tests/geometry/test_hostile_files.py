"""Mesh files that ask for more than they are: refused before it is built, or read whole, and always said."""

import json
import os
import signal
import struct
import time
import zipfile
from contextlib import contextmanager
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from truths.gltf_files import GltfFile

from keepout.errors import MeshError
from keepout.geometry import Target

CORE = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
CORNERS = "".join(f'<vertex x="{x}" y="{y}" z="0"/>' for x, y in ((0, 0), (1, 0), (1, 1), (0, 1)))
FACES = '<triangle v1="0" v2="1" v3="2"/><triangle v1="0" v2="2" v3="3"/>'
BODY = f'<object id="1"><mesh><vertices>{CORNERS}</vertices><triangles>{FACES}</triangles></mesh></object>'
SQUARE = np.array([(0.0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)])
REFUSED_IN = 4.0
"""Seconds on the processor, all threads together; one on an idle machine."""


def three_mf(path, resources, build, head=""):
    """A 3MF in metres."""
    model = f'{head}<model xmlns="{CORE}" unit="meter"><resources>{resources}</resources><build>{build}</build></model>'
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("3D/3dmodel.model", model)
    return path


def nested(levels, wide, leaf=1):
    """Objects of `wide` components each, `levels` deep over the object `leaf`."""
    below, resources = leaf, ""
    for number in range(100, 100 + levels):
        resources += f'<object id="{number}"><components>'
        resources += f'<component objectid="{below}"/>' * wide + "</components></object>"
        below = number
    return resources, f'<item objectid="{below}"/>'


@contextmanager
def within(seconds):
    """Fail, rather than go on, past a time on the processor: memory would end first."""

    def late(*_):
        pytest.fail(f"not done in {seconds} s")  # no Exception, which a reader would take for a damaged file

    before = signal.signal(signal.SIGPROF, late)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


def refused(path, *words, **arguments):
    with within(REFUSED_IN), pytest.raises(MeshError) as refusal:
        Target.load(path, **arguments)
    told = str(refusal.value)
    assert "\n" not in told
    for word in (path.name, *words):
        assert word in told, told
    return told


@settings(max_examples=8)
@given(st.integers(4, 40), st.integers(2, 12), st.booleans())
@example(5, 10, False)
@example(3000, 2, True)
def test_components_are_counted_before_they_are_built(tmp_path_factory, levels, wide, empty):
    made = wide**levels
    path = tmp_path_factory.mktemp("nested") / "a.3mf"
    leaf = '<object id="1"><components/></object>' if empty else BODY
    resources, item = nested(levels, wide)
    three_mf(path, leaf + resources, item)
    if made + 1 <= 50_000:
        with within(15.0):
            if not empty:
                assert Target.load(path).report.triangles == 2
    elif made > 10**6:
        refused(path, "100000", str(sum(wide**level for level in range(levels + 1))) if levels < 20 else "")


def test_many_triangles_in_few_placements_are_counted(tmp_path):
    strip = "".join(f'<triangle v1="0" v2="{1 + i % 2}" v3="3"/>' for i in range(3000))
    body = BODY.replace(FACES, strip)
    resources, item = nested(4, 10)
    refused(three_mf(tmp_path / "a.3mf", body + resources, item), "30000000 triangles", "20000000")


@pytest.mark.long
def test_time_is_linear_in_items(tmp_path):
    """Four times as many items take about four times as long; sixteen times would be quadratic."""

    def seconds(items):
        path = three_mf(tmp_path / f"{items}.3mf", BODY, '<item objectid="1"/>' * items)
        began = time.process_time()
        assert Target.load(path).report.triangles == 2
        return time.process_time() - began

    seconds(10)
    assert seconds(4_000) < 9.0 * min(seconds(1_000) for _ in range(2))


def test_a_circle_of_components_is_refused(tmp_path):
    resources = "".join(
        f'<object id="{i}"><components><component objectid="{(i + 1) % 5}"/></components></object>' for i in range(5)
    )
    refused(three_mf(tmp_path / "a.3mf", resources, '<item objectid="3"/>'), "component of itself")


def test_an_archive_that_inflates_is_refused_unread(tmp_path):
    path = tmp_path / "a.3mf"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr("3D/3dmodel.model", b" " * (300 << 20))
    refused(path, str(300 << 20), str(256 << 20))


def test_an_archive_that_says_less_than_it_inflates_to_is_refused(tmp_path):
    path = tmp_path / "a.3mf"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr("3D/3dmodel.model", b" " * (300 << 20))
    whole = path.read_bytes()
    path.write_bytes(whole.replace(struct.pack("<I", 300 << 20), struct.pack("<I", 1000)))
    refused(path)


def test_an_archive_of_another_compression_is_refused(tmp_path):
    path = tmp_path / "a.3mf"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_BZIP2) as archive:
        archive.writestr("3D/3dmodel.model", b" " * 1000)
    refused(path, "compress")


@pytest.mark.long
def test_more_elements_than_memory_holds_are_refused_unparsed(tmp_path):
    refused(three_mf(tmp_path / "a.3mf", "<a/>" * 42_000_000, ""), "40000000")


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_declared_entities_are_refused(tmp_path, encoding):
    """In attributes a parser expands them whatever it is told about entities."""
    entities = '<!ENTITY a0 "0">' + "".join(f'<!ENTITY a{i + 1} "{f"&a{i};" * 10}">' for i in range(8))
    head = f'<?xml version="1.0" encoding="{encoding}"?><!DOCTYPE model [{entities}]>'
    path = tmp_path / "a.3mf"
    three_mf(path, BODY.replace('x="1"', 'x="&a8;"', 1), '<item objectid="1"/>', head)
    with zipfile.ZipFile(path) as archive:
        text = archive.read("3D/3dmodel.model").decode()
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("3D/3dmodel.model", text.encode(encoding))
    refused(path, "DOCTYPE")


def test_a_three_mf_in_utf_16_is_read(tmp_path):
    path = three_mf(tmp_path / "a.3mf", BODY, '<item objectid="1"/>')
    with zipfile.ZipFile(path) as archive:
        text = archive.read("3D/3dmodel.model").decode()
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("3D/3dmodel.model", ('<?xml version="1.0" encoding="UTF-16"?>' + text).encode("utf-16"))
    assert Target.load(path).report.triangles == 2


@pytest.mark.parametrize("kind", ["model", "support", "solidsupport", "surface", "other"])
@pytest.mark.parametrize("printable", ["", 'printable="0"'])
def test_what_is_not_printed_is_part_of_the_target_and_said(tmp_path, kind, printable):
    path = three_mf(
        tmp_path / "a.3mf", BODY.replace('id="1"', f'id="1" type="{kind}"'), f'<item objectid="1" {printable}/>'
    )
    report = Target.load(path).report
    assert report.triangles == 2
    expected = [] if kind == "model" else [f"kept 1 placement of an object of type '{kind}', as part of the target"]
    expected += ["kept 1 build item that is not to be printed, as part of the target"] if printable else []
    assert sorted(report.actions) == sorted(expected)


def test_units_that_contradict_the_file_are_refused(tmp_path):
    path = tmp_path / "a.3mf"
    three_mf(path, BODY, '<item objectid="1"/>')
    assert Target.load(path, units="m").report.extents[0] == 1.0
    refused(path, "'mm'", "meter", "scale", units="mm")
    report = Target.load(path, scale=0.5).report
    assert report.extents[0] == 0.5
    assert any("meter" in line and "0.5" in line for line in report.actions)


# Transforms ----------------------------------------------------------------------------------------------------------


def scene(path, *translations, scale=None):
    """A square under a chain of nodes, the outermost first."""
    file = GltfFile()
    file.primitive(SQUARE, [0, 1, 2, 0, 2, 3])
    nodes = [{"translation": list(t), "children": [i + 1]} for i, t in enumerate(translations)]
    file.tree["nodes"] = [*nodes, {"mesh": 0, **({"scale": scale} if scale else {})}]
    return file.write(path)


@settings(max_examples=30)
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


def test_a_node_moved_too_far_is_named(tmp_path):
    refused(scene(tmp_path / "a.glb", (1e17, 0.0, 0.0)), "node 1", "1e+17", units="m")


def test_a_node_of_scale_zero_is_flat_as_it_says(tmp_path):
    file = GltfFile()
    file.primitive(SQUARE, [0, 1, 2, 0, 2, 3])
    file.tree["nodes"] = [{"mesh": 0}, {"mesh": 0, "scale": [0.0, 0.0, 0.0]}]
    file.tree["scenes"] = [{"nodes": [0, 1]}]
    assert Target.load(file.write(tmp_path / "a.glb"), units="m").report.extents == (1.0, 1.0, 0.0)


def test_an_item_moved_too_far_is_named(tmp_path):
    item = '<item objectid="1" transform="1 0 0 0 1 0 0 0 1 1e17 0 0"/>'
    refused(three_mf(tmp_path / "a.3mf", BODY, item), "object '1'", "1e+17")


def test_coordinates_far_from_a_small_mesh_are_refused(tmp_path):
    path = tmp_path / "a.off"
    path.write_text("OFF\n3 1 0\n1e13 0 0\n10000000000001 0 0\n1e13 1 0\n3 0 1 2\n")
    refused(path, "1e+13", "rounding")


def test_an_origin_far_from_the_mesh_is_refused(tmp_path):
    path = tmp_path / "a.off"
    path.write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    with pytest.raises(MeshError, match=r"origin.*1e\+17"):
        Target.load(path, origin=[1e17, 0.0, 0.0])


# glTF -----------------------------------------------------------------------------------------------------------------


def test_one_large_mesh_in_many_nodes_is_counted(tmp_path):
    file = GltfFile()
    file.primitive(np.zeros((30_000, 3)))
    file.tree["nodes"] = [{"mesh": 0}] * 3000
    file.tree["scenes"] = [{"nodes": list(range(3000))}]
    refused(file.write(tmp_path / "a.glb"), "30000000 triangles", "20000000")


def test_one_accessor_in_many_primitives_is_counted(tmp_path):
    file = GltfFile()
    made = file.primitive(np.zeros((30_000, 3)))
    file.tree["meshes"][0]["primitives"] = [made] * 3000
    refused(file.write(tmp_path / "a.glb"), "30000000 triangles", "20000000")


def test_instances_that_take_no_bytes_are_counted(tmp_path):
    file = GltfFile()
    file.primitive(SQUARE, [0, 1, 2])
    rows, zero = file.view(b"\0\0\0\0"), file.view(b"\0" * 12)
    file.tree["accessors"].append(
        {
            "componentType": 5126,
            "type": "VEC3",
            "count": 9_000_000,
            "sparse": {
                "count": 1,
                "indices": {"bufferView": rows, "componentType": 5125},
                "values": {"bufferView": zero},
            },
        }
    )
    number = len(file.tree["accessors"]) - 1
    file.tree["nodes"] = [
        {"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": number}}}}
    ]
    refused(file.write(tmp_path / "a.glb"), "9000000", "100000")


@pytest.mark.long
def test_time_is_linear_in_nodes(tmp_path):
    file = GltfFile()
    file.primitive(SQUARE, [0, 1, 2])
    file.tree["nodes"] = [{"children": [i + 1]} for i in range(8_000)] + [{"mesh": 0}]
    with within(15.0):
        assert Target.load(file.write(tmp_path / "a.glb"), units="m").report.triangles == 1


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A mesh in its folder, with a buffer of the right length in each forbidden place."""
    top = tmp_path_factory.mktemp("places")
    (top / "in" / "deep").mkdir(parents=True)
    file = GltfFile()
    file.primitive(SQUARE, [0, 1, 2])
    file.write(top / "in" / "a.gltf")
    (top / "in" / "its numbers.bin").unlink()
    for place in ("out.bin", "in/b.bin", "in/deep/b.bin"):
        (top / place).write_bytes(file.data)
    (top / "in" / "link.bin").symlink_to(top / "out.bin")
    (top / "in" / "zero.bin").symlink_to("/dev/zero")
    (top / "in" / "up").symlink_to(top)
    (top / "in" / "near.bin").symlink_to("deep/b.bin")
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
    assert Target.load(named(folder, uri), units="m").report.triangles == 1


@pytest.mark.parametrize(
    ("uri", "said"),
    [
        ("../out.bin", "not in the mesh's folder"),
        ("%2e%2e/out.bin", "not in the mesh's folder"),
        ("..%2Fout.bin", "not in the mesh's folder"),
        ("%252e%252e/out.bin", "cannot be read"),
        ("link.bin", "not in the mesh's folder"),
        ("up/out.bin", "not in the mesh's folder"),
        ("../../../../../../../../etc/passwd", "not in the mesh's folder"),
        ("/dev/zero", "not in the mesh's folder"),
        ("zero.bin", "not in the mesh's folder"),
        ("pipe.bin", "no regular file"),
        ("deep", "no regular file"),
        ("", "no regular file"),
        ("long.bin", "bytes"),
        ("short.bin", "bytes"),
        ("http://example.com/b.bin", "cannot be read"),
        ("b.bin\0", "cannot be read"),
        (17, "uri"),
    ],
)
def test_a_buffer_elsewhere_is_refused(folder, uri, said):
    refused(named(folder, uri), said, "buffers 0")


def test_file_urls_and_absolute_paths_are_refused_even_where_they_lead_inside(folder):
    inside = folder / "in" / "b.bin"
    for uri in (str(inside), f"file://{inside}", f"//localhost{inside}"):
        refused(named(folder, uri), "buffers 0")


@settings(max_examples=40)
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


# OBJ ------------------------------------------------------------------------------------------------------------------

VERTICES = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"


@pytest.mark.parametrize("comment", ["# made by C:\\", "#\\", "v 0 0 9 # last \\", "g part # of C:\\"])
def test_an_obj_comment_does_not_continue(tmp_path, comment):
    path = tmp_path / "a.obj"
    path.write_text(f"{VERTICES}f 1 2 3\n{comment}\nf 1 3 4\n")
    assert Target.load(path).report.triangles == 2


@pytest.mark.parametrize("held", ["g part\\", "usemtl C:\\", "vt 0 0 \\", "f 1 2 3\\", "\\", "l 1 2 \\"])
@pytest.mark.parametrize("lost", ["f 1 3 4", "v 5 5 5", "  fo 1 3 4"])
def test_an_obj_statement_that_another_would_swallow_is_refused(tmp_path, held, lost):
    path = tmp_path / "a.obj"
    path.write_text(f"{VERTICES}f 1 2 3\n{held}\n{lost}\nf 1 2 4\n")
    refused(path, "line 7", "line 6")


def test_time_is_linear_in_continued_lines(tmp_path):
    path = tmp_path / "a.obj"
    path.write_text(VERTICES + "f 1 2 \\\n" + "3 4 \\\n" * 20_000 + "1\n")
    with within(15.0):
        assert any("into 40001 triangles" in action for action in Target.load(path).report.actions)


def test_an_obj_polygon_of_many_corners_is_read(tmp_path):
    path = tmp_path / "a.obj"
    path.write_text(VERTICES + "f " + "1 2 3 4 " * 15_000 + "\n")
    with within(15.0):
        assert any("into 59998 triangles" in action for action in Target.load(path).report.actions)


# Counts that are not there --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [4_000_000_000, 10**17])
def test_elements_that_are_declared_alone_are_refused(tmp_path, count):
    path = tmp_path / "a.ply"
    for kind in ("ascii", "binary_little_endian"):
        for properties in ("property float x\nproperty float y\nproperty float z\n", ""):
            head = f"ply\nformat {kind} 1.0\nelement vertex {count}\n{properties}"
            path.write_text(head + "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n")
            refused(path)
    path = tmp_path / "a.stl"
    path.write_bytes(b"\0" * 80 + struct.pack("<I", count % 2**32) + b"\0" * 50)
    refused(path, str(count % 2**32))
    path = tmp_path / "a.off"
    path.write_text(f"OFF\n{count} {count} 0\n0 0 0\n")
    refused(path, str(count))


def test_a_header_of_npy_that_declares_more_than_there_is_is_refused(tmp_path):
    path = tmp_path / "a.npy"
    np.save(path, np.zeros((4, 3)))
    path.write_bytes(path.read_bytes().replace(b"(4, 3)", b"(4000000000, 3)".ljust(6)))
    refused(path, thickness=0.1)
