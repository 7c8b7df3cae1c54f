"""Zones from mesh files: their planes, and the audit's own distance, against libigl and rotated boxes by definition."""

import igl
import jax
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from keepout.core.audit import zones as judged
from keepout.core.errors import KeepoutError, MeshError
from keepout.core.fields import zones
from keepout.core.geometry.hulls import hulls_of
from keepout.core.mission.approach import zone_shape
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.task_entries import ZoneEntry

TURN = Rotation.from_euler("xyz", [0.3, -0.5, 0.9]).as_matrix()
SIZE, AT = np.array([3.0, 1.0, 0.5]), np.array([1.0, 2.0, -1.0])
_RNG = np.random.default_rng(3)


@pytest.fixture
def two_parts(tmp_path):
    """A turned box, and a sphere with few sides beside it, in centimetres."""
    box = trimesh.creation.box(SIZE)
    box.apply_transform(np.block([[TURN, AT[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]]))
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.8).apply_translation([-2.0, 0.0, 0.5])
    whole = trimesh.util.concatenate([box, ball]).apply_scale(100.0)
    path = tmp_path / "beam.stl"
    whole.export(path)
    return str(path)


def test_of_each_part_its_hull_counts(two_parts):
    parts = hulls_of(two_parts, "cm")
    assert len(parts) == 2
    shape = zone_shape(ZoneEntry(shape="mesh", file=two_parts, units="cm"))
    distance = judged.mesh([(hull.corners, hull.faces) for hull in parts])
    points = _RNG.uniform(-4.0, 4.0, (20_000, 3))
    flown, found = np.asarray(jax.vmap(shape.distance)(points)), distance(points)
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.8).apply_translation([-2.0, 0.0, 0.5])
    inside = np.all(np.abs((points - AT) @ TURN) < 0.5 * SIZE, axis=1)
    offsets = (ball.face_normals * ball.triangles_center).sum(axis=1)
    inside |= np.all(points @ ball.face_normals.T < offsets, axis=1)
    box = trimesh.creation.box(SIZE)
    corners = np.concatenate([box.vertices @ TURN.T + AT, ball.vertices])
    squared, _, _ = igl.point_mesh_squared_distance(points, corners, np.concatenate([box.faces, ball.faces + 8]))
    np.testing.assert_array_equal(flown < 0.0, inside)
    np.testing.assert_allclose(found, np.where(inside, 0.0, np.sqrt(squared)), atol=1e-5)
    assert np.all(flown <= found + 1e-6)
    # What the planes leave out is least beside a face, and at most beside a corner.
    assert np.quantile(flown[~inside] / found[~inside], 0.05) > 0.5


def test_no_distance_to_planes_changes_faster_than_the_way(two_parts):
    distance = jax.vmap(zone_shape(ZoneEntry(shape="mesh", file=two_parts, units="cm")).distance)
    first = _RNG.uniform(-5.0, 5.0, (5000, 3))
    second = first + _RNG.normal(size=first.shape) * _RNG.exponential(0.5, (len(first), 1))
    change = np.abs(np.asarray(distance(first)) - np.asarray(distance(second)))
    assert np.all(change <= np.linalg.norm(first - second, axis=1) + 1e-12)


def test_a_sheet_counts_as_thin(tmp_path):
    path = tmp_path / "sheet.off"
    path.write_text("OFF\n4 2 0\n0 0 0\n2 0 0\n2 1 0\n0 1 0\n3 0 1 2\n3 0 2 3\n")
    shape = zone_shape(ZoneEntry(shape="mesh", file=str(path)))
    assert float(shape.distance(np.array([1.0, 0.5, 0.0]))) < 0.0
    assert float(shape.distance(np.array([1.0, 0.5, 0.0011]))) > 0.0
    assert isinstance(shape, zones.Mesh)


def test_what_cannot_be_a_zone_is_refused(tmp_path):
    path = tmp_path / "round.stl"
    trimesh.creation.icosphere(subdivisions=4).export(path)
    with pytest.raises(MeshError, match=r"round\.stl: 1 parts, .* 5120 together, and at most 4096 are flown"):
        hulls_of(str(path), "m")
    with pytest.raises(MeshError, match=r"nothere\.stl"):
        hulls_of(str(tmp_path / "nothere.stl"), None)
    for zone, said in (
        ({"shape": "mesh"}, 'shape "mesh" is made of file, and has none'),
        ({"shape": "sphere", "centre": [0, 0, 0], "radius": 1, "units": "m"}, 'units "m": they are those of the file'),
    ):
        with pytest.raises(KeepoutError, match=said):
            Scenario.of({"zone": [zone]})
    (tmp_path / "mission.toml").write_text('[[zone]]\nshape = "mesh"\nfile = "round.stl"\n')
    assert Scenario.load(tmp_path / "mission.toml").zone[0].file == str(path)
