"""Volumes and overlap against closed forms."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.spatial
import trimesh

from keepout.errors import FieldError
from keepout.fields.analytic import SphereField
from keepout.geometry.distance import ExactDistance
from keepout.geometry.offset_solid import OffsetSolid
from keepout.geometry.shape import Ellipsoid
from keepout.geometry.target import Target
from keepout.measures.volume import grown_ellipsoid_volume, grown_hull_volume, measure_volumes

pytestmark = pytest.mark.long


def ball_volume(radius):
    return 4.0 / 3.0 * np.pi * radius**3


def grown_box(sides, radius):
    a, b, c = sides
    return a * b * c + 2 * radius * (a * b + b * c + c * a) + np.pi * radius**2 * (a + b + c) + ball_volume(radius)


@pytest.mark.parametrize("radius", [0.0, 0.5, 3.0])
def test_a_grown_box_as_hull(radius):
    corners = np.array([(x, y, z) for x in (0, 3.0) for y in (0, 1.0) for z in (0, 0.5)])
    inside = np.random.default_rng(0).uniform(size=(20, 3)) * [3.0, 1.0, 0.5]
    hull = scipy.spatial.ConvexHull(np.concatenate([corners, inside]))
    assert grown_hull_volume(hull, radius) == pytest.approx(grown_box((3.0, 1.0, 0.5), radius), rel=1e-9)


def test_a_grown_ellipsoid_against_a_grown_polyhedron():
    sphere = trimesh.creation.icosphere(subdivisions=5)
    hull = scipy.spatial.ConvexHull(np.asarray(sphere.vertices) * [3.0, 2.0, 0.7])
    ellipsoid = Ellipsoid(np.zeros(3), np.diag([1 / 9.0, 1 / 4.0, 1 / 0.49]))
    for radius in (0.0, 0.5, 2.0):
        assert grown_ellipsoid_volume(ellipsoid, radius) == pytest.approx(grown_hull_volume(hull, radius), rel=2e-3)
    ball = Ellipsoid(np.zeros(3), np.eye(3) / 4.0)
    assert grown_ellipsoid_volume(ball, 0.5) == pytest.approx(ball_volume(2.5), rel=1e-12)


def test_a_ball_measured_against_itself_and_against_a_larger_one():
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=1.0)
    solid = OffsetSolid.build(ExactDistance(np.asarray(mesh.vertices), np.asarray(mesh.faces)))
    field = SphereField(jnp.zeros(3), jnp.asarray(1.0))
    same, larger, grown = measure_volumes(
        field, solid, [(0.0, 0.03), (0.0, 0.4), (0.5, 0.5)], steepest=1.0, leaf=0.05, seed=1
    )
    for found, radius in ((same, 1.03), (larger, 1.4), (grown, 1.5)):
        assert found.learned == pytest.approx(ball_volume(radius), abs=4.0 * found.standard_error)
    assert same.contact == larger.contact == pytest.approx(ball_volume(1.03), rel=0.01)
    assert grown.contact == pytest.approx(ball_volume(1.5), rel=0.005)
    assert same.iou > 0.98
    assert larger.iou == pytest.approx((1.03 / 1.4) ** 3, rel=0.02)
    assert same.hull <= ball_volume(1.0) <= same.ellipsoid * (1.0 + 1e-9)
    assert grown.ellipsoid == pytest.approx(ball_volume(1.5), rel=1e-3)


def test_a_thin_sheet_is_not_lost_between_the_cells():
    sheet = np.array([(0, 0, 0), (2.0, 0, 0), (2.0, 2.0, 0), (0, 2.0, 0)], dtype=float)
    # A sheet has no hull; a second one across it gives it some height.
    fin = sheet[:, [0, 2, 1]] + [0.0, 1.0, 0.0]
    distance = ExactDistance(np.concatenate([sheet, fin]), np.array([(0, 1, 2), (0, 2, 3), (4, 5, 6), (4, 6, 7)]))
    solid = OffsetSolid.build(distance, offset=0.03)
    field = SphereField(jnp.zeros(3), jnp.asarray(0.5))
    [found] = measure_volumes(field, solid, [(0.03, 0.0)], steepest=1.0, leaf=0.1, seed=0)
    plate = 4.0 * 0.06 + np.pi * 0.03**2 / 2 * 8.0 + ball_volume(0.03)
    assert found.contact == pytest.approx(2.0 * plate - 0.06 * 0.06 * 2.0, rel=0.08)


def test_refusals():
    solid = OffsetSolid.build(Target.load("box").distance)
    field = SphereField(jnp.zeros(3), jnp.asarray(1.0))
    with pytest.raises(FieldError, match="at least one"):
        measure_volumes(field, solid, [], steepest=1.0)
    with pytest.raises(FieldError, match="leaf 0 m"):
        measure_volumes(field, solid, [(0.0, 0.0)], steepest=1.0, leaf=0.0)
