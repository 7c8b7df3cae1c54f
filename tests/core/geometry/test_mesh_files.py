"""OBJ, PLY, OFF, STL, 3MF and points: what a file declares is there whole, or it is refused; the rest is said."""

import io

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from truths.small_files import BODY, CORE, ITEM, MESH, METRES, SQUARE, refused, soup, three_mf, written

from keepout.core.geometry.target import Target

OBJ = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
OFF = "OFF\n4 2 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2\n3 0 2 3\n"
HEAD = (
    "ply\nformat ascii 1.0\ncomment made by hand\nelement vertex 4\n"
    "property float x\nproperty float y\nproperty float z\n"
    "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
)
PLY = HEAD + "0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2\n3 0 2 3\n"
TWO_LISTS = HEAD.replace("face 2", "face 1").replace("end_h", "property list uchar int vertex_index\nend_h")
STRIP = PLY.replace("element face 2", "element tristrips 1").replace("3 0 1 2\n3 0 2 3\n", "8 0 1 3 2 -1 0 1 2\n")
EDGES = HEAD.replace("end_header", "element edge 3\nproperty int vertex1\nproperty int vertex2\nend_header")
BOX = trimesh.creation.box(extents=(2.0, 2.0, 2.0))
BINARY, ASCII = BOX.export(file_type="stl"), BOX.export(file_type="stl_ascii")
FACET = "facet normal 0 0 1 outer loop vertex 0 0 0 vertex 1 0 0 vertex 0 1 0 endloop endfacet"
BEAMS = '<b:beamlattice xmlns:b="b"><b:beams><b:beam v1="0" v2="1"/><b:beam v1="1" v2="2"/></b:beams></b:beamlattice>'
LATTICE = 'xmlns:b="http://schemas.microsoft.com/3dmanufacturing/beamlattice/2017/02" requiredextensions="b"'
PRODUCTION = 'requiredextensions="p" xmlns:p="http://schemas.microsoft.com/3dmanufacturing/production/2015/06"'
ELSEWHERE = '<object id="9"><components><component objectid="1" p:path="/3D/part.model"/></components></object>'
PART = ("3D/part.model", f'<model xmlns="{CORE}"><resources>{BODY}</resources></model>')


def binary_ply(order=">", faces=((0, 1, 2), (0, 2, 3)), extra=b"", declared=None):
    name = "big" if order == ">" else "little"
    head = HEAD.replace("ascii", f"binary_{name}_endian").replace("face 2", f"face {declared or len(faces)}")
    body = SQUARE.astype(f"{order}f4").tobytes()
    for face in faces:
        body += bytes([len(face)]) + np.array(face, dtype=f"{order}i4").tobytes()
    return head.encode() + body + extra


def npy(array, **arguments):
    data = io.BytesIO()
    np.save(data, array, **arguments)
    return data.getvalue()


REFUSED = [
    # A face whose index points at no vertex, relative ones too, with its line and what is valid.
    ("a.obj", OBJ + "f 1 2 3\n# a remark\nf 1 2 5\n", "line 7", "index 5;", "valid is"),
    ("a.obj", OBJ + "f 0 1 2\n", "line 5", "index 0;"),
    ("a.obj", OBJ + "f -5 -2 -1\n", "line 5", "index -5;"),
    # Words that are no numbers, and statements that are none.
    ("a.obj", "v 0 0\n" + OBJ, "line 1"),
    ("a.obj", OBJ + "v 1 2 1_0\nf 1 2 3\n", "1_0"),
    ("a.obj", OBJ + "fac 1 2 3\n", "'fac'"),
    ("a.obj", OBJ + "f 1 2 \\", "end of the file"),
    # Faces behind a vertex on one line, as where line ends were lost.
    ("a.obj", OBJ + "v 2 0 0 f 1 2 3\nf 1 2 4\n", "line 5: after a vertex, 'f' is not a number"),
    # A statement that a backslash would make part of another.
    *(
        ("a.obj", f"{OBJ}f 1 2 3\n{held}\n{lost}\nf 1 2 4\n", "line 7", "line 6")
        for held in ("g part\\", "vt 0 0 \\", "f 1 2 3\\", "\\")
        for lost in ("f 1 3 4", "  fo 1 3 4")
    ),
    ("a.off", OFF.replace("3 0 2 3\n", ""), "4 vertex lines and 2 face lines", "4 and 1"),
    ("a.off", OFF.replace("4 2 0", "5 2 0"), "5 vertex lines", "5 and 1"),
    ("a.off", OFF.replace("3 0 2 3", "3 0 2 4"), "line 8", "index 4", "0 to 3"),
    ("a.off", OFF.replace("3 0 2 3", "3 0 2"), "line 8", "3 corners and has 2"),
    ("a.off", OFF.replace("3 0 2 3", "3 0 2 x"), "line 8", "'x'"),
    ("a.off", OFF.replace("1 1 0", "1 1"), "line 5", "2 numbers"),
    ("a.off", OFF.replace("OFF", "4OFF"), "4OFF"),
    ("a.off", "OFF\n4 x 0\n", "counts"),
    ("a.off", OFF.replace("0 1 0", "nan 1 0"), "not finite"),
    ("a.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n2 0 0\n3 0 1 2\n", "area"),
    *(
        ("a.off", f"OFF\n4 2 0\n-{far} 0 0\n{far} 0 0\n0 {far} 0\n0 0 {far}\n3 0 1 2\n3 0 1 3\n", "largest extent")
        for far in ("1e308", "1e200", "2e6")
    ),
    ("a.ply", PLY.replace("3 0 2 3\n", ""), "2 elements 'face'", "1 are there"),
    ("a.ply", PLY + "3 1 2 3\n", "6 lines", "there are 7"),
    ("a.ply", PLY.replace("3 0 2 3", "3 0 2 -1"), "index -1", "0 to 3"),
    ("a.ply", PLY.replace("3 0 2 3", "3 0 2"), "'face' number 1", "3 values"),
    ("a.ply", PLY.replace("3 0 2 3", "-3 0 2 3"), "'face' number 1"),
    ("a.ply", PLY.replace("1 1 0", "1 1"), "'vertex' number 2", "2 values"),
    ("a.ply", PLY.replace("property float z", "property float w"), "'z'"),
    ("a.ply", PLY.replace("element vertex", "element point"), "'vertex'"),
    ("a.ply", PLY.replace("vertex_indices", "corners"), "vertex_indices"),
    ("a.ply", PLY.replace("property float x", "property real x"), "line 5"),
    ("a.ply", PLY.replace("property float x", "property float a b x"), "line 5", "is not PLY"),
    ("a.ply", PLY[: len(HEAD) - 5], "end_header"),
    ("a.ply", PLY.replace("ascii", "unary"), "line 2"),
    ("a.ply", STRIP.replace("8 0 1 3 2 -1 0 1 2", "4 0 1 3 4"), "index 4"),
    ("a.ply", PLY.replace(HEAD, TWO_LISTS).replace("3 0 1 2\n", "3 0 1 2 "), "both vertex_indices and vertex_index"),
    ("a.ply", binary_ply()[:-1], "2 elements 'face'", "1 are there"),
    ("a.ply", binary_ply(declared=10**17), "elements 'face'", "2 are there"),
    ("a.ply", binary_ply(extra=b"\0"), "bytes"),
    ("a.stl", BINARY[:-1], "not a valid STL", "12 triangles", "684 bytes", "683"),
    ("a.stl", BINARY[:50], "not a valid STL", "50 bytes"),
    ("a.stl", b"\x93\xff\x00random bytes\x81" * 40, "not a valid STL"),
    ("a.stl", ASCII[: ASCII.index("endfacet", 900)], "not a valid STL", "whole facet", "line"),
    ("a.stl", ASCII.replace("vertex", "vertez", 1), "not a valid STL", "after 0 whole facets"),
    ("a.stl", ASCII.replace("1.0", "one", 9), "not a valid STL", "one"),
    ("a.stl", f"solid a\n{FACET}\nendsolid a {FACET}\n", "line 3 has a facet where a name belongs"),
    ("a.3mf", three_mf(BODY.replace('v3="3"', 'v3="4"')), "index 4", "0 to 3"),
    ("a.3mf", three_mf(BODY.replace('v3="3"', "")), "whole number"),
    ("a.3mf", three_mf(build='<item objectid="7"/>'), "'7'"),
    ("a.3mf", three_mf(build='<item objectid="1" transform="1 2 3"/>'), "twelve"),
    ("a.3mf", three_mf(build=""), "no triangles"),
    ("a.3mf", three_mf(attributes=LATTICE), "beamlattice"),
    ("a.3mf", three_mf(attributes='unit="parsec"'), "'parsec'", "micron"),
    # What may be there once: only the first mesh, the first build, the last part of a name would be read.
    ("a.3mf", three_mf(BODY + BODY), "two objects"),
    ("a.3mf", three_mf(BODY.replace("</mesh>", "</mesh>" + MESH)), "2 elements 'mesh'"),
    ("a.3mf", three_mf(build=f"{ITEM}</build><build>{ITEM}"), "2 elements 'build'"),
    ("a.3mf", three_mf(parts=[("3d/3DMODEL.model", "<model/>")]), "2 times"),
    ("a.glb", b"", "empty"),
    ("a.glb", "this is no mesh\n", "not readable"),
    ("a.step", "ISO-10303-21;", "suffix"),
    ("a.xyz", "1 2\n3 4\n", "three numbers"),
    ("a.npy", npy(np.array([{"a": 1}], dtype=object), allow_pickle=True), "not readable"),
]


@pytest.mark.parametrize("case", REFUSED)
def test_a_file_that_is_not_whole_is_refused(tmp_path, case):
    name, content, *words = case
    refused(written(tmp_path / name, content), *words, units=None if name == "a.3mf" else "m")


def test_what_is_no_file_is_refused(tmp_path):
    (tmp_path / "a.glb").mkdir()
    refused(tmp_path / "a.glb", "directory")
    refused(tmp_path / "none.glb", "no such file")


SPLIT = "split 1 polygon of more than three corners into 2 triangles"
READ = [
    ("a.obj", OBJ + "f 1 2 3\nl 1 2\nl 2 3 4\n", 1, "left out 2 line elements"),
    ("a.obj", OBJ + "f 1 2 3\ncstype bezier\ncurv 0 1 1 2 3 4\nparm u 0 1\nend\n", 1, "left out 1 free-form curve"),
    ("a.obj", OBJ + "f 1 2 3\ndeg 3 3\nsurf 0 1 0 1 1 2 3 4\nend\n", 1, "left out 1 free-form surface"),
    ("a.obj", OBJ + "f 1 2 3\nf 1 2\n", 1, "left out 1 polygon, of fewer than three corners"),
    ("a.obj", OBJ + "f 1 2 3 4\n", 2, SPLIT),
    ("a.obj", "v 0 1 0\nv 2 0 0\nv 0 -1 0\nv 1 0 0\nf 1 2 3 4\n", 2, SPLIT, "1 split polygon concave"),
    ("a.obj", "mtllib a.mtl\no part\n\tv\t0 0 0 # here\nv 1 0 0 1.0\nv 1 1 0 .5 .5 .5\ng a b\n f\t1 \\\n 2 3\n", 1),
    # A remark ends with its line, whatever it ends in.
    *(
        ("a.obj", f"{OBJ}f 1 2 3\n{remark}\nf 1 3 4\n", 2)
        for remark in ("# made by C:\\", "v 0 0 9 # last \\", "g part # of C:\\")
    ),
    ("a.off", OFF, 2),
    ("a.off", OFF.replace("OFF", "# a remark\n\nCOFF").replace("1 1 0\n", "1 1 0 0.5 0.5 0.5 1 # corner\n"), 2),
    ("a.off", OFF.replace("4 2 0", "4 2").replace("3 0 2 3", "3 0 2 3 255 0 0"), 2),
    ("a.ply", PLY.replace(HEAD, EDGES) + "0 1\n1 2\n2 3\n", 2, "left out 3 elements, 'edge'"),
    ("a.ply", STRIP, 3),
    ("a.ply", PLY.replace("vertex 4", "vertex 6").replace("0 1 0\n", "0 1 0\n7 7 7\n8 8 8\n"), 2, "left out 2 points"),
    *(("a.ply", binary_ply(order), 2) for order in "<>"),
    # The triangle is there once more in the split square.
    ("a.ply", binary_ply("<", ((0, 1, 2, 3), (0, 1, 2))), 2, SPLIT, "left out 1 duplicate faces"),
    ("a.ply", binary_ply(">", ((0, 1), (0, 1, 2))), 1, "left out 1 polygon, of fewer"),
    *(("a.stl", text, 12) for text in (BINARY, b"solid looks like text" + BINARY[21:], ASCII, ASCII.upper())),
    ("a.stl", ASCII + ASCII.replace("1.0", "3.0"), 24, "2 solids taken together"),
    ("a.3mf", three_mf(ELSEWHERE, '<item objectid="9"/>', f"{METRES} {PRODUCTION}", [PART]), 2),
    ("a.3mf", three_mf(head='<?xml version="1.0" encoding="UTF-16"?>', encoding="utf-16"), 2),
    ("a.3mf", three_mf(BODY.replace("</mesh>", BEAMS + "</mesh>")), 2, "left out 2 lattice beams"),
    ("a.3mf", three_mf(BODY + f'<object id="5">{MESH}</object>'), 2, "left out 1 mesh object, not in the build"),
    ("a.3mf", three_mf(BODY.replace("</triangles>", '<tri v1="0"/></triangles>')), 2, "1 element, 'tri' among"),
    # What is not printed is part of the target all the same.
    ("a.3mf", three_mf(build='<item objectid="1" printable="0"/>'), 2, "kept 1 build item that is not to be printed"),
    *(
        ("a.3mf", three_mf(BODY.replace('id="1"', f'id="1" type="{kind}"')), 2, f"an object of type '{kind}'")
        for kind in ("support", "solidsupport", "surface", "other")
    ),
]


@pytest.mark.parametrize("case", READ)
def test_a_whole_file_is_read_and_what_it_leaves_out_is_said(tmp_path, case):
    name, content, triangles, *said = case
    report = Target.load(written(tmp_path / name, content), units="m").report
    assert report.triangles == triangles
    actions = [line for line in report.actions if line != "left out 1 point that no triangle uses"]
    assert len(actions) == len(said)
    for word in said:
        assert any(word in line for line in actions), actions


@given(st.integers(3, 9), st.integers(0, 2**32 - 1))
def test_the_fan_of_a_flat_polygon_covers_it(tmp_path_factory, corners, seed):
    rng = np.random.default_rng(seed)
    # A star-shaped polygon round the origin, concave as a rule.
    angle = np.sort(rng.uniform(0.0, 2.0 * np.pi, size=corners))
    ring = np.column_stack([np.cos(angle), np.sin(angle)]) * rng.uniform(0.5, 2.0, size=(corners, 1))
    text = "".join(f"v {x!r} {y!r} 0\n" for x, y in ring.tolist()) + "f " + " ".join(map(str, range(1, corners + 1)))
    target = Target.load(written(tmp_path_factory.mktemp("fan") / "a.obj", text + "\n"), units="m")
    # Points inside by the even number of crossings with a ray, which knows nothing of fans.
    points = rng.uniform(-2.0, 2.0, size=(400, 2))
    (x, y), (nx, ny) = ring.T, np.roll(ring, -1, axis=0).T
    crosses = (y > points[:, 1:]) != (ny > points[:, 1:])
    at = x + (points[:, 1:] - y) * (nx - x) / np.where(ny == y, 1.0, ny - y)
    inside = (crosses & (points[:, :1] < at)).sum(axis=1) % 2 == 1
    assert (target.distance.distance(np.column_stack([points[inside], np.zeros(inside.sum())])) < 1e-9).all()


RELATIVE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\nv 5 0 0\nv 6 0 0\nv 5 1 0\nf -3//-1 -2//-1 -1//-1\n"
CORNER = SQUARE[[0, 1, 3]]
MOVED = "1 0 0 0 1 0 0 0 1 5 0 0"
TURNED = "0 1 0 -1 0 0 0 0 1 0 0 0"
COMPONENTS = "".join(f'<component objectid="1" transform="{place}"/>' for place in (MOVED, TURNED))
PLACED = three_mf(
    BODY + f'<object id="2"><components>{COMPONENTS}</components></object>',
    '<item objectid="2" transform="2 0 0 0 2 0 0 0 2 0 0 1"/><item objectid="1"/>',
)
SQUARES = (np.add(SQUARE, [5, 0, 0]) * 2 + [0, 0, 1], SQUARE[:, [1, 0, 2]] * [-2.0, 2, 0] + [0, 0, 1], SQUARE)


@pytest.mark.parametrize(
    ("name", "content", "triangles"),
    [
        ("a.obj", OBJ + "f 1//1 2//1 4//1\nf 2/1 3/2 4/3\nf 1 2 3\n", [CORNER, SQUARE[1:], SQUARE[:3]]),
        ("a.obj", RELATIVE, [CORNER, np.add(CORNER, [5, 0, 0])]),  # counted back from their line
        ("a.ply", STRIP, [SQUARE[[0, 1, 3]], SQUARE[[1, 3, 2]], SQUARE[[0, 1, 2]]]),
        ("a.3mf", PLACED, [square[corners] for square in SQUARES for corners in ([0, 1, 2], [0, 2, 3])]),
    ],
)
def test_every_triangle_is_in_its_place(tmp_path, name, content, triangles):
    target = Target.load(written(tmp_path / name, content))
    assert soup(target.vertices[target.faces]) == soup(triangles)


@pytest.mark.parametrize(("unit", "metres"), [("micron", 1e-6), ("millimeter", 1e-3), ("inch", 0.0254), (None, 1e-3)])
def test_three_mf_units(tmp_path, unit, metres):
    larger = BODY.replace('="1" y', f'="{2.0 / metres}" y').replace('y="1"', f'y="{2.0 / metres}"')
    content = three_mf(larger, attributes="" if unit is None else f'unit="{unit}"')
    assert Target.load(written(tmp_path / "a.3mf", content)).report.extents[0] == pytest.approx(2.0)


def test_units_that_contradict_the_file_are_refused(tmp_path):
    path = written(tmp_path / "a.3mf", three_mf())
    refused(path, "'mm'", "meter", "scale", units="mm")
    report = Target.load(path, scale=0.5).report
    assert report.extents[0] == 0.5
    assert any("meter" in line and "0.5" in line for line in report.actions)
