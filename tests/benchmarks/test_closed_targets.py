"""Closed versions of targets: sheets become slabs, voids are filled, and a moved panel is where it is said to be."""

import closed_targets
import numpy as np
import pytest

from keepout.geometry.builtin.solids import box, mesh
from keepout.geometry.mesh_report import Surface, describe
from keepout.geometry.shape import enclosed_volume
from keepout.geometry.target import Target

T = closed_targets.THICKNESS


def made(vertices, faces) -> Target:
    vertices, faces = np.asarray(vertices, dtype=float), np.asarray(faces, dtype=np.int64)
    return Target("made", vertices, faces, describe(Surface(vertices, faces)))


def test_an_open_sheet_becomes_a_slab_of_its_area_times_the_thickness():
    sheet = made([[0, 0, 0], [2, 0, 0], [2, 3, 0], [0, 3, 0]], [[0, 1, 2], [0, 2, 3]])
    assert sheet.report.open_edges == 4
    vertices, faces = mesh(closed_targets._closed(sheet))
    closed = made(vertices, faces)
    assert closed.report.watertight
    assert enclosed_volume(vertices, faces) == pytest.approx(6.0 * T, rel=1e-6)
    assert closed.report.upper[2] - closed.report.lower[2] == pytest.approx(T)


def test_a_closed_part_that_faces_inwards_is_the_same_solid_and_a_box_of_open_sheets_is_filled():
    vertices, faces = mesh(box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)))
    flat = [[3, 0, 0], [4, 0, 0], [4, 1, 0]]
    inwards = made(np.vstack([vertices, flat]), np.vstack([faces[:, ::-1], [[8, 9, 10]]]))
    volume = closed_targets._closed(inwards).volume()
    assert volume == pytest.approx(1.0 + 0.5 * T, rel=1e-6)
    # Each triangle apart from its neighbours and a little over them: nothing but open sheets, and a hollow inside.
    corners = vertices[faces]
    corners = corners.mean(axis=1, keepdims=True) + 1.001 * (corners - corners.mean(axis=1, keepdims=True))
    torn = made(corners.reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3))
    assert torn.report.open_edges == 3 * len(faces)
    assert closed_targets._closed(torn).volume() > 1.0


def test_what_is_thinner_than_the_sensors_width_is_measured():
    for thickness, share in ((0.03, 0.9), (0.3, 0.0)):
        target = made(*mesh(box((0.0, 0.0, 0.0), (2.0, 2.0, thickness))))
        thin, least = closed_targets.thin_share(target)
        assert thin == pytest.approx(share, abs=0.1)
        assert least == pytest.approx(thickness, rel=1e-3)


@pytest.mark.parametrize("name", ["intelsat30", "tiangong"])
def test_a_panel_is_moved_by_a_metre_or_more_and_the_rest_is_not(name):
    moved = closed_targets.moved_panel(name, 1)
    assert moved.true.report.open_edges == 0
    assert 1.0 <= moved.moved < 2.6
    corners = moved.true.vertices
    assert moved.moved - 0.4 < moved.expected.distance.distance(corners).max() < moved.moved + 0.05
    along, reach = closed_targets.HINGES[name]
    body = moved.expected.vertices[np.abs(moved.expected.vertices[:, along]) < reach - 0.1]
    assert moved.true.distance.distance(body).max() < 1e-6
    again = closed_targets.moved_panel(name, 1)
    assert again.true.sha256 == moved.true.sha256
    assert closed_targets.moved_panel(name, 2).true.sha256 != moved.true.sha256
