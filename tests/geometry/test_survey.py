"""The survey of a mesh: its report, and sealed volumes that tell a leaking compartment from a closed one."""

import dataclasses
import json

import numpy as np
import pytest
import trimesh

from keepout.errors import MeshError
from keepout.geometry import Target, leak_check, survey

HALF, SLIT = 1.0, 0.2


def write_box(path, slit):
    """A sheet box of half side 1 m whose lid leaves a slit open along one edge."""
    mesh = trimesh.creation.box(extents=(2 * HALF, 2 * HALF, 2 * HALF))
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    lid = (vertices[faces][:, :, 2] == HALF).all(axis=1)
    edge = HALF - slit
    corners = np.array([(-HALF, -HALF, HALF), (edge, -HALF, HALF), (edge, HALF, HALF), (-HALF, HALF, HALF)])
    cover = np.array([(0, 1, 2), (0, 2, 3)]) + len(vertices)
    joined = np.concatenate([vertices, corners]), np.concatenate([faces[~lid], cover])
    trimesh.Trimesh(*joined, process=False).export(path)
    return path


def test_a_leaking_compartment_is_named(tmp_path):
    seen = []
    found = survey(
        Target.load(write_box(tmp_path / "leaks.ply", SLIT)), progress=lambda done, line: seen.append((done, line))
    )
    # The slit is 0.2 m wide: a ball of 0.25 m cannot pass it, one of 0.03 m can.
    assert found.sealed_volume == pytest.approx(8.0, rel=0.1)
    assert found.sealed_volume_at_offset < 0.5
    assert found.open_edges > 0
    leaks = [line for line in found.warnings if "leaks" in line]
    assert len(leaks) == 1
    assert "0.03 m" in leaks[0]
    assert "0.25 m" in leaks[0]
    assert [done for done, _ in seen] == sorted(done for done, _ in seen)
    assert seen[-1][0] == 1.0
    assert 0.0 < found.seconds < 600.0
    # Every field is plain: it survives JSON.
    again = json.loads(json.dumps(dataclasses.asdict(found)))
    for field in dataclasses.fields(found):
        value = getattr(found, field.name)
        assert again[field.name] == (list(value) if isinstance(value, tuple) else value)


def test_a_closed_compartment_is_not(tmp_path):
    target = Target.load(write_box(tmp_path / "closed.ply", 0.0))
    found = survey(target)
    assert not any("leaks" in line for line in found.warnings)
    assert found.sealed_volume_at_offset == pytest.approx(8.0, rel=0.1)
    assert found.sealed_volume == pytest.approx(found.sealed_volume_at_offset, rel=0.02)
    assert found.watertight
    assert found.sha256 == target.sha256
    report = target.report
    for field in dataclasses.fields(report):
        assert getattr(found, field.name) == getattr(report, field.name)
    assert found.extents == report.extents


def test_a_lone_sheet_seals_nothing_and_does_not_leak(tmp_path):
    (tmp_path / "one.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    found = survey(Target.load(tmp_path / "one.off"))
    assert found.sealed_volume < 0.05
    assert not any("leaks" in line for line in found.warnings)


def test_a_point_cloud_is_surveyed_too(tmp_path):
    # A shell of balls that touch: closed at either radius.
    points = trimesh.creation.icosphere(subdivisions=4, radius=1.0).vertices
    np.save(tmp_path / "shell.npy", points)
    found = survey(Target.load(tmp_path / "shell.npy", thickness=0.2))
    assert (found.points, found.triangles) == (len(points), 0)
    assert found.sealed_volume == pytest.approx(4.0 / 3.0 * np.pi * 1.1**3, rel=0.1)
    assert found.sealed_volume_at_offset == pytest.approx(found.sealed_volume, rel=0.1)


def test_bad_radii_are_named():
    with pytest.raises(MeshError, match="closing_radius"):
        leak_check(Target.load("box").distance, closing_radius=0.01)
