"""Departures of the seen surface from an expected mesh: none where nothing moved, and a moved panel in metres."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from truths.made_meshes import target_of

from keepout.apps.led.camera import Pinhole, axes_towards
from keepout.apps.led.first_hit import FirstHit
from keepout.apps.unknown.depth_sensor import DepthCamera, ErrorDraw, take
from keepout.apps.unknown.exploration import _depth, departures
from keepout.apps.unknown.known_free import KnownFreeMap, ViewStatus
from keepout.core.geometry.builtin import box, mesh, unite
from keepout.core.geometry.level_set import surface_points
from keepout.core.geometry.target import Target

CAMERA = DepthCamera(camera=Pinhole(120, 90, math.radians(60.0)), dropout=0.0005, grazing_angle=1.48)
SHIFT = 1.2


def body(lifted: float) -> Target:
    """A box with a panel beside it, lifted by so many metres."""
    vertices, faces = mesh(unite([box((0.0, 0.0, 0.0), (1.5, 1.5, 1.5)), box((1.8, 0.0, lifted), (2.0, 2.0, 0.08))]))
    return target_of(vertices, faces, "body")


def seen(target: Target, seed: int, size: str = "adversarial", views: int = 40) -> KnownFreeMap:
    known = KnownFreeMap.begin(np.zeros(3), 3.6, spacing=0.1, cap=1.2, bounds=CAMERA.bounds, name="body")
    generator, first_hit = np.random.default_rng(seed), FirstHit(target.vertices, target.faces)
    for _ in range(views):
        direction = generator.normal(size=3)
        position = direction * (5.0 / np.linalg.norm(direction))
        axes = axes_towards(0.8 * generator.normal(size=3) - position, np.array([0.0, 0.0, 1.0]))
        assert known.see(take(CAMERA, first_hit, position, axes, generator, ErrorDraw(size))).status is ViewStatus.SEEN
    return known


@pytest.fixture(scope="module")
def lifted_map() -> KnownFreeMap:
    return seen(body(SHIFT), 0)


@pytest.mark.long
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_nothing_departs_where_nothing_moved(seed):
    target = body(0.0)
    known = seen(target, seed)
    found = departures(known, target, CAMERA.camera)
    assert (len(found.points), len(found.missing), found.largest) == (0, 0, 0.0)
    assert len(known.returns) > 5000
    assert known.free.mean() > 0.5
    # The bound is no idle one: errors do carry returns a good part of it away from the surface.
    assert target.distance.distance(known.returns.astype(float)).max() > 0.4 * found.explained


@pytest.mark.long
def test_a_moved_panel_is_found_where_it_is_and_missed_where_it_was(lifted_map):
    true, expected = body(SHIFT), body(0.0)
    found = departures(lifted_map, expected, CAMERA.camera)
    assert found.largest > 0.0
    # Every return is near the true surface, and farther from the expected one than that explains.
    assert true.distance.distance(found.points.astype(float)).max() <= found.explained
    assert found.distance.min() > found.explained
    surface = surface_points(true.distance, 100_000, np.random.default_rng(1), by_area=0.5)
    farthest = float(expected.distance.distance(surface).max())
    assert farthest > 1.0
    assert abs(found.distance.max() - farthest) <= found.explained + 0.02
    # The old panel is missing, and no deeper in free room than the true surface leaves it.
    assert (true.distance.distance(found.missing) >= found.depth).all()
    assert found.missing[:, 0].min() > 0.75
    assert 0.6 * 8.0 < found.missing_area < 1.1 * 8.0
    assert found.depth.max() > 0.5
    assert found.largest == pytest.approx(max(found.distance.max(), found.depth.max()))


@pytest.mark.long
def test_a_part_that_nobody_expected_is_seen_and_nothing_is_missing(lifted_map):
    vertices, faces = mesh(box((0.0, 0.0, 0.0), (1.5, 1.5, 1.5)))
    found = departures(lifted_map, target_of(vertices, faces, "alone"), CAMERA.camera)
    assert len(found.points) > 100
    assert len(found.missing) == 0


@pytest.mark.long
@given(seed=st.integers(0, 2**32 - 1))
def test_depth_never_exceeds_the_distance_to_what_is_not_free(seed):
    generator = np.random.default_rng(seed)
    known = KnownFreeMap.begin(np.zeros(3), 0.6, spacing=0.2, cap=1.2, bounds=CAMERA.bounds, name="any")
    free = known.free_outside_the_ball() | (generator.random(known.free.shape) < 0.9)
    known.fill(free)
    points = generator.uniform(-2.0, 2.0, (200, 3))
    low = known.origin + known.spacing * np.argwhere(~free)
    gap = np.maximum(np.maximum(low - points[:, None], points[:, None] - low - known.spacing), 0.0)
    brute = np.linalg.norm(gap, axis=2).min(axis=1) if len(low) else np.full(len(points), np.inf)
    depth = _depth(known, points)
    assert (depth <= brute + 1e-12).all()
    assert (depth >= np.minimum(brute, known.cap) - 2 * 0.2 * math.sqrt(3.0)).all()
