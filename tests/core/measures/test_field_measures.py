"""All measures of a field whose errors are known to stay below its spacing, and the pictures of its surface."""

import numpy as np
import pytest
import trimesh
from truths import small_box

from keepout.flights.pages.mesh_pictures import eye_axes, rasterise
from keepout.verbs.fields import measure_model


@pytest.mark.slow  # test_commands.py measures a field
def test_every_measure_of_a_grid_field():
    model, h = small_box.grid(), float(small_box.grid().field.spacing)
    summary, _ = measure_model(model, small_box.target())
    apart = summary["surface"]
    assert 0.0 < apart["chamfer"] <= apart["hausdorff"] <= 2.0 * h
    contact, grown = summary["volumes"]
    assert contact["hull"] == pytest.approx(2.0)
    assert contact["ellipsoid"] == pytest.approx(np.sqrt(3.0) * np.pi, rel=1e-3)
    steiner = 2.0 + 10.0 * 0.3 + 4.0 * np.pi * 0.09 + 4.0 / 3.0 * np.pi * 0.027
    assert grown["hull"] == pytest.approx(steiner)
    assert grown["contact"] == pytest.approx(steiner, rel=0.01)  # a box is its own hull
    for entry in (contact, grown):
        assert entry["learned"] >= 0.99 * entry["contact"]  # certified: it holds all of it
        assert entry["iou"] == pytest.approx(entry["contact"] / entry["learned"], rel=0.02)
    assert [entry["level"] for entry in summary["curvature"]] == [0.1, 0.3, 1.0]
    assert summary["near"]["root_mean_square"] <= h
    assert [entry["chaser_radius"] for entry in summary["certificates"]] == [0.0, small_box.RADIUS]
    for entry in summary["certificates"]:
        assert -h < entry["sampled_maximum"] <= entry["error_bound"]
        assert -h <= entry["margin"]["mean"] <= entry["margin"]["percentile_95"] < 3.0 * h


def test_a_rasterised_box_has_the_area_of_its_shadow():
    box = trimesh.creation.box((3.0, 2.0, 1.0))
    vertices, faces = np.asarray(box.vertices), np.asarray(box.faces)
    for elevation, azimuth, area in ((90.0, 0.0, 6.0), (0.0, 0.0, 2.0), (0.0, 90.0, 3.0), (0.0, 45.0, 5.0 / 2**0.5)):
        view = rasterise(vertices, faces, eye_axes(elevation, azimuth), columns=400)
        left, right, bottom, top = view.extent
        assert view.hit.mean() * (right - left) * (top - bottom) == pytest.approx(area, rel=0.02)


def test_the_nearer_of_two_triangles_is_seen():
    triangle = np.array([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)])
    vertices = np.concatenate([np.add(triangle, (0.0, 0.0, height)) for height in (1.0, 0.0, 2.0, 0.5)])
    view = rasterise(vertices, np.arange(12).reshape(4, 3), eye_axes(90.0, -90.0), columns=50)
    assert (view.face[view.hit] == 2).all()
