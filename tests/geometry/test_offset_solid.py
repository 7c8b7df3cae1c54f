"""The offset solid against bodies whose exterior is known in closed form."""

import numpy as np
import pytest
from truths.solids import (
    around,
    assert_sound,
    boxes_mesh,
    check_a_narrow_hole_is_sealed,
    check_nested_shells_are_solid,
    distance_to_box,
    hollow_box,
    spoil,
)

from keepout.errors import MeshError
from keepout.geometry import ExactDistance, OffsetSolid
from keepout.geometry.builtin import BUILTINS


def assert_lipschitz(solid, points, seed):
    rng = np.random.default_rng(seed)
    for length in (1e-3, 0.05, 1.0):
        step = rng.normal(size=points.shape)
        step *= length / np.linalg.norm(step, axis=1, keepdims=True)
        change = solid.signed_distance(points + step) - solid.signed_distance(points)
        assert np.abs(change).max() <= length + 1e-9


BOXES = [
    ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)),
    ((0.5, -0.3, -0.2), (3.0, 0.4, 0.3)),
    ((-0.4, 0.8, -0.4), (0.3, 2.0, 0.5)),
]


@pytest.fixture(scope="module")
def union():
    vertices, faces = boxes_mesh(BOXES)
    return OffsetSolid.build(ExactDistance(vertices, spoil(faces, 1)))


def test_box_union_is_sound_and_tight(union):
    points = around(union.distance, 0)
    truth = np.min([distance_to_box(points, *b) for b in BOXES], axis=0)
    free = assert_sound(union, points, truth > union.offset)
    # Convex corners are exact; only concave ones are rounded to the closing radius.
    assert free[truth > union.offset + 0.15].all()
    assert (free == (truth > union.offset)).mean() > 0.99
    exact = free & (np.abs(union.signed_distance(points) - (truth - union.offset)) < 1e-12)
    assert exact.sum() > 0.99 * free.sum()


def test_box_union_inside_is_close_to_the_true_depth(union):
    points = around(union.distance, 5, 20_000)
    truth = np.min([distance_to_box(points, *b) for b in BOXES], axis=0)
    one = truth < -0.1
    signed = union.signed_distance(points[one])
    # The union's own formula understates depth where boxes overlap, so it bounds from one side only.
    assert (signed <= truth[one] + 0.07).all()


def test_signed_distance_is_1_lipschitz(union):
    assert_lipschitz(union, around(union.distance, 2, 30_000), 3)


def test_no_dependence_on_orientation():
    vertices, faces = boxes_mesh(BOXES)
    points = around(ExactDistance(vertices, faces), 4, 20_000)
    flipped = faces.copy()
    flipped[np.random.default_rng(0).random(len(faces)) < 0.5] = flipped[
        np.random.default_rng(0).random(len(faces)) < 0.5
    ][:, ::-1]
    one = OffsetSolid.build(ExactDistance(vertices, faces)).signed_distance(points)
    other = OffsetSolid.build(ExactDistance(vertices, flipped)).signed_distance(points)
    np.testing.assert_allclose(one, other, atol=1e-12)


def test_nested_shells_are_solid_to_the_outermost():
    check_nested_shells_are_solid()


@pytest.mark.parametrize("half_hole", [0.01, 0.028, 0.1, 0.22])
def test_a_hole_narrower_than_the_chaser_is_sealed(half_hole):
    solid, half = check_a_narrow_hole_is_sealed(half_hole)
    near_mouth = np.random.default_rng(8).uniform([-0.4, -0.4, half - 0.5], [0.4, 0.4, half + 0.5], size=(20_000, 3))
    assert_lipschitz(solid, near_mouth, 9)


def test_a_hole_wider_than_the_chaser_stays_open():
    vertices, faces, half = hollow_box(0.45)
    solid = OffsetSolid.build(ExactDistance(vertices, spoil(faces, 3)))
    d_inside = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, half]])
    assert solid.is_exterior(d_inside).all()
    assert solid.signed_distance(d_inside[:1])[0] == pytest.approx(half - solid.offset)
    assert solid.sealed_volume < 0.2


def test_a_thin_sheet_has_twice_the_offset():
    vertices = np.array([(-2.0, -2.0, 0.0), (2.0, -2.0, 0.0), (2.0, 2.0, 0.0), (-2.0, 2.0, 0.0)])
    solid = OffsetSolid.build(ExactDistance(vertices, np.array([(0, 1, 2), (0, 2, 3)])))
    heights = np.linspace(-0.5, 0.5, 1001)
    points = np.column_stack([np.full(1001, 0.3), np.full(1001, 0.1), heights])
    np.testing.assert_allclose(solid.signed_distance(points), np.abs(heights) - solid.offset, atol=1e-12)


def test_far_points_and_points_outside_the_cube_are_exterior(union):
    far = np.array([[1e4, 0.0, 0.0], [0.0, -1e3, 50.0]])
    assert union.is_exterior(far).all()
    np.testing.assert_allclose(union.signed_distance(far), union.distance.distance(far) - union.offset)


def test_large_leaf_stays_sound():
    vertices, faces, half = hollow_box(0.1)
    solid = OffsetSolid.build(ExactDistance(vertices, faces), leaf=0.12)
    points = around(solid.distance, 10)
    d = solid.distance.distance(points)
    outside = ~(np.abs(points) < half).all(axis=1)
    mouth = (np.abs(points[:, :2]).max(axis=1) < 0.1) & (points[:, 2] > half - 0.1)
    free = assert_sound(solid, points, (d > solid.offset) & (outside | mouth))
    assert free[outside & (d > 0.3)].all()


def test_reachable_up_to_the_surface_from_outside_and_nowhere_inside():
    lower, upper = np.zeros(3), np.array([2.0, 1.0, 1.0])
    solid = OffsetSolid.build(ExactDistance(*boxes_mesh([(lower, upper)])), leaf=0.12)
    assert solid.envelope > 0.15  # coarse leaves cover far more than the skin of 0.03 m
    points = around(solid.distance, 8, 20_000)
    depth = distance_to_box(points, lower, upper)
    points, depth = points[np.abs(depth) > 1e-6], depth[np.abs(depth) > 1e-6]
    reachable = solid.is_reachable(points)
    assert reachable[depth > 0.0].all()
    # A walk from within a millimetre of a surface starts on either side of it.
    assert not reachable[depth < -2e-3].any()
    assert (depth > 0.0).sum() > 1000 < ((depth > 0.0) & ~solid.is_exterior(points)).sum()


def test_no_walk_passes_through_a_plate_thinner_than_the_leaves():
    lower, upper = np.zeros(3), np.array([2.0, 1.0, 0.05])
    solid = OffsetSolid.build(ExactDistance(*boxes_mesh([(lower, upper)])), offset=1e-3, leaf=0.06)
    assert solid.envelope > 0.1  # farther than the plate is thick
    rng = np.random.default_rng(6)
    flat = rng.uniform([0.1, 0.1], [1.9, 0.9], (600, 2))
    inside = np.column_stack([flat, rng.uniform(2e-3, 0.048, 600)])
    outside = np.column_stack([flat, rng.uniform(0.051, 0.2, 600)])
    on_it = np.column_stack([flat, np.repeat([0.0, 0.05], 300)])
    assert not solid.is_reachable(inside).any()
    assert solid.is_reachable(outside).all()
    assert solid.is_reachable(on_it).all()


def test_both_sides_of_a_sheet_are_reachable_and_points_on_it():
    sheet = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [2.0, 2.0, 0.0], [0.0, 2.0, 0.0]])
    solid = OffsetSolid.build(ExactDistance(sheet, np.array([[0, 1, 2], [0, 2, 3]])))
    rng = np.random.default_rng(9)
    points = np.column_stack([rng.uniform(0.1, 1.9, (300, 2)), np.repeat([0.0, 0.02, -0.02], 100)])
    assert solid.is_reachable(points).all()


def test_pocket_is_open():
    solid = OffsetSolid.build(ExactDistance(*BUILTINS["pocket"].build()))
    assert solid.signed_distance(np.array([[0.0, 0.0, 0.0]]))[0] == pytest.approx(1.7 - solid.offset)


@pytest.mark.parametrize(
    ("arguments", "word"),
    [({"offset": 0.0}, "offset"), ({"closing_radius": 0.01}, "closing_radius"), ({"leaf": -1.0}, "leaf")],
)
def test_bad_arguments_are_named(arguments, word):
    vertices, faces = boxes_mesh(BOXES[:1])
    with pytest.raises(MeshError, match=word):
        OffsetSolid.build(ExactDistance(vertices, faces), **arguments)
