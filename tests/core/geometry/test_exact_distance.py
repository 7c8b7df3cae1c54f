"""Exact distance against libigl and closed forms; tests/core/audit/test_shared_code.py: exact arithmetic."""

import igl
import numpy as np
import pytest
from truths.messy_meshes import MESSY_AND_REAL

from keepout.core.errors import MeshError
from keepout.core.geometry.distance import DEEPEST, ExactDistance, tree_over
from keepout.core.geometry.octree import straddling_cells
from keepout.core.geometry.target import Target


def queries(distance, count, seed=0):
    rng = np.random.default_rng(seed)
    uniform = rng.uniform(distance.lower - 1.0, distance.upper + 1.0, size=(count, 3))
    _, closest, _ = distance.closest(uniform)
    return np.concatenate([uniform, closest + rng.normal(size=closest.shape) * 1e-2])


@pytest.mark.parametrize("mesh", MESSY_AND_REAL)
def test_agrees_with_libigl_on_real_and_messy_meshes(mesh, tmp_path):
    target = mesh(tmp_path)
    points = queries(target.distance, 3_000)
    d, closest, face = target.distance.closest(points)
    squared, _, _ = igl.point_mesh_squared_distance(points, target.vertices, target.faces)
    np.testing.assert_allclose(d, np.sqrt(squared), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(points - closest, axis=1), d, atol=1e-12)
    on_face = ExactDistance(target.vertices, target.faces[face[:60]]).distance(closest[:60])
    assert on_face.max() < 1e-9


def test_gradient_is_the_derivative():
    target = Target.load("intelsat30")
    points = queries(target.distance, 500)
    d, gradient = target.distance.distance_and_gradient(points)
    assert np.abs(np.linalg.norm(gradient, axis=1) - 1.0).max() < 1e-12
    step = 1e-6
    ahead = target.distance.distance(points + step * gradient)
    behind = target.distance.distance(points - step * gradient)
    away_from_medial_axis = np.abs(ahead - d - step) < 1e-9
    assert away_from_medial_axis.mean() > 0.98
    np.testing.assert_allclose(behind[d > step], d[d > step] - step, atol=1e-10)


def test_on_the_surface_the_gradient_is_zero_and_no_points_have_no_distance():
    triangle = ExactDistance(np.array([(0.0, 0, 0), (1, 0, 0), (0, 1, 0)]), np.array([(0, 1, 2)]))
    d, gradient = triangle.distance_and_gradient(np.array([[1.0, 0.0, 0.0]]))
    assert d[0] == 0.0
    assert (gradient == 0.0).all()
    assert triangle.distance(np.zeros((0, 3))).shape == (0,)


@pytest.mark.parametrize(
    ("vertices", "faces", "words"),
    [
        (np.zeros((3, 3)), np.zeros((0, 3), dtype=int), "at least one triangle"),
        (np.zeros((3, 3)), np.array([[0, 1, 3]]), "outside 0 to 2"),
        (np.full((3, 3), np.nan), np.array([[0, 1, 2]]), "not finite"),
    ],
)
def test_bad_meshes_are_refused(vertices, faces, words):
    with pytest.raises(MeshError, match=words):
        ExactDistance(vertices, faces)


@pytest.mark.long
@pytest.mark.parametrize("level", [0.0, 0.4])
def test_straddling_cells_cover_the_level_set(level):
    distance = Target.load("pocket").distance
    centres, half_widths = straddling_cells(distance, level, leaf=0.2)
    assert (2.0 * half_widths <= 0.2 + 1e-12).all()
    # Points on the level set: random points moved along the gradient, kept where the distance then is the level.
    points = np.random.default_rng(4).uniform(distance.lower - 1.0, distance.upper + 1.0, size=(500, 3))
    d, gradient = distance.distance_and_gradient(points)
    points = points + (level - d)[:, None] * gradient
    points = points[np.abs(distance.distance(points) - level) < 1e-12]
    assert len(points) > 100
    gap = np.abs(points[:, None] - centres).max(axis=2) - half_widths
    assert (gap.min(axis=1) <= 1e-9).all()
    # And none that provably misses it.
    assert (np.abs(distance.distance(centres) - level) <= np.sqrt(3) * half_widths + 1e-8).all()


def test_points_that_are_none_and_cells_of_no_size_are_refused():
    distance = Target.load("box").distance
    with pytest.raises(MeshError, match="finite"):
        distance.distance(np.array([[np.nan, 0.0, 0.0]]))
    with pytest.raises(MeshError, match="leaf"):
        straddling_cells(distance, 0.0, leaf=0.0)


def test_no_tree_is_deeper_than_a_query_has_room_for():
    """Each cut leaves a seventh of the triangles on either side, also of those of which each is half the one before."""
    halves = np.zeros((3000, 3, 3))
    halves[:, 1, 0] = halves[:, 2, 1] = 2.0 ** -np.linspace(0.0, 1000.0, 3000)
    for triangles in (halves, np.ones((3000, 3, 3)), np.random.default_rng(0).normal(size=(3000, 3, 3))):
        tree = tree_over(triangles)
        level = np.zeros(len(tree.amount), dtype=int)
        for node in np.flatnonzero(tree.amount == 0):
            level[[node + 1, tree.right[node]]] = level[node] + 1
        assert sorted(tree.face) == list(range(3000))
        assert level.max() < np.log(3000.0) / np.log(7.0 / 6.0) + 1.0
    assert np.log(1e8) / np.log(7.0 / 6.0) + 1.0 < DEEPEST
