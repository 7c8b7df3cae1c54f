"""The offset solid against bodies of known exterior and imperfect meshes.

It must be conservative, 1-Lipschitz, and open where the space is open. Two messy meshes are made by the tests, so that
these checks run everywhere; real ones come on top where they are there.
"""

import numpy as np
import pytest
import scipy.ndimage
from truths.messy_meshes import MESSY
from truths.real_meshes import present
from truths.solids import boxes_mesh, hollow_box, solid_angle

from keepout.core.errors import MeshError
from keepout.core.geometry.builtin import BUILTINS
from keepout.core.geometry.distance import ExactDistance
from keepout.core.geometry.offset_solid import OffsetSolid
from keepout.core.geometry.target import Target

BOXES = [
    ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)),
    ((0.5, -0.3, -0.2), (3.0, 0.4, 0.3)),
    ((-0.4, 0.8, -0.4), (0.3, 2.0, 0.5)),
]
SHEET = np.array([(-2.0, -2.0, 0.0), (2.0, -2.0, 0.0), (2.0, 2.0, 0.0), (-2.0, 2.0, 0.0)])
TWO = np.array([(0, 1, 2), (0, 2, 3)])


def distance_to_box(points, lower, upper):
    """Signed distance to a solid box, closed form."""
    q = np.maximum(np.subtract(lower, points), np.subtract(points, upper))
    return np.linalg.norm(np.maximum(q, 0.0), axis=1) + np.minimum(q.max(axis=1), 0.0)


def spoil(faces, seed):
    """Flip 5 % of the faces and repeat 50 of them."""
    rng = np.random.default_rng(seed)
    faces = faces.copy()
    flipped = rng.random(len(faces)) < 0.05
    faces[flipped] = faces[flipped][:, ::-1]
    return np.concatenate([faces, faces[rng.integers(len(faces), size=50)]])


def around(distance, seed, count=40_000):
    """Half uniform in the padded box, half within 0.15 m of the surface."""
    rng = np.random.default_rng(seed)
    uniform = rng.uniform(distance.lower - 1.0, distance.upper + 1.0, size=(count // 2, 3))
    seeds = rng.uniform(distance.lower - 0.2, distance.upper + 0.2, size=(count - count // 2, 3))
    _, closest, _ = distance.closest(seeds)
    return np.concatenate([uniform, closest + rng.normal(size=closest.shape) * 0.06])


def assert_sound(solid, points, exterior):
    """No false-free point, in the flag and in the sign."""
    free = solid.is_exterior(points)
    signed = solid.signed_distance(points)
    assert not (free & ~exterior).any()
    assert not ((signed > 0.0) & ~exterior).any()
    np.testing.assert_array_equal(free, signed > 0.0)
    d = solid.distance.distance(points)
    assert (signed <= d - solid.offset + 1e-12).all()
    return free


def assert_lipschitz(solid, points, seed):
    """No step changes the signed distance by more than its own length."""
    rng = np.random.default_rng(seed)
    before = solid.signed_distance(points)
    for length in (1e-3, 0.05, 1.0):
        step = rng.normal(size=points.shape)
        step *= length / np.linalg.norm(step, axis=1, keepdims=True)
        assert np.abs(solid.signed_distance(points + step) - before).max() <= length + 1e-9


@pytest.fixture(scope="module")
def union():
    vertices, faces = boxes_mesh(BOXES)
    return OffsetSolid.build(ExactDistance(vertices, spoil(faces, 1)))


@pytest.fixture(scope="module")
def sheet():
    return OffsetSolid.build(ExactDistance(SHEET, TWO))


@pytest.mark.long
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
@pytest.mark.parametrize(("half_hole", "leaf"), [(0.01, {}), (0.028, {}), (0.1, {}), (0.22, {}), (0.1, {"leaf": 0.12})])
def test_a_hole_narrower_than_the_chaser_is_sealed(half_hole, leaf):
    """A box with a hole that the chaser cannot pass is solid."""
    vertices, faces, half = hollow_box(half_hole)
    solid = OffsetSolid.build(ExactDistance(vertices, spoil(faces, 3)), **leaf)
    points = around(solid.distance, 7)
    inside = (np.abs(points) < half).all(axis=1)
    mouth = inside & (np.abs(points[:, :2]).max(axis=1) < half_hole) & (points[:, 2] > half - half_hole)
    d = solid.distance.distance(points)
    free = assert_sound(solid, points, (d > solid.offset) & (~inside | mouth))
    assert free[~inside & (d > 0.3)].all()
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
    np.testing.assert_array_equal(solid.is_reachable(points, solid.distance.distance(points)), reachable)
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


@pytest.fixture(scope="module", params=["messy_satellite", pytest.param("messy_station", marks=pytest.mark.slow)])
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
