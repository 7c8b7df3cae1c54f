"""Sight lines against rays by brute force and closed forms: never clear where a ray is blocked."""

import math

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull
from truths.made_meshes import joined, plate, target_of

from keepout.errors import InspectionError
from keepout.geometry import Target
from keepout.seeing.cut import cut
from keepout.seeing.patches import Patches
from keepout.seeing.sightlines import LIFT, Sightlines


def rays_meet(starts, ways, triangles, low, high):
    """Whether rays start + t way, t in (low, high), meet any triangle: by the signs of volumes. (n, 3) and (n,)."""
    a, b, c = (triangles[None, :, k] - starts[:, None] for k in range(3))
    d = ways[:, None]
    u = np.einsum("nfi,nfi->nf", np.cross(b, c), d + 0.0 * a)
    v = np.einsum("nfi,nfi->nf", np.cross(c, a), d + 0.0 * a)
    w = np.einsum("nfi,nfi->nf", np.cross(a, b), d + 0.0 * a)
    total = u + v + w
    same = ((u >= 0) & (v >= 0) & (w >= 0)) | ((u <= 0) & (v <= 0) & (w <= 0))
    with np.errstate(divide="ignore", invalid="ignore"):
        at = np.einsum("nfi,nfi->nf", np.cross(b - a, c - a), a) / np.einsum(
            "nfi,nfi->nf", np.cross(b - a, c - a), d + 0.0 * a
        )
    return (same & (total != 0.0) & (at > low[:, None]) & (at < high[:, None])).any(axis=1)


def points_of(patches, patch, count, rng):
    """Points of a patch: its corners, points of its border, and points inside."""
    corners = patches.corners[patch, : patches.counts[patch]]
    weights = rng.dirichlet(np.full(len(corners), 0.4), size=count)
    border = 0.999 * corners + 0.001 * np.roll(corners, -1, axis=0)
    return np.concatenate([corners, border, weights @ corners])


def blocked_by_rays(patches, unit, place, triangles, rng, count=60, sun=False):
    """Whether some ray to the unit is blocked between LIFT above its plane and LIFT below the eye's height."""
    points = points_of(patches, unit // 2, count, rng)
    normal = patches.unit_normals()[unit]
    ways = np.broadcast_to(place, points.shape) if sun else place - points
    steep = ways @ normal
    high = np.full(len(points), np.inf) if sun else 1.0 - LIFT / steep
    return bool(rays_meet(points, ways, triangles, LIFT / steep, high).any())


def sight_of(target, size):
    patches = cut(target, size)
    return Sightlines(target.vertices, target.faces, patches), patches


def one_patch(corners):
    """The patch that a convex plane polygon is."""
    corners = np.asarray(corners, dtype=np.float64)
    spokes = corners[1:] - corners[0]
    twice = np.cross(spokes[:-1], spokes[1:]).sum(axis=0)
    area = np.linalg.norm(twice)
    return Patches(
        corners[None], np.array([len(corners)]), (twice / area)[None], np.array([area / 2]), corners.mean(axis=0)[None],
        np.array([0]), np.array([True, True]), 10.0,
    )  # fmt: skip


SQUARE = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]]


@pytest.mark.parametrize("gap", [-0.3, -1e-3, -1e-6, 1e-6, 1e-3, 0.3])
def test_between_two_parallel_plates_it_is_clear_as_far_as_similar_triangles_say(gap):
    # Seen from height 4, the pyramid over [0, 1] reaches at height 1 to 0.25 eye + 0.75.
    eye = np.array([2.0, 0.5, 4.0])
    edge = 0.25 * eye[0] + 0.75 + gap
    vertices, faces = joined((np.array(SQUARE), [[0, 1, 2], [0, 2, 3]]), plate((edge, -9.0), (9.0, 9.0), 1.0))
    sight = Sightlines(vertices, faces, one_patch(SQUARE))
    assert sight.clear(eye[None], np.array([0])).tolist() == [gap > 0.0]
    sun = np.array([1.0, 0.0, 2.0])  # the prism reaches at height 1 to 1.5
    vertices, faces = joined((np.array(SQUARE), [[0, 1, 2], [0, 2, 3]]), plate((1.5 + gap, -9.0), (9.0, 9.0), 1.0))
    sight = Sightlines(vertices, faces, one_patch(SQUARE))
    assert sight.lit(sun, np.array([0])).tolist() == [gap > 0.0]


@pytest.mark.parametrize("side", [0.0, 0.2])
@pytest.mark.parametrize("gap", [-1e-2, -1e-6, 1e-6, 1e-2])
def test_through_a_hole_it_is_clear_if_the_hole_holds_the_pyramid(gap, side):
    # At height 3 of 4 the pyramid is a square of edge 1/4 about the line to the eye; the hole is 2 gap wider.
    eye = np.array([0.5 + side, 0.5, 4.0])
    low, high = 0.75 * eye[:2] - gap, 0.75 * eye[:2] + 0.25 + gap
    hole = joined(
        (np.array(SQUARE), [[0, 1, 2], [0, 2, 3]]),
        plate((-5.0, -5.0), (low[0], 5.0), 3.0),
        plate((high[0], -5.0), (5.0, 5.0), 3.0),
        plate((low[0], -5.0), (high[0], low[1]), 3.0),
        plate((low[0], high[1]), (high[0], 5.0), 3.0),
    )
    sight = Sightlines(*hole, one_patch(SQUARE))
    assert sight.clear(eye[None], np.array([0])).tolist() == [gap > 0.0]


def test_a_thin_needle_that_misses_the_centre_ray_and_the_corners_blocks():
    needle = np.array([[0.31, 0.4, 0.5], [0.3100001, 0.4, 0.5], [0.31, 0.4, 0.5000001]])
    vertices, faces = joined((np.array(SQUARE), [[0, 1, 2], [0, 2, 3]]), (needle, [[0, 1, 2]]))
    sight = Sightlines(vertices, faces, one_patch(SQUARE))
    assert not sight.clear(np.array([[0.5, 0.5, 4.0]]), np.array([0]))[0]
    assert sight.clear(np.array([[0.5, 0.5, -4.0]]), np.array([1]))[0]


def test_at_a_concave_corner_the_wall_does_not_block_what_stands_on_its_edge():
    # A wall up along x = 0 and the floor beside it, cut to its very edge.
    floor, wall = np.array(SQUARE), np.array([[0.0, 0, 0], [0.0, 1, 0], [0.0, 1, 2], [0.0, 0, 2]])
    target = target_of(*joined((floor, [[0, 1, 2], [0, 2, 3]]), (wall, [[0, 1, 2], [0, 2, 3]])))
    sight, patches = sight_of(target, 0.25)
    units = np.flatnonzero(np.repeat(patches.centres[:, 2] == 0.0, 2) & (np.arange(patches.units) % 2 == 0))
    assert len(units) == 16
    for x in (1e-3, 0.1, 1.0, 5.0):
        assert sight.clear(np.array([[x, 0.5, 3.0]]), units).all()
    behind = sight.clear(np.array([[-0.1, 0.5, 3.0]]), units)
    assert not behind[patches.centres[units // 2, 0] < 0.25].any()
    assert sight.lit(np.array([0.2, 0.1, 1.0]), units).all()
    assert not sight.lit(np.array([-0.2, 0.0, 0.3]), units).any()


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**31), points=st.integers(4, 40), far=st.floats(0.05, 300.0))
def test_nothing_of_a_convex_body_blocks_what_faces_the_camera_or_the_sun(seed, points, far):
    rng = np.random.default_rng(seed)
    hull = ConvexHull(rng.normal(size=(points, 3)))
    faces = hull.simplices.copy()
    a, b, c = np.moveaxis(hull.points[faces], 1, 0)
    turned = np.einsum("fi,fi->f", np.cross(b - a, c - a), hull.equations[:, :3]) < 0.0
    faces[turned] = faces[turned][:, ::-1]
    target = target_of(hull.points, faces)
    sight, patches = sight_of(target, 0.4)
    way = rng.normal(size=3)
    way /= np.linalg.norm(way)
    place = way * ((hull.points @ way).max() + far)
    height = np.einsum("ni,ni->n", patches.unit_normals(), place - np.repeat(patches.centres, 2, axis=0))
    facing = np.flatnonzero((height > 0.01) & patches.counted)
    assert sight.clear(place[None], facing).all()
    assert not sight.clear(place[None], np.flatnonzero(height < 0.0)).any()
    facing = np.flatnonzero((patches.unit_normals() @ way > 0.01) & patches.counted)
    assert sight.lit(way, facing).all()


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**31), scale=st.sampled_from([0.01, 0.3, 1.0, 3.0]))
def test_never_clear_where_a_ray_is_blocked_and_seldom_blocked_where_all_rays_pass(seed, scale):
    rng = np.random.default_rng(seed)
    centres = rng.uniform(-2.0, 2.0, size=(40, 1, 3))
    vertices = (centres + rng.normal(size=(40, 3, 3)) * scale).reshape(-1, 3)
    target = target_of(vertices, np.arange(120).reshape(-1, 3))
    sight, patches = sight_of(target, 1.0)
    triangles = target.vertices[target.faces]
    places, units = rng.uniform(-6.0, 6.0, size=(60, 3)), rng.integers(0, patches.units, 60)
    normals = patches.unit_normals()[units]
    up = np.einsum("ni,ni->n", normals, places - patches.centres[units // 2])
    units = np.where(up < 0.0, units ^ 1, units)
    clear, sun = sight.clear(places, units), places[0] / np.linalg.norm(places[0])
    kept = np.abs(up) > 0.01
    for place, unit, says in zip(places[kept], units[kept], clear[kept]):
        if says:
            assert not blocked_by_rays(patches, unit, place, triangles, rng)
    facing = np.flatnonzero(patches.unit_normals() @ sun > 0.01)[:60]
    for unit, says in zip(facing, sight.lit(sun, facing)):
        if says:
            assert not blocked_by_rays(patches, unit, sun, triangles, rng, sun=True)


def test_what_is_refused_is_blocked_for_a_ray_too():
    # Dense rays find the blocker of nearly all pairs refused: what is left is grazed by less than their spacing.
    target = Target.load("pocket")
    sight, patches = sight_of(target, 0.5)
    rng = np.random.default_rng(1)
    triangles = target.vertices[target.faces]
    places = rng.uniform(-8.0, 8.0, size=(1500, 3))
    places = places[target.distance.distance(places) > 1.0]
    units = rng.choice(np.flatnonzero(patches.counted), len(places))
    up = np.einsum("ni,ni->n", patches.unit_normals()[units], places - patches.centres[units // 2])
    places, units = places[up > 0.05], units[up > 0.05]
    clear = sight.clear(places, units)
    rays = np.array([blocked_by_rays(patches, u, p, triangles, rng, 150) for p, u in zip(places, units)])
    assert not (clear & rays).any()
    assert 50 < clear.sum() < len(clear) - 50
    assert (~clear & ~rays).sum() <= 0.01 * len(clear)


def test_what_lies_within_the_lift_does_not_block_and_what_lies_higher_does():
    for height, clear in ((0.5 * LIFT, True), (2.0 * LIFT, False)):
        vertices, faces = joined((np.array(SQUARE), [[0, 1, 2], [0, 2, 3]]), plate((0.4, 0.4), (0.6, 0.6), height))
        sight = Sightlines(vertices, faces, one_patch(SQUARE))
        for far in (1.0, 100.0, 10000.0):  # the lift is a length: no share of the range
            assert sight.clear(np.array([[0.5, 0.5, far]]), np.array([0])).tolist() == [clear]
        assert sight.lit(np.array([0.3, 0.0, 1.0]), np.array([0])).tolist() == [clear]


def test_bad_places_units_and_suns_are_refused():
    sight, _ = sight_of(Target.load("box"), 1.0)
    with pytest.raises(InspectionError, match="not finite"):
        sight.clear(np.array([[math.nan, 0.0, 0.0]]), np.array([0]))
    with pytest.raises(InspectionError, match="outside 0 to"):
        sight.clear(np.array([[9.0, 0.0, 0.0]]), np.array([10**6]))
    with pytest.raises(InspectionError, match="zero"):
        sight.lit(np.zeros(3), np.array([0]))
    assert sight.clear(np.array([[9.0, 0.0, 0.0]]), np.empty(0, dtype=np.int64)).shape == (0,)


def test_places_inside_a_closed_box_see_no_outer_side():
    mesh = trimesh.creation.box(extents=(4.0, 4.0, 4.0))
    sight, patches = sight_of(target_of(mesh.vertices, mesh.faces), 1.0)
    outer = np.flatnonzero(patches.counted)
    assert not sight.clear(np.zeros((1, 3)), outer).any()
    assert sight.clear(np.zeros((1, 3)), outer ^ 1).all()
