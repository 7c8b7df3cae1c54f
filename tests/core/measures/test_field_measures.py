"""All measures of a field whose errors are known to stay below its spacing, and the pictures of its surface."""

import numpy as np
import pytest
import trimesh

from keepout.flights.pages.mesh_pictures import eye_axes, rasterise


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
