"""`keepout measure FIELD`, end to end on a field whose errors are known to stay below its spacing."""

import json
import sys

import matplotlib.image
import numpy as np
import pytest
import trimesh

from keepout import cli
from keepout.fields.grid_build import build_grid
from keepout.geometry.target import Target
from keepout.proof.grid import certify_grid
from keepout.report.raster import rasterise

H = 0.1


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    target = Target.load("box", parameters={"length": 2.0, "width": 1.0, "height": 1.0})
    model = certify_grid(certify_grid(build_grid(target, spacing=H, band=0.8), target), target, chaser_radius=0.3)
    located = {"source": "box", "parameters": {"length": 2.0, "width": 1.0, "height": 1.0}}
    path = tmp_path_factory.mktemp("field") / "box.keepout"
    model.with_training(target=located).save(path)
    return path


@pytest.mark.long
def test_measure_prints_every_measure_and_draws(path, tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    monkeypatch.setattr(sys, "argv", ["keepout", "measure", str(path), "-o", str(out), "--json"])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    assert not stop.value.code
    summary = json.loads(capsys.readouterr().out)
    apart = summary["surface"]
    assert 0.0 < apart["chamfer"] <= apart["hausdorff"] <= 2.0 * H
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
    assert summary["near"]["root_mean_square"] <= H
    assert [entry["chaser_radius"] for entry in summary["certificates"]] == [0.0, 0.3]
    for entry in summary["certificates"]:
        assert -H < entry["sampled_maximum"] <= entry["error_bound"]
    for picture in summary["pictures"]:
        assert matplotlib.image.imread(picture).std() > 0.01


def test_a_rasterised_box_has_the_area_of_its_shadow():
    box = trimesh.creation.box((3.0, 2.0, 1.0))
    vertices, faces = np.asarray(box.vertices), np.asarray(box.faces)
    for elevation, azimuth, area in ((90.0, 0.0, 6.0), (0.0, 0.0, 2.0), (0.0, 90.0, 3.0), (0.0, 45.0, 5.0 / 2**0.5)):
        view = rasterise(vertices, faces, elevation=elevation, azimuth=azimuth, columns=400)
        left, right, bottom, top = view.extent
        assert view.hit.mean() * (right - left) * (top - bottom) == pytest.approx(area, rel=0.02)


def test_the_nearer_of_two_triangles_is_seen():
    triangle = np.array([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)])
    vertices = np.concatenate([np.add(triangle, (0.0, 0.0, height)) for height in (1.0, 0.0, 2.0, 0.5)])
    view = rasterise(vertices, np.arange(12).reshape(4, 3), elevation=90.0, azimuth=-90.0, columns=50)
    assert (view.face[view.hit] == 2).all()
