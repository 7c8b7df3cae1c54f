"""3MF: items, components and parts elsewhere in their places; a reference that leads nowhere is refused."""

import zipfile

import numpy as np
import pytest

from keepout.errors import MeshError
from keepout.geometry import Target

CORE = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
TRIANGLES = '<triangle v1="0" v2="1" v3="2"/><triangle v1="0" v2="2" v3="3"/>'
CORNERS = "".join(f'<vertex x="{x}" y="{y}" z="0"/>' for x, y in ((0, 0), (1, 0), (1, 1), (0, 1)))
MESH = f"<mesh><vertices>{CORNERS}</vertices><triangles>{TRIANGLES}</triangles></mesh>"


def soup(triangles):
    """Triangles as a sorted set of sorted corners: the surface, whatever the order."""
    return sorted(tuple(sorted(map(tuple, t))) for t in (np.asarray(triangles).round(6) + 0.0).tolist())


def three_mf(path, resources, build, attributes='unit="meter"', parts=()):
    with zipfile.ZipFile(path, "w") as archive:
        model = f'<model xmlns="{CORE}" {attributes}><resources>{resources}</resources><build>{build}</build></model>'
        archive.writestr("3D/3dmodel.model", model)
        for name, content in parts:
            archive.writestr(name, content)
    return path


ITEM = '<item objectid="1"/>'
BODY = f'<object id="1">{MESH}</object>'


def test_three_mf_components_are_multiplied_out(tmp_path):
    parts = (
        '<object id="2"><components><component objectid="1" transform="1 0 0 0 1 0 0 0 1 5 0 0"/>'
        '<component objectid="1" transform="0 1 0 -1 0 0 0 0 1 0 0 0"/></components></object>'
    )
    build = '<item objectid="2" transform="2 0 0 0 2 0 0 0 2 0 0 1"/><item objectid="1"/>'
    target = Target.load(three_mf(tmp_path / "a.3mf", BODY + parts, build))
    square = np.array([(0.0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)])
    turned = square @ np.array([(0, 1, 0), (-1, 0, 0), (0, 0, 1)])
    truth = [
        c[list(t)]
        for c in ((square + np.array([5.0, 0, 0])) * 2 + [0, 0, 1], turned * 2 + [0, 0, 1], square)
        for t in ((0, 1, 2), (0, 2, 3))
    ]
    assert soup(target.vertices[target.faces]) == soup(truth)


def test_three_mf_parts_elsewhere(tmp_path):
    production = (
        'unit="meter" requiredextensions="p" xmlns:p="http://schemas.microsoft.com/3dmanufacturing/production/2015/06"'
    )
    resources = (
        '<object id="9"><components><component objectid="1" p:path="/3D/Objects/part.model"/></components></object>'
    )
    part = f'<model xmlns="{CORE}"><resources>{BODY}</resources></model>'
    path = three_mf(
        tmp_path / "a.3mf", resources, '<item objectid="9"/>', production, [("3D/Objects/part.model", part)]
    )
    assert Target.load(path).report.triangles == 2


@pytest.mark.parametrize(
    ("resources", "build", "attributes", "words"),
    [
        (BODY.replace('v3="3"', 'v3="4"'), ITEM, "", ("index 4", "0 to 3")),
        (BODY.replace('v3="3"', 'v3="-1"'), ITEM, "", ("index -1",)),
        (BODY.replace('v3="3"', ""), ITEM, "", ("whole number",)),
        (BODY.replace('y="1"', 'y="one"', 1), ITEM, "", ("one",)),
        (BODY, '<item objectid="7"/>', "", ("'7'",)),
        (BODY + BODY, ITEM, "", ("two objects",)),
        (
            BODY + '<object id="2"><components><component objectid="2"/></components></object>',
            '<item objectid="2"/>',
            "",
            ("itself",),
        ),
        (BODY, '<item objectid="1" transform="1 2 3"/>', "", ("twelve",)),
        (BODY, "", "", ("no triangles",)),
        (
            BODY,
            ITEM,
            'xmlns:b="http://schemas.microsoft.com/3dmanufacturing/beamlattice/2017/02" requiredextensions="b"',
            ("beamlattice",),
        ),
        (BODY, ITEM, 'unit="parsec"', ("'parsec'", "micron")),
    ],
)
def test_three_mf_that_is_not_whole_is_refused(tmp_path, resources, build, attributes, words):
    path = three_mf(tmp_path / "a.3mf", resources, build, attributes)
    with pytest.raises(MeshError) as refused:
        Target.load(path)
    for word in (*words, "a.3mf"):
        assert word in str(refused.value)


def test_three_mf_says_what_it_leaves_out(tmp_path):
    beams = '<b:beams><b:beam v1="0" v2="1"/><b:beam v1="1" v2="2"/></b:beams>'
    beams = f'<b:beamlattice xmlns:b="b">{beams}</b:beamlattice></mesh>'
    path = three_mf(tmp_path / "a.3mf", BODY.replace("</mesh>", beams) + f'<object id="5">{MESH}</object>', ITEM)
    assert set(Target.load(path).report.actions) == {
        "left out 2 lattice beams",
        "left out 1 mesh object, not in the build",
    }


@pytest.mark.parametrize(("unit", "metres"), [("micron", 1e-6), ("millimeter", 1e-3), ("inch", 0.0254), (None, 1e-3)])
def test_three_mf_units(tmp_path, unit, metres):
    attributes = "" if unit is None else f'unit="{unit}"'
    size = str(2.0 / metres)
    path = three_mf(
        tmp_path / "a.3mf", BODY.replace('x="1"', f'x="{size}"').replace('y="1"', f'y="{size}"'), ITEM, attributes
    )
    assert Target.load(path).report.extents[0] == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("resources", "build", "parts", "said"),
    [
        (BODY.replace("</mesh>", "</mesh>" + MESH), ITEM, (), "2 elements 'mesh'"),
        (BODY, ITEM + "</build><build>" + ITEM, (), "2 elements 'build'"),
        (BODY, ITEM, (("3d/3DMODEL.model", "<model/>"),), "twice|2 times"),
    ],
)
def test_three_mf_what_may_be_there_once_is_refused_twice(tmp_path, resources, build, parts, said):
    """Only the first mesh, the first build and the last part of a name were read, without a word."""
    path = three_mf(tmp_path / "a.3mf", resources, build, parts=parts)
    with pytest.raises(MeshError, match=said):
        Target.load(path)


def test_three_mf_a_strange_element_among_triangles_is_an_action(tmp_path):
    body = BODY.replace("</triangles>", '<tri v1="0" v2="1" v3="3"/></triangles>')
    target = Target.load(three_mf(tmp_path / "a.3mf", body, ITEM))
    assert any("1 element, 'tri' among triangles" in action for action in target.report.actions)
