"""Built-in targets: closed, in one piece, of their public size, with the source paper's points where they should be."""

import sys

import numpy as np
import pytest
from truths.solids import solid_angle

from keepout.core.errors import MeshError
from keepout.core.geometry.builtin import BUILTINS
from keepout.core.geometry.target import Target, enclosed_volume

SIZES = {
    "intelsat30": ((26.8, 8.0, 6.1), 0.15),
    "iss": ((109.0, 80.0, 37.7), 0.4),
    "tiangong": ((41.0, 56.0, 5.0), 0.3),
    "box": ((4.0, 3.0, 2.0), 1e-12),
    "sphere": ((4.0, 4.0, 4.0), 1e-3),
    "pocket": ((6.0, 4.0, 6.0), 1e-12),
}
VOLUMES = {"box": 24.0, "pocket": 6 * 4 * 6 - 5.4 * 3.7 * 5.4}

STATION = pytest.param("iss", marks=pytest.mark.slow)  # of a hundred parts; the others have every kind of them


@pytest.mark.parametrize("name", sorted(BUILTINS))
def test_closed_single_and_of_public_size(name):
    target = Target.load(name)
    report = target.report
    assert report.watertight
    assert report.parts == 1
    size, tolerance = SIZES[name]
    assert report.extents == pytest.approx(size, abs=tolerance)
    volume = enclosed_volume(target.vertices, target.faces)
    assert volume == pytest.approx(VOLUMES[name]) if name in VOLUMES else volume > 0.0


def test_the_goal_of_the_source_paper_lies_inside_harmony():
    station, goal = Target.load("iss"), np.array([[0.0, -10.0, 6.0]])
    assert 0.5 < station.distance.distance(goal)[0] < 2.3
    assert solid_angle(station, goal)[0] == pytest.approx(4.0 * np.pi, abs=1e-5)


@pytest.mark.long
@pytest.mark.parametrize("name", ["intelsat30", STATION, "tiangong"])
def test_wings_turn_and_stretch(name):
    flat = Target.load(name).report.extents
    upright = Target.load(name, parameters={"wing_angle": np.pi / 2}).report
    assert upright.watertight
    assert upright.extents[2] > flat[2] + 0.3
    span = BUILTINS[name].parameters["wing_span"]
    longer = Target.load(name, parameters={"wing_span": span.default + 5.0}).report.extents
    assert max(np.subtract(longer, flat)) > 1.9


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        ({"parameters": {"wing_angel": 0.1}}, "wing_angel"),
        ({"parameters": {"wing_span": 1.0}}, "wing_span"),
        ({"parameters": {"wing_span": float("nan")}}, "wing_span"),
        ({"units": "mm"}, "metres"),
    ],
)
def test_bad_parameters_are_named(arguments, word):
    with pytest.raises(MeshError, match=word):
        Target.load("intelsat30", **arguments)


@pytest.mark.parametrize("name", ["intelsat30", STATION, "tiangong", "pocket"])
def test_whoever_holds_its_parts_a_target_is_the_same(name):
    """As a debugger or a profiler does: a field is for these triangles, and would be refused."""
    alone, held = Target.load(name).sha256, []
    profiled = sys.getprofile()
    sys.setprofile(lambda frame, *_: held.append(frame) if "geometry" in frame.f_code.co_filename else None)
    try:
        watched = Target.load(name).sha256
    finally:
        sys.setprofile(profiled)
    assert held
    assert watched == alone
