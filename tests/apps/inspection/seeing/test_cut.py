"""Patches of a mesh: they tile its surface, are plane, convex and small, and know the outer side of closed parts."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from truths.made_meshes import target_of

from keepout.apps.inspection.seeing.patches import closed_parts, cut
from keepout.core.errors import InspectionError
from keepout.core.geometry.target import Target


def mesh_area(target):
    a, b, c = np.moveaxis(target.vertices[target.faces], 1, 0)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()


def polygon_areas(patches):
    """From the corners alone, with the sign of their turn about the normal."""
    spokes = patches.corners - patches.corners[:, :1]
    return 0.5 * np.einsum("ni,ni->n", np.cross(spokes[:, :-1], spokes[:, 1:]).sum(axis=1), patches.normals)


@pytest.mark.long
@pytest.mark.parametrize(("name", "size"), [("box", 0.3), ("pocket", 0.25), ("intelsat30", 0.25), ("iss", 1.0)])
def test_patches_have_the_area_of_the_mesh_and_are_plane_convex_and_small(name, size):
    target = Target.load(name)
    patches = cut(target, size)
    assert patches.areas.sum() == pytest.approx(mesh_area(target), rel=1e-9)
    assert polygon_areas(patches).sum() == pytest.approx(mesh_area(target), rel=1e-8)
    assert (polygon_areas(patches) > 0.0).all()
    heights = np.einsum("nki,ni->nk", patches.corners - patches.centres[:, None], patches.normals)
    assert np.abs(heights).max() < 1e-12
    assert np.linalg.norm(patches.corners - patches.centres[:, None], axis=2).max() <= size * np.sqrt(2.0) + 1e-9
    corner = np.arange(patches.corners.shape[1])
    following = np.where(corner + 1 < patches.counts[:, None], corner + 1, 0)
    edges = np.take_along_axis(patches.corners, following[..., None], axis=1) - patches.corners
    inside = np.cross(patches.normals[:, None], edges)
    reach = np.einsum("nki,nkji->nkj", inside, patches.corners[:, None] - patches.corners[:, :, None])
    assert reach.min() > -1e-9
    # A patch lies on the mesh: at most the flatness of a region off it.
    assert target.distance.distance(patches.centres).max() < 2.1e-5
    assert target.distance.distance(patches.corners.reshape(-1, 3)).max() < 2.1e-5


@pytest.mark.long
def test_a_box_is_cut_into_its_grid_however_its_faces_are_triangulated():
    for rounds in (0, 3):
        mesh = trimesh.creation.box(extents=(2.0, 1.0, 0.5))
        for _ in range(rounds):
            mesh = mesh.subdivide()
        patches = cut(target_of(mesh.vertices, mesh.faces), 0.25)
        assert len(patches.areas) == 2 * (8 * 4 + 8 * 2 + 4 * 2)
        assert patches.areas == pytest.approx(1 / 16)
        assert (patches.counts == 4).all()
        assert patches.counted.reshape(-1, 2).tolist() == [[True, False]] * len(patches.areas)


def test_outer_sides_count_even_of_parts_that_are_inside_out_and_both_sides_of_sheets():
    box, inverted = trimesh.creation.box(), trimesh.creation.box()
    inverted.invert()
    sheet = np.array([[4.0, 0.0, 0.0], [5.0, 0.0, 0.0], [5.0, 1.0, 0.0], [4.0, 1.0, 0.0]])
    vertices = np.concatenate([box.vertices, inverted.vertices + np.array([2.0, 0.0, 0.0]), sheet])
    faces = np.concatenate([box.faces, inverted.faces + 8, [[16, 17, 18], [16, 18, 19]]])
    closed, inward = closed_parts(vertices, faces)
    assert closed.tolist() == [True] * 24 + [False] * 2
    assert inward.tolist() == [False] * 12 + [True] * 12 + [False] * 2
    patches = cut(target_of(vertices, faces), 2.0)
    part = np.digitize(patches.centres[:, 0], [1.0, 3.0])
    for number, middle in enumerate([np.zeros(3), np.array([2.0, 0.0, 0.0])]):
        out = patches.centres[part == number] - middle
        assert (np.einsum("ni,ni->n", out, patches.normals[part == number]) > 0.4).all()
    assert patches.counted.reshape(-1, 2)[part == 2].all()
    assert not patches.counted[1::2][part < 2].any()
    assert patches.unit_areas().sum() == pytest.approx(6.0 + 6.0 + 2.0)


def test_a_finely_rounded_part_is_not_taken_as_plane():
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=0.2)  # 5120 faces, neighbours at 3 degrees
    patches = cut(target_of(mesh.vertices, mesh.faces), 1.0)
    off = np.abs(np.linalg.norm(patches.corners, axis=2) - 0.2)
    assert off.max() < 2.1e-5
    assert patches.areas.sum() == pytest.approx(mesh.area, rel=1e-9)


@pytest.mark.long
@settings(max_examples=3 * settings().max_examples)
@given(
    corners=st.lists(st.tuples(st.integers(0, 2), st.integers(0, 2), st.integers(0, 2)), min_size=4, max_size=12),
    picks=st.lists(st.tuples(*[st.integers(0, 11)] * 3), min_size=1, max_size=30),
    size=st.sampled_from([0.3, 0.7, 1.0, 5.0]),
)
def test_any_soup_keeps_its_area_in_convex_patches(corners, picks, size):
    # Few corners on a lattice: duplicates, overlaps, edges of many faces, faces without area, flipped neighbours.
    vertices = np.array(corners, dtype=np.float64)
    faces = np.array(picks) % len(vertices)
    target = target_of(vertices, faces)
    if mesh_area(target) == 0.0:
        with pytest.raises(InspectionError, match="no area"):
            cut(target, size)
        return
    patches = cut(target, size)
    assert patches.areas.sum() == pytest.approx(mesh_area(target), rel=1e-9)
    assert polygon_areas(patches) == pytest.approx(patches.areas, rel=1e-6)
    assert target.distance.distance(patches.corners.reshape(-1, 3)).max() < 2.1e-5
    assert np.isfinite(patches.centres).all()


def test_what_cannot_be_cut_is_refused_in_a_line(tmp_path):
    box = Target.load("box")
    for size in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(InspectionError, match="above 0"):
            cut(box, size)
    with pytest.raises(InspectionError, match=r"box: patches of 0\.001 m are at least 52000000"):
        cut(box, 0.001)
    np.save(tmp_path / "cloud.npy", np.random.default_rng(0).normal(size=(50, 3)))
    with pytest.raises(InspectionError, match="point cloud"):
        cut(Target.load(tmp_path / "cloud.npy", units="m", thickness=0.1), 0.5)
