"""Errors, extracted surfaces, distances and volumes of sphere fields against closed forms."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.spatial
import trimesh
from scipy.integrate import dblquad

from keepout.apps.reproduction.fitted import gradient_errors
from keepout.core.errors import FieldError, MeshError
from keepout.core.fields.own import SphereField
from keepout.core.geometry.distance import ExactDistance
from keepout.core.geometry.offset_solid import OffsetSolid
from keepout.core.geometry.target import Target, enclosed_volume
from keepout.core.measures.quality import summarised, surface_errors
from keepout.flights.surface import (
    Ellipsoid,
    Surface,
    extract_surface,
    grown_ellipsoid_volume,
    grown_hull_volume,
    measure_volumes,
    smallest_ellipsoid,
    surface_distance,
    visible_points,
)

pytestmark = pytest.mark.long

MIDDLE = np.array([0.3, -0.2, 0.1])


def sphere(radius, centre=MIDDLE):
    return SphereField(jnp.asarray(centre), jnp.asarray(radius))


@pytest.fixture(scope="module")
def solid():
    """Of a ball of 1 m."""
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=1.0)
    return OffsetSolid.build(ExactDistance(np.asarray(mesh.vertices) + MIDDLE, np.asarray(mesh.faces)), leaf=0.05)


@pytest.fixture(scope="module")
def ball(solid):
    return solid.distance


# Errors ---------------------------------------------------------------------------------------------------------------


def test_a_sphere_field_on_a_cube(tmp_path):
    """On the cube of side 2 the field √(1 + x² + y²) - r is known face by face; r = 1.2 gives it both signs."""
    trimesh.creation.box((2.0, 2.0, 2.0)).export(tmp_path / "cube.stl")
    found = surface_errors(sphere(1.2, np.zeros(3)), Target.load(tmp_path / "cube.stl", units="m"), count=100_000)

    def mean(function):
        return dblquad(lambda y, x: function(np.sqrt(1.0 + x * x + y * y) - 1.2), 0.0, 1.0, 0.0, 1.0, epsabs=1e-4)[0]

    assert found.count == 100_000
    assert found.epsilon == pytest.approx(mean(abs), rel=5e-3)
    over = mean(lambda f: max(f, 0.0)) / mean(lambda f: float(f > 0.0))
    assert found.epsilon_plus == pytest.approx(over, rel=5e-3)
    assert np.sqrt(3.0) - 1.2 - 0.02 < found.maximum <= np.sqrt(3.0) - 1.2


def test_only_what_is_over_stated_counts_in_epsilon_plus():
    found = summarised(np.array([-0.3, -0.1, 0.0, 0.2, 0.4]))
    assert (found.epsilon, found.epsilon_plus, found.maximum) == pytest.approx((0.2, 0.3, 0.4))
    assert summarised(np.array([-0.3, -0.1])).epsilon_plus == 0.0


def test_the_gradient_error_of_a_displaced_sphere(solid):
    """∇d and ∇f̃ point away from centres 0.3 m apart: at most asin(0.3/|p|) between them, but for the facets."""
    facets = 0.02  # half the angle between neighbouring facets and more
    displaced = sphere(1.0, MIDDLE + np.array([0.3, 0.0, 0.0]))
    near = gradient_errors(displaced, solid, nearest=0.05, farthest=0.1, count=20_000)
    largest = 2.0 * np.sin(0.5 * np.arcsin(0.3 / 1.05))
    assert near.mean < near.percentile_95 < near.maximum == pytest.approx(largest, abs=facets)
    far = gradient_errors(displaced, solid, nearest=2.0, farthest=3.0, count=20_000)
    assert far.maximum == pytest.approx(2.0 * np.sin(0.5 * np.arcsin(0.3 / 3.0)), abs=facets)
    assert gradient_errors(sphere(1.0), solid, nearest=0.1, farthest=3.0, count=5_000).maximum < facets


# Surfaces -------------------------------------------------------------------------------------------------------------


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


def test_distances_between_concentric_spheres(ball, solid):
    surface = extract_surface(sphere(1.0), ball, 0.15, steepest=1.0, spacing=0.05)
    apart = surface_distance(surface, solid, 0.15, count=20_000)
    for found in (apart.learned_to_target, apart.target_to_learned, apart.chamfer, apart.hausdorff):
        assert found == pytest.approx(0.15, abs=4e-3)
    assert apart.hidden_share == 0.0


def test_a_bump_shows_in_the_hausdorff_distance_of_one_side(solid):
    grown = trimesh.creation.icosphere(subdivisions=5, radius=1.0)
    grown.vertices[np.argmax(grown.vertices[:, 2])] *= 1.3
    learned = Surface(np.asarray(grown.vertices) + MIDDLE, np.asarray(grown.faces), 0.0)
    apart = surface_distance(learned, solid, 0.0, count=20_000)
    assert apart.learned_to_target_maximum == pytest.approx(0.3, abs=1e-3)
    assert apart.target_to_learned_maximum < 0.1
    assert apart.chamfer < 5e-3


def test_the_inside_of_a_closed_box_is_not_visible():
    both = trimesh.util.concatenate([trimesh.creation.box((2.0, 2.0, 2.0)), trimesh.creation.box((1.0, 1.0, 1.0))])
    distance = ExactDistance(np.asarray(both.vertices), np.asarray(both.faces))
    points = visible_points(OffsetSolid.build(distance), 2000, np.random.default_rng(0))
    assert len(points) == 2000
    np.testing.assert_allclose(np.abs(points).max(axis=1), 1.0, atol=1e-9)


# Volumes --------------------------------------------------------------------------------------------------------------


def ball_volume(radius):
    return 4.0 / 3.0 * np.pi * radius**3


@pytest.mark.parametrize("radius", [0.0, 0.5, 3.0])
def test_a_grown_box_as_hull(radius):
    a, b, c = sides = (3.0, 1.0, 0.5)
    corners = np.array(list(np.ndindex(2, 2, 2))) * sides
    inside = np.random.default_rng(0).uniform(size=(20, 3)) * sides
    hull = scipy.spatial.ConvexHull(np.concatenate([corners, inside]))
    steiner = a * b * c + 2 * radius * (a * b + b * c + c * a) + np.pi * radius**2 * (a + b + c) + ball_volume(radius)
    assert grown_hull_volume(hull, radius) == pytest.approx(steiner, rel=1e-9)


def test_a_grown_ellipsoid_against_a_grown_polyhedron():
    points = np.asarray(trimesh.creation.icosphere(subdivisions=5).vertices)
    hull = scipy.spatial.ConvexHull(points * [3.0, 2.0, 0.7])
    ellipsoid = Ellipsoid(np.zeros(3), np.diag([1 / 9.0, 1 / 4.0, 1 / 0.49]))
    for radius in (0.0, 0.5, 2.0):
        assert grown_ellipsoid_volume(ellipsoid, radius) == pytest.approx(grown_hull_volume(hull, radius), rel=2e-3)
    ball = Ellipsoid(np.zeros(3), np.eye(3) / 4.0)
    assert grown_ellipsoid_volume(ball, 0.5) == pytest.approx(ball_volume(2.5), rel=1e-12)


def test_a_thin_sheet_is_not_lost_between_the_cells():
    sheet = np.array([(0, 0, 0), (2.0, 0, 0), (2.0, 2.0, 0), (0, 2.0, 0)], dtype=float)
    # A sheet has no hull; a second one across it gives it some height.
    fin = sheet[:, [0, 2, 1]] + [0.0, 1.0, 0.0]
    distance = ExactDistance(np.concatenate([sheet, fin]), np.array([(0, 1, 2), (0, 2, 3), (4, 5, 6), (4, 6, 7)]))
    crossed = OffsetSolid.build(distance, offset=0.03)
    [found] = measure_volumes(sphere(0.5, np.zeros(3)), crossed, [(0.03, 0.0)], steepest=1.0, leaf=0.1, seed=0)
    plate = 4.0 * 0.06 + np.pi * 0.03**2 / 2 * 8.0 + ball_volume(0.03)
    assert found.contact == pytest.approx(2.0 * plate - 0.06 * 0.06 * 2.0, rel=0.08)


def test_refusals(ball, solid):
    for asked, said in (
        (lambda: extract_surface(sphere(1.0), ball, 0.0, steepest=1.0, spacing=0.0), "spacing 0 m"),
        (lambda: extract_surface(sphere(100.0), ball, 0.0, steepest=1.0, spacing=0.2), "nowhere near the target"),
        (lambda: measure_volumes(sphere(1.0), solid, [], steepest=1.0), "at least one"),
        (lambda: measure_volumes(sphere(1.0), solid, [(0.0, 0.0)], steepest=1.0, leaf=0.0), "leaf 0 m"),
    ):
        with pytest.raises(FieldError, match=said):
            asked()


def test_smallest_ellipsoid_of_an_affine_simplex():
    # The smallest ellipsoid of an affine image is the affine image of the smallest: a regular simplex gives the sphere.
    simplex = np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)], dtype=float)
    stretch = np.array([[2.0, 0.3, 0.0], [0.0, 1.0, -0.4], [0.1, 0.0, 0.7]])
    found = smallest_ellipsoid(simplex @ stretch.T)
    assert found.volume == pytest.approx(4.0 / 3.0 * np.pi * 3.0**1.5 * np.linalg.det(stretch), rel=1e-6)


def test_flat_points_are_refused():
    with pytest.raises(MeshError, match="span no volume"):
        smallest_ellipsoid(np.zeros((10, 3)))
