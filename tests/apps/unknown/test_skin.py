"""The skin of a map: a closed surface round all that free room outside does not reach; a mesh to every command."""

import math

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from truths.depth_views import Ball, axes_towards, view_of

from keepout.apps.led.camera import Pinhole
from keepout.apps.unknown.known_free import KnownFreeMap
from keepout.apps.unknown.map_file import save
from keepout.apps.unknown.skin import reachable_cubes, skin
from keepout.apps.unknown.view import SensorBounds
from keepout.core.errors import MeshError
from keepout.core.geometry.target import Target

BOUNDS = SensorBounds(surely_returned_width=0.12)


def map_of(free):
    """A map whose free cubes in the middle are these."""
    known = KnownFreeMap.begin([1.0, -2.0, 0.5], 1.0, spacing=0.25, cap=0.5, bounds=BOUNDS, name="cubes")
    inside = known.free.copy()
    low = (len(inside) - len(free)) // 2
    inside[...] = True
    inside[low : low + len(free), low : low + len(free), low : low + len(free)] = free
    known.fill(inside)
    return known


def edge_counts(faces):
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return np.unique(edges, axis=0, return_counts=True)[1]


def outside(free):
    """Free cubes joined to the grid's border, step by step: what is free and beside what is joined is joined too."""
    free = np.pad(free, 1, constant_values=True)
    joined, before = np.pad(np.zeros_like(free[1:-1, 1:-1, 1:-1]), 1, constant_values=True), None
    while before is None or (joined != before).any():
        before = joined
        joined = joined | free & np.logical_or.reduce([np.roll(joined, s, a) for a in range(3) for s in (-1, 1)])
    return joined[1:-1, 1:-1, 1:-1]


@given(st.integers(0, 10**6), st.floats(0.1, 0.95))
def test_every_edge_has_an_even_number_of_triangles_and_the_volume_is_the_obstacles(seed, share):
    """Random room at these shares holds rooms that are shut in as well."""
    known = map_of(np.random.default_rng(seed).random((8, 8, 8)) < share)
    vertices, faces = skin(known)
    reached = outside(known.free)
    np.testing.assert_array_equal(reachable_cubes(known.free), reached)
    assert (edge_counts(faces) % 2 == 0).all()
    corners = vertices[faces]
    volume = np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    assert volume == pytest.approx((~reached).sum() * 0.25**3)
    assert len(np.unique(faces)) == len(vertices) == len(np.unique(vertices.round(9), axis=0))
    # Just outside each triangle there is room that is reached, just inside there is none.
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    for step, wanted in ((0.01, True), (-0.01, False)):
        cells = np.floor((corners.mean(axis=1) + step * normal - known.origin) / 0.25).astype(int)
        assert (reached[tuple(cells.T)] == wanted).all()


def test_a_winding_way_in_is_followed():
    """A tunnel of nine rows in three floors that turns back on itself on every axis."""
    free = np.zeros((8, 8, 8), dtype=bool)
    free[1:7, 1:6:2, 1:6:2] = True
    free[6, 2, 1:6:2] = free[1, 4, 1:6:2] = True  # from row to row
    free[0, 1, 1] = free[6, 5, 2] = free[1, 1, 4] = True  # in, and from floor to floor
    known = map_of(free)
    assert reachable_cubes(known.free).sum() == known.free.sum()


def seen_map():
    known = KnownFreeMap.begin(np.zeros(3), 1.0, spacing=0.1, cap=0.3, bounds=BOUNDS, name="ball")
    body = (Ball((0.0, 0.0, 0.0), 0.4),)
    camera = Pinhole(40, 30, math.radians(60.0))
    for direction in np.vstack([np.eye(3), -np.eye(3), [[1.0, 1, 1], [-1, -1, 1], [1, -1, -1], [-1, 1, -1]]]):
        position = 2.2 * direction / np.linalg.norm(direction)
        known.see(view_of(body, camera, BOUNDS, position, axes_towards(-position)))
    return known


def test_a_map_file_is_a_target(tmp_path):
    known = seen_map()
    target = Target.load(save(known, tmp_path / "ball.keepmap"))
    assert target.name == "ball"
    assert target.report.open_edges == 0
    assert (edge_counts(target.faces) % 2 == 0).all()
    mesh = trimesh.Trimesh(target.vertices, target.faces)
    # It holds the body, and is no larger than what the views left unknown.
    assert target.vertices.min() <= -0.4
    assert 4.0 / 3.0 * math.pi * 0.4**3 < mesh.volume < 4.0 / 3.0 * math.pi * 0.95**3
    assert any("10 views" in line for line in target.report.actions)


def test_a_map_is_in_metres_by_its_format(tmp_path):
    """A small one is no question as a small mesh is, and none is scaled."""
    known = KnownFreeMap.begin(np.zeros(3), 0.15, spacing=0.02, cap=0.06, bounds=BOUNDS, name="small")
    path = save(known, tmp_path / "small.keepmap")
    target = Target.load(path)
    assert 0.3 <= np.ptp(target.vertices, axis=0).max() < 0.4
    assert Target.load(path, units="m").sha256 == target.sha256
    for given_scale in ({"units": "mm"}, {"scale": 2.0}):
        with pytest.raises(MeshError, match="a map is in metres"):
            Target.load(path, **given_scale)
