"""The survey of a mesh: its report, and sealed volumes that tell a leaking compartment from a closed one."""

import numpy as np
import pytest
import trimesh
from truths.solids import hollow_box

from keepout.core.geometry.target import Target
from keepout.verbs.meshes import survey


def loaded(tmp_path, half_hole):
    """A sheet box of half side 1.5 m, closed or with a square hole in its lid."""
    vertices, faces, _ = hollow_box(half_hole)
    vertices = np.concatenate([vertices, np.zeros((1, 3))])
    trimesh.Trimesh(vertices, faces, process=False).export(tmp_path / "box.ply")
    return Target.load(tmp_path / "box.ply")


@pytest.mark.long
def test_a_leaking_compartment_is_named(tmp_path):
    seen = []
    found = survey(loaded(tmp_path, 0.1), progress=lambda done, line: seen.append(done))
    # The hole is 0.2 m wide: a ball of 0.25 m cannot pass it, one of 0.03 m can.
    assert found["sealed_volume"] == pytest.approx(27.0, rel=0.1)
    assert found["sealed_volume_at_offset"] < 1.5
    assert found["open_edges"] > 0
    (leak,) = [line for line in found["warnings"] if "leaks" in line]
    assert "0.03 m" in leak
    assert "0.25 m" in leak
    assert seen == sorted(seen)
    assert seen[-1] == 1.0


@pytest.mark.long
def test_a_closed_compartment_is_not():
    target = Target.load("box")
    found = survey(target)
    assert not any("leaks" in line for line in found["warnings"])
    assert found["sealed_volume_at_offset"] == pytest.approx(24.0, rel=0.1)
    assert found["sealed_volume"] == pytest.approx(found["sealed_volume_at_offset"], rel=0.02)
    assert found["sha256"] == target.sha256
    assert all(found[name] == value for name, value in vars(target.report).items())


def test_a_point_cloud_is_surveyed_too(tmp_path):
    # A shell of balls that touch: closed at either radius.
    points = trimesh.creation.icosphere(subdivisions=3, radius=1.0).vertices
    np.save(tmp_path / "shell.npy", points)
    found = survey(Target.load(tmp_path / "shell.npy", thickness=0.4))
    assert (found["points"], found["triangles"]) == (len(points), 0)
    assert found["sealed_volume"] == pytest.approx(4.0 / 3.0 * np.pi * 1.2**3, rel=0.1)
    assert found["sealed_volume_at_offset"] == pytest.approx(found["sealed_volume"], rel=0.1)
