"""Extracted surfaces, and the distances between them, against closed forms."""

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from keepout.errors import FieldError
from keepout.fields.analytic import SphereField
from keepout.geometry.distance import ExactDistance
from keepout.geometry.offset_solid import OffsetSolid
from keepout.geometry.shape import enclosed_volume
from keepout.geometry.target import Target
from keepout.measures.surface import extract_surface, steepest_slope, surface_distance, visible_points

MIDDLE = np.array([0.3, -0.2, 0.1])


@pytest.fixture(scope="module")
def ball():
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=1.0)
    return ExactDistance(np.asarray(mesh.vertices) + MIDDLE, np.asarray(mesh.faces))


def sphere(radius):
    return SphereField(jnp.asarray(MIDDLE), jnp.asarray(radius))


def test_a_level_of_a_sphere_is_the_larger_sphere(ball):
    surface = extract_surface(sphere(1.0), ball, 0.2, steepest=1.0, spacing=0.05)
    off = np.linalg.norm(surface.vertices - MIDDLE, axis=1) - 1.2
    assert np.abs(off).max() < 0.05**2  # linear interpolation along an edge of the grid
    volume = enclosed_volume(surface.vertices, surface.faces)  # positive only if the normals point outwards
    assert volume == pytest.approx(4.0 / 3.0 * np.pi * 1.2**3, rel=2e-3)
    # Slabs fit together: every edge lies in two triangles once equal vertices are joined.
    welded = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    welded.merge_vertices(digits_vertex=6)
    assert welded.is_watertight


def test_spacing_is_refined_without_a_larger_steepness_changing_the_surface(ball):
    lean = extract_surface(sphere(1.0), ball, 0.0, steepest=1.0, spacing=0.1)
    generous = extract_surface(sphere(1.0), ball, 0.0, steepest=3.0, spacing=0.1)
    assert len(lean.faces) == len(generous.faces)
    assert steepest_slope(sphere(1.0), ball) == pytest.approx(1.2)


def test_distances_between_concentric_spheres(ball):
    solid = OffsetSolid.build(ball)
    surface = extract_surface(sphere(1.0), ball, 0.15, steepest=1.0, spacing=0.05)
    apart = surface_distance(surface, solid, 0.15, count=20_000)
    for found in (apart.learned_to_target, apart.target_to_learned, apart.chamfer, apart.hausdorff):
        assert found == pytest.approx(0.15, abs=4e-3)
    assert apart.hidden_share == 0.0


def test_a_bump_shows_in_the_hausdorff_distance_of_one_side(ball):
    solid = OffsetSolid.build(ball)
    grown = trimesh.creation.icosphere(subdivisions=5, radius=1.0)
    grown.vertices[np.argmax(grown.vertices[:, 2])] *= 1.3
    learned = ExactDistance(np.asarray(grown.vertices) + MIDDLE, np.asarray(grown.faces))
    surface = type(extract_surface(sphere(1.0), ball, 0.0, steepest=1.0, spacing=0.2))(
        learned.vertices, learned.faces, 0.0
    )
    apart = surface_distance(surface, solid, 0.0, count=20_000)
    assert apart.learned_to_target_maximum == pytest.approx(0.3, abs=1e-3)
    assert apart.target_to_learned_maximum < 0.1
    assert apart.chamfer < 5e-3


def test_the_inside_of_a_closed_box_is_not_visible():
    outer, inner = trimesh.creation.box((2.0, 2.0, 2.0)), trimesh.creation.box((1.0, 1.0, 1.0))
    both = trimesh.util.concatenate([outer, inner])
    distance = ExactDistance(np.asarray(both.vertices), np.asarray(both.faces))
    points = visible_points(OffsetSolid.build(distance), 2000, np.random.default_rng(0))
    assert len(points) == 2000
    np.testing.assert_allclose(np.abs(points).max(axis=1), 1.0, atol=1e-9)


def test_refusals():
    target = Target.load("box")
    with pytest.raises(FieldError, match="spacing 0 m"):
        extract_surface(sphere(1.0), target.distance, 0.0, steepest=1.0, spacing=0.0)
    with pytest.raises(FieldError, match="nowhere near the target"):
        extract_surface(sphere(100.0), target.distance, 0.0, steepest=1.0, spacing=0.2)
