"""Zones from mesh files: their planes, and the audit's own distance, against libigl and rotated boxes by definition."""

import igl
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from keepout.core.audit import zones as judged
from keepout.core.errors import KeepoutError
from keepout.core.fields import zones
from keepout.core.geometry.hulls import hulls_of
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.task_entries import ZoneEntry
from keepout.core.mission.zones import with_digests, zone_shape

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
    hulls = hulls_of(two_parts, "cm")
    assert len(hulls.parts) == 2
    shape = zone_shape(ZoneEntry(shape="mesh", file=two_parts, units="cm"))
    distance = judged.mesh(hulls)
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
    assert float(shape.distance(jnp.array([1.0, 0.5, 0.0]))) < 0.0
    assert float(shape.distance(jnp.array([1.0, 0.5, 0.0011]))) > 0.0
    assert isinstance(shape, zones.Mesh)
    # Turned, and written in single precision: not flat to the last digit.
    turned = tmp_path / "turned.stl"
    sheet = trimesh.Trimesh([[0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    sheet.apply_transform(np.block([[TURN, AT[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]]))
    sheet.export(turned)
    shape = zone_shape(ZoneEntry(shape="mesh", file=str(turned)))
    beside = jnp.asarray(TURN @ [50.0, 0.5, 0.0] + AT)
    assert 40.0 < float(shape.distance(beside)) < 48.0


def test_what_cannot_be_a_zone_is_refused(tmp_path):
    path = tmp_path / "round.stl"
    trimesh.creation.icosphere(subdivisions=4).export(path)
    for file, said in (("nothere.stl", "cannot be read"), ("round.stl", "5120 together, and at most 4096 are flown")):
        scenario = Scenario.of({"zone": [{"name": "arm", "shape": "mesh", "file": str(tmp_path / file)}]})
        with pytest.raises(KeepoutError, match=rf'zone "arm": file .*{file}: .*{said}'):
            with_digests(scenario)
    for zone, said in (
        ({"shape": "mesh"}, 'shape "mesh" is made of file, and has none'),
        (
            {"shape": "sphere", "centre": [0, 0, 0], "radius": 1, "units": "m"},
            'units "m": of the file of a mesh, and there is none',
        ),
    ):
        with pytest.raises(KeepoutError, match=said):
            Scenario.of({"zone": [zone]})
    (tmp_path / "mission.toml").write_text('[[zone]]\nshape = "mesh"\nfile = "round.stl"\n')
    assert Scenario.load(tmp_path / "mission.toml").zone[0].file == str(path)


def test_a_mesh_that_has_changed_since_it_was_flown_is_refused(two_parts):
    scenario = with_digests(Scenario.of({"zone": [{"shape": "mesh", "file": two_parts, "units": "cm"}]}))
    assert with_digests(scenario) is scenario
    trimesh.creation.box(SIZE).export(two_parts)
    with pytest.raises(KeepoutError, match=r"zone 0: file .*beam\.stl: not the mesh that was flown"):
        with_digests(scenario)
