"""The offset solid against bodies of known exterior, imperfect meshes, and breaks made on purpose.

It must be conservative, 1-Lipschitz, and open where the space is open. Two messy meshes are made by the tests, so that
these checks run everywhere; real ones come on top where they are there.
"""

import numpy as np
import pytest
import scipy.ndimage
from truths.messy_meshes import MESSY
from truths.real_meshes import present
from truths.solids import (
    around,
    assert_lipschitz,
    assert_sound,
    boxes_mesh,
    check_a_narrow_hole_is_sealed,
    check_nested_shells_are_solid,
    distance_to_box,
    hollow_box,
    solid_angle,
    spoil,
)

from keepout.errors import MeshError
from keepout.geometry import ExactDistance, OffsetSolid, Target, exterior, offset_solid
from keepout.geometry.builtin import BUILTINS

BOXES = [
    ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)),
    ((0.5, -0.3, -0.2), (3.0, 0.4, 0.3)),
    ((-0.4, 0.8, -0.4), (0.3, 2.0, 0.5)),
]
SHEET = np.array([(-2.0, -2.0, 0.0), (2.0, -2.0, 0.0), (2.0, 2.0, 0.0), (-2.0, 2.0, 0.0)])
TWO = np.array([(0, 1, 2), (0, 2, 3)])


@pytest.fixture(scope="module")
def union():
    vertices, faces = boxes_mesh(BOXES)
    return OffsetSolid.build(ExactDistance(vertices, spoil(faces, 1)))


@pytest.fixture(scope="module")
def sheet():
    return OffsetSolid.build(ExactDistance(SHEET, TWO))


def test_box_union_is_sound_and_tight(union):
    points = around(union.distance, 0)
    truth = np.min([distance_to_box(points, *b) for b in BOXES], axis=0)
    free = assert_sound(union, points, truth > union.offset)
    # Convex corners are exact; only concave ones are rounded to the closing radius.
    assert free[truth > union.offset + 0.15].all()
    assert (free == (truth > union.offset)).mean() > 0.99
    signed = union.signed_distance(points)
    exact = free & (np.abs(signed - (truth - union.offset)) < 1e-12)
    assert exact.sum() > 0.99 * free.sum()
    # Within, the union's own formula understates depth where boxes overlap, so it bounds from one side only.
    assert (signed <= truth + 0.07)[truth < -0.1].all()
    assert_lipschitz(union, points, 3)
    far = np.array([[1e4, 0.0, 0.0], [0.0, -1e3, 50.0]])
    np.testing.assert_allclose(union.signed_distance(far), union.distance.distance(far) - union.offset)


@pytest.mark.long
def test_nested_shells_are_solid_to_the_outermost():
    check_nested_shells_are_solid()


@pytest.mark.parametrize(("half_hole", "leaf"), [(0.01, {}), (0.028, {}), (0.1, {}), (0.22, {}), (0.1, {"leaf": 0.12})])
def test_a_hole_narrower_than_the_chaser_is_sealed(half_hole, leaf):
    solid, half = check_a_narrow_hole_is_sealed(half_hole, **leaf)
    near_mouth = np.random.default_rng(8).uniform([-0.4, -0.4, half - 0.5], [0.4, 0.4, half + 0.5], size=(10_000, 3))
    assert_lipschitz(solid, near_mouth, 9)


@pytest.mark.long
def test_a_hole_wider_than_the_chaser_stays_open():
    vertices, faces, half = hollow_box(0.45)
    solid = OffsetSolid.build(ExactDistance(vertices, spoil(faces, 3)))
    inside = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, half]])
    assert solid.is_exterior(inside).all()
    assert solid.signed_distance(inside[:1])[0] == pytest.approx(half - solid.offset)
    assert solid.sealed_volume < 0.2
    pocket = OffsetSolid.build(ExactDistance(*BUILTINS["pocket"].build()))
    assert pocket.signed_distance(np.zeros((1, 3)))[0] == pytest.approx(1.7 - pocket.offset)


def test_a_thin_sheet_has_twice_the_offset_and_is_reachable_from_both_sides(sheet):
    heights = np.linspace(-0.5, 0.5, 1001)
    points = np.column_stack([np.full(1001, 0.3), np.full(1001, 0.1), heights])
    np.testing.assert_allclose(sheet.signed_distance(points), np.abs(heights) - sheet.offset, atol=1e-12)
    rng = np.random.default_rng(9)
    points = np.column_stack([rng.uniform(-1.9, 1.9, (300, 2)), np.repeat([0.0, 0.02, -0.02], 100)])
    assert sheet.is_reachable(points).all()


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
    inside, outside, on_it = (
        np.column_stack([flat, heights])
        for heights in (rng.uniform(2e-3, 0.048, 600), rng.uniform(0.051, 0.2, 600), np.repeat([0.0, 0.05], 300))
    )
    assert not solid.is_reachable(inside).any()
    assert solid.is_reachable(outside).all()
    assert solid.is_reachable(on_it).all()


@pytest.mark.parametrize(
    ("arguments", "word"),
    [({"offset": 0.0}, "offset"), ({"closing_radius": 0.01}, "closing_radius"), ({"leaf": -1.0}, "leaf")],
)
def test_bad_arguments_are_named(sheet, arguments, word):
    with pytest.raises(MeshError, match=word):
        OffsetSolid.build(sheet.distance, **arguments)


# Imperfect meshes -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=MESSY)
def messy(request, tmp_path_factory):
    """A messy mesh with its target, without stray parts."""
    mesh = MESSY[request.param](tmp_path_factory.mktemp("messy"))
    return mesh, Target.load(mesh.path, drop_stray=True)


@pytest.fixture(scope="module")
def solid(messy):
    return OffsetSolid.build(messy[1].distance)


def check_conservative_and_lipschitz(target, solid, count):
    lower, upper = solid.distance.lower, solid.distance.upper
    points = around(target.distance, 0, count)
    d = target.distance.distance(points)
    free = assert_sound(solid, points, d > solid.offset)
    outside_box = ((points < lower) | (points > upper)).any(axis=1)
    assert free[outside_box & (d > 0.5)].all()
    assert_lipschitz(solid, points, 1)
    return points, free, d


@pytest.mark.long
def test_messy_conservative_and_lipschitz(messy, solid):
    check_conservative_and_lipschitz(messy[1], solid, 20_000)


@pytest.mark.slow
def test_real_conservative_and_lipschitz():
    """One test over all real meshes that are there, as a list that may be empty would show as skipped."""
    assert [mesh.name for mesh in present() if not mesh.is_whole] == []
    for mesh in present():
        target = Target.load(mesh.path, scale=mesh.scale)
        points, free, d = check_conservative_and_lipschitz(target, OffsetSolid.build(target.distance), 60_000)
        if mesh.name == "itokawa.obj":  # watertight and oriented
            points, free, d = points[::20], free[::20], d[::20]
            inside = np.abs(solid_angle(target, points)) > np.pi
            assert not (free & inside).any()
            assert free[~inside & (d > 0.3)].all()


@pytest.mark.long
def test_messy_exterior_against_a_flood_of_voxels(messy, solid):
    """Voxels joined through their faces, by exact distances alone: no octree, no walks.

    Between two neighbouring centres that both lie further than half a spacing from the surface no wall passes. So what
    a ball of the closing radius reaches is among the voxels flooded at half a spacing, and voxels flooded at the
    closing radius plus half a spacing are reached by such a ball; 0.06 m more is the solid's own flood cell.
    """
    mesh, _ = messy
    assert (solid.signed_distance(mesh.sealed) < 0.0).all()
    assert solid.is_exterior(mesh.open).all()
    assert mesh.closed_volume <= solid.sealed_volume <= 1.2 * mesh.closed_volume
    spacing = 0.2
    lower, upper = solid.distance.lower - 1.0, solid.distance.upper + 1.0
    axes = [np.arange(low, high, spacing) for low, high in zip(lower, upper)]
    centres = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    d = solid.distance.distance(centres.reshape(-1, 3)).reshape(centres.shape[:3])

    def flooded(clearance):
        label, _ = scipy.ndimage.label(d > clearance)
        return label == label[0, 0, 0]

    surely = flooded(0.25 + 0.06 + 0.5 * spacing)
    perhaps = flooded(0.5 * spacing)
    assert solid.is_exterior(centres[surely]).all()
    hidden = ~perhaps & (d > 0.5 * spacing)
    assert hidden.sum() > 1000
    assert not solid.is_exterior(centres[hidden]).any()


# Breaks ---------------------------------------------------------------------------------------------------------------


def flood_through_walls(monkeypatch):
    """The flood passes through cells that hold surfaces, so that every free cell is reached."""
    flood = exterior.flood

    def without(*arguments):
        cells, free, _ = flood(*arguments)
        return cells, free, free

    monkeypatch.setattr(offset_solid, "flood", without)


def forget_the_closing_radius(monkeypatch):
    """The flood is that of a point, which passes every hole."""
    flood = exterior.flood

    def without(distance, origin, side, depth, radius, progress):
        return flood(distance, origin, side, depth + 3, 0.0, progress)

    monkeypatch.setattr(offset_solid, "flood", without)


def believe_every_walk(monkeypatch):
    """A walk that comes to no end is taken to have come out."""
    monkeypatch.setattr(exterior, "_walk", lambda *arguments: np.full(len(arguments[-1]), exterior._OPEN, np.int8))


def hide_nothing(monkeypatch):
    """Cells that the flood does not reach are not hidden."""
    hidden_cells = exterior.hidden_cells

    def without(*arguments):
        cells, hidden = hidden_cells(*arguments)
        return cells, np.zeros_like(hidden)

    monkeypatch.setattr(offset_solid, "hidden_cells", without)


@pytest.mark.long
@pytest.mark.parametrize(
    ("broken", "check"),
    [
        (flood_through_walls, check_nested_shells_are_solid),
        (flood_through_walls, lambda: check_a_narrow_hole_is_sealed(0.1)),
        (forget_the_closing_radius, lambda: check_a_narrow_hole_is_sealed(0.22)),
        (believe_every_walk, check_nested_shells_are_solid),
        (hide_nothing, check_nested_shells_are_solid),
    ],
)
def test_a_break_is_noticed(broken, check, monkeypatch):
    """Points in closed cavities are then called free; without the break the same checks pass, above."""
    broken(monkeypatch)
    with pytest.raises(AssertionError):
        check()
