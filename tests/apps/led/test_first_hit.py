"""First hits of rays against brute force and closed forms; edges and corners are never slipped through."""

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import Delaunay
from truths.messy_meshes import MESSY_AND_REAL

from keepout.apps.led.first_hit import FirstHit
from keepout.core.errors import MeshError


def brute_force(origins, directions, triangles, slack):
    """Cut each ray with every triangle's plane; a hit has barycentric coordinates >= -slack. Unit directions."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    out = np.full(len(origins), np.inf)
    for i, (o, d) in enumerate(zip(origins, directions)):
        e, f = b - a, c - a
        across = np.cross(d, f)
        det = (e * across).sum(1)
        with np.errstate(divide="ignore", invalid="ignore"):
            s = o - a
            u = (s * across).sum(1) / det
            turned = np.cross(s, e)
            v = turned @ d / det
            t = (f * turned).sum(1) / det
            met = (u >= -slack) & (v >= -slack) & (u + v <= 1.0 + slack) & (t >= 0.0)
        out[i] = t[met].min(initial=np.inf)
    return out


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def random_rays(lower, upper, count, seed=0):
    rng = np.random.default_rng(seed)
    middle, half = 0.5 * (lower + upper), 0.5 * np.linalg.norm(upper - lower)
    origins = middle + unit(rng.normal(size=(count, 3))) * half * rng.uniform(0.0, 2.0, (count, 1))
    goals = rng.uniform(lower, upper, (count, 3))
    return origins, unit(goals - origins)


def assert_as_brute_force(first_hit, origins, directions):
    """Between the brute force that counts a bit too much and the one that counts a bit too little, and mostly both."""
    triangles = first_hit.vertices[first_hit.faces]
    ranges, faces = first_hit.cast(origins, directions)
    most, least = brute_force(origins, directions, triangles, 1e-9), brute_force(origins, directions, triangles, -1e-9)
    clear = most == least
    assert clear.mean() > 0.95
    np.testing.assert_array_equal(np.isfinite(ranges[clear]), np.isfinite(most[clear]))
    met = clear & np.isfinite(ranges)
    # What rounding moves a hit by grows as the ray comes to lie along the triangle.
    cosine = np.abs((first_hit.normals[faces] * directions).sum(1))
    np.testing.assert_array_less(np.abs(ranges[met] - most[met]) * cosine[met], 1e-12 * (1.0 + most[met]))
    between = (ranges >= most - 1e-6) & ((ranges <= least + 1e-6) | np.isinf(least))
    assert between.all()
    np.testing.assert_array_equal(faces >= 0, np.isfinite(ranges))


def grid_box(times):
    """A box from (-1, -1, -1) to (1, 1, 1) whose triangles are cut in four so many times."""
    mesh = trimesh.creation.box(extents=(2.0, 2.0, 2.0))
    for _ in range(times):
        mesh = mesh.subdivide()
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


@pytest.mark.parametrize("mesh", MESSY_AND_REAL)
def test_agrees_with_brute_force_on_real_and_messy_meshes(mesh, tmp_path):
    target = mesh(tmp_path)
    first_hit = FirstHit(target.vertices, target.faces)
    assert_as_brute_force(first_hit, *random_rays(first_hit.lower, first_hit.upper, 300))


triangle_soups = st.integers(1, 40).flatmap(
    lambda count: st.tuples(
        st.lists(st.tuples(*[st.integers(-8, 8)] * 3), min_size=3 * count, max_size=3 * count),
        st.integers(0, 2**32 - 1),
        st.sampled_from([1e-3, 1.0, 1e3]),
        st.sampled_from([0.0, 1e3]),
    )
)


@given(triangle_soups)
def test_agrees_with_brute_force_on_any_soup(drawn):
    corners, seed, size, offset = drawn
    vertices = np.array(corners, dtype=np.float64)
    rng = np.random.default_rng(seed)
    origins = rng.uniform(-12.0, 12.0, (40, 3))
    directions = unit(rng.uniform(-8.0, 8.0, (40, 3)) - origins)
    first_hit = FirstHit(vertices, np.arange(len(vertices)).reshape(-1, 3))
    ranges = first_hit.ranges(origins, directions)
    triangles = first_hit.vertices[first_hit.faces]
    most, least = brute_force(origins, directions, triangles, 1e-9), brute_force(origins, directions, triangles, -1e-9)
    # The same, moved and of another size: only rounding may differ.
    moved = FirstHit(size * vertices + offset, first_hit.faces).ranges(size * origins + offset, directions) / size
    for found in (ranges, moved):
        assert (found >= most - 1e-6).all()
        assert ((found <= least + 1e-6) | np.isinf(least)).all()


def test_no_ray_slips_through_a_sheet_of_slivers():
    """Rays at points of edges, as exactly as they can be told."""
    rng = np.random.default_rng(3)
    flat = np.concatenate([rng.uniform(-1.0, 1.0, (2000, 2)), [[-1, -1], [-1, 1], [1, -1], [1, 1]]])
    flat[:1000, 0] *= 1e-3  # many slivers
    faces = Delaunay(flat).simplices
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    vertices = np.column_stack([flat, 0.1 * np.sin(5.0 * flat[:, 0])]) @ turn.T
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    start, end = vertices[edges].transpose(1, 0, 2)
    first_hit = FirstHit(vertices, faces)
    tried = slipped = 0
    while tried < 150_000:
        origin = turn @ np.array([*rng.uniform(-1.0, 1.0, 2), 5.0])
        share = rng.choice([0.0, 1.0, 0.5, rng.random()], size=(len(start), 1))
        aims = (1.0 - share) * start + share * end
        # Near the rim the sheet can be seen folded: past the fold there is nothing to meet.
        covered = np.abs((aims @ turn)[:, :2]).max(1) < 0.9
        ranges = first_hit.ranges(origin[None], aims[covered] - origin)
        tried += len(ranges)
        slipped += int(np.isinf(ranges).sum())
    assert slipped == 0


SHEET = [(1, -1, 0), (3, -1, 0), (3, 1, 0), (1, 1, 0)], [(0, 1, 2), (0, 2, 3)]
NEEDLE = [(1, 0, 0), (1, 1, 0), (1, 2, 0)], [(0, 1, 2)]
POINT = [(5, 0, 0)], [(0, 0, 0)]
BOX = grid_box(1)


@pytest.mark.parametrize(
    ("mesh", "origin", "direction", "greatest", "met"),
    [
        # A sheet along the ray is met at its rim.
        (SHEET, (0, 0, 0), (1, 0, 0), np.inf, 1.0),
        (SHEET, (2, 0.25, 0), (1, 0, 0), np.inf, 0.0),
        (SHEET, (4, 0, 0), (1, 0, 0), np.inf, np.inf),
        (SHEET, (5, 0, 0), (-1, 0, 0), np.inf, 2.0),
        (SHEET, (0, 0, 1e-9), (1, 0, 0), np.inf, np.inf),
        (SHEET, (0, 5, 0), (1, 0, 0), np.inf, np.inf),
        # Triangles without area are met as what they are.
        (NEEDLE, (0, 0.5, 0), (1, 0, 0), np.inf, 1.0),
        (NEEDLE, (0, 0.5, 1e-6), (1, 0, 0), np.inf, np.inf),
        (POINT, (0, 0, 0), (1, 0, 0), np.inf, 5.0),
        # A range counts in metres from the origin, within it too, whatever the direction's length, up to the greatest.
        (BOX, (-3, 0.3, 0.4), (2, 0, 0), np.inf, 2.0),
        (BOX, (-3, 0.3, 0.4), (2, 0, 0), 2.0, 2.0),
        (BOX, (-3, 0.3, 0.4), (2, 0, 0), 1.999, np.inf),
        (BOX, (-1, 0.3, 0.4), (2, 0, 0), np.inf, 0.0),
        (BOX, (0, 0.3, 0.4), (2, 0, 0), np.inf, 1.0),
        (BOX, (-3, 0.3, 0.4), (-2, 0, 0), np.inf, np.inf),
    ],
)
def test_special_places(mesh, origin, direction, greatest, met):
    vertices, faces = np.asarray(mesh[0], float), np.asarray(mesh[1])
    assert FirstHit(vertices, faces).ranges(np.array([origin], float), np.array([direction], float), greatest) == met


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"origins": np.array([[np.nan, 0.0, 0.0]])}, "not finite"),
        ({"directions": np.array([[np.inf, 0.0, 0.0]])}, "not finite"),
        ({"directions": np.zeros((1, 3))}, "length 0"),
        ({"greatest": 0.0}, "greatest is 0 m"),
        ({"greatest": float("nan")}, "greatest is nan m"),
    ],
)
def test_bad_rays_are_refused(change, words):
    vertices, faces = grid_box(1)
    rays = {"origins": np.zeros((1, 3)), "directions": np.array([[0.0, 0.0, 1.0]]), "greatest": 1.0} | change
    with pytest.raises(MeshError, match=words) as refusal:
        FirstHit(vertices, faces).ranges(**rays)
    assert "\n" not in str(refusal.value)
