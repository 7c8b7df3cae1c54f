"""Sight lines against rays by brute force, closed forms and rational arithmetic: never clear where a ray is blocked."""

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull
from truths.made_meshes import joined, patch_of, plate, target_of

from keepout.apps.inspection.seeing.patches import cut
from keepout.apps.inspection.seeing.sightlines import LIFT, Sightlines
from keepout.core.errors import InspectionError
from keepout.core.geometry.target import Target

# Its kernels take ten seconds and more to compile.
pytestmark = pytest.mark.long


def sight_of(target, size):
    patches = cut(target, size)
    return Sightlines(target.vertices, target.faces, patches), patches


SQUARE = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]]


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


def test_what_lies_within_the_lift_does_not_block_and_what_lies_higher_does():
    for height, clear in ((0.5 * LIFT, True), (2.0 * LIFT, False)):
        vertices, faces = joined((np.array(SQUARE), [[0, 1, 2], [0, 2, 3]]), plate((0.4, 0.4), (0.6, 0.6), height))
        sight = Sightlines(vertices, faces, patch_of(SQUARE))
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


# ---- against rational arithmetic: clear exactly where triangle and pyramid have no point in common

EXACT_LIFT = Fraction(LIFT)


def cross(a, b):
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def dot(a, b):
    return sum(x * y for x, y in zip(a, b))


def less(a, b):
    return [x - y for x, y in zip(a, b)]


def kept(polygon, value):
    """The part of a convex polygon, which may be a segment or a point, where value(x) >= 0, value affine."""
    out = []
    for i, here in enumerate(polygon):
        there = polygon[(i + 1) % len(polygon)]
        a, b = value(here), value(there)
        if a >= 0:
            out.append(here)
        if a * b < 0:
            share = a / (a - b)
            out.append([x + share * (y - x) for x, y in zip(here, there)])
    return out


def exactly_clear(patch, eye, far, triangle):
    """Whether triangle and pyramid (or, not far, the prism along eye) over a patch in z = 0 have no point in common."""
    part = kept(triangle, lambda x: x[2] - EXACT_LIFT)
    if far:
        part = part and kept(part, lambda x: eye[2] - EXACT_LIFT - x[2])
    for a, b in zip(patch, patch[1:] + patch[:1]):
        inwards = cross(less(eye, a) if far else eye, less(b, a))
        part = part and kept(part, lambda x, n=inwards, a=a: dot(n, less(x, a)))
    return not part


whole = st.integers(-8, 8)
point = st.tuples(whole, whole, whole)


@settings(max_examples=10 * settings().max_examples)
@given(
    outline=st.lists(st.tuples(whole, whole), min_size=3, max_size=8),
    eye=st.tuples(whole, whole, st.integers(1, 8)),
    triangle=st.tuples(point, point, point),
    far=st.booleans(),
)
@example([(0, 0), (1, 0), (1, 1), (0, 1)], (0, 0, 4), ((-1, 0, 1), (-1, 1, 1), (0, 0, 2)), True)  # touches an edge
@example([(0, 0), (1, 0), (1, 1), (0, 1)], (0, 0, 4), ((0, 0, 0), (0, 1, 0), (0, 0, 8)), True)  # a wall edge-on
@example([(0, 0), (1, 0), (1, 1), (0, 1)], (1, 0, 4), ((0, 0, 0), (0, 1, 0), (0, 0, 8)), True)  # a wall on its edge
@example([(0, 0), (1, 0), (1, 1), (0, 1)], (1, 0, 4), ((5, 5, 5), (5, 5, 5), (5, 5, 5)), True)  # a point
@example([(-8, -8), (8, -8), (0, 8)], (0, 0, 2), ((0, 0, 1), (0, 0, 1), (0, 0, 1)), True)  # a point within
@example([(-8, -8), (8, -8), (0, 8)], (0, 0, 2), ((-8, 0, 5), (8, 0, 5), (0, 8, -5)), True)  # past behind the eye
@example([(0, 0), (0, -1), (1, 5)], (-6, 3, 3), ((3, -1, 4), (-6, 3, 3), (-6, 3, 3)), True)  # a needle from the eye up
def test_it_is_clear_exactly_where_triangle_and_pyramid_are_disjoint(outline, eye, triangle, far):
    outline = np.array(outline, dtype=np.float64)
    if np.linalg.matrix_rank(outline - outline[0]) < 2:
        return
    corners = outline[ConvexHull(outline).vertices]
    patch = np.column_stack([corners, np.zeros(len(corners))])
    sight = Sightlines(np.array(triangle, dtype=np.float64), np.array([[0, 1, 2]]), patch_of(patch))
    place, unit = np.array([eye], dtype=np.float64), np.array([0])
    told = bool((sight.clear(place, unit) if far else sight.lit(place[0], unit))[0])
    exact = [[[Fraction(int(x)) for x in corner] for corner in some] for some in (patch, triangle)]
    assert told == exactly_clear(exact[0], [Fraction(x) for x in eye], far, exact[1])


def test_the_prism_to_a_sun_that_grazes_the_patch_along_an_edge_is_not_tilted_by_rounding():
    # Points of the prism just inside a side that runs nearly along the sun, up to 900 m away.
    rng = np.random.default_rng(0)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    missed = 0
    for _ in range(300):
        steep = 10.0 ** rng.uniform(-6.9, -5.0)
        sun, start = np.array([1.0, 1e-8 * rng.normal(), steep]), np.array([rng.uniform(), 2e-9, 0.0])
        point = start + (1.1 * LIFT / steep) * sun
        needle = (point + np.array([[0.0, 0, 0], [0.0, -1e-3, 0], [0.0, -1e-3, 1e-3]])) @ turn.T
        sight = Sightlines(needle, np.array([[0, 1, 2]]), patch_of(np.array(SQUARE) @ turn.T))
        missed += int(sight.lit(turn @ sun, np.array([0]))[0])
    assert missed == 0
