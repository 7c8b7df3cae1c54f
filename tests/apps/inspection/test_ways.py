"""Ways round a ball, whose lengths are known: {distance to a point ≥ r}."""

import math
from itertools import pairwise

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from keepout.apps.inspection.ways import Ways, way_length
from keepout.core.geometry.distance import ExactDistance

RADIUS = 2.0


POINT = ExactDistance(np.zeros((1, 3)), np.zeros((1, 3), dtype=np.int64))


def ways_in(half, radius=RADIUS, around=POINT, nodes=60_000):
    return Ways.build(around, radius, np.full(3, -half), np.full(3, half), most_nodes=nodes)


@pytest.fixture(scope="module")
def ways():
    return ways_in(7.0)


def geodesic(a, b):
    """Length of the shortest way from a to b outside the ball: two tangents and an arc, or straight."""
    between = math.acos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1.0, 1.0))
    first, second = (math.acos(min(RADIUS / np.linalg.norm(p), 1.0)) for p in (a, b))
    if between <= first + second:
        return float(np.linalg.norm(a - b))
    return RADIUS * (math.tan(first) + math.tan(second) + between - first - second)


def nearest_of_segment(a, b):
    share = np.clip(-a @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
    return float(np.linalg.norm(a + share * (b - a)))


def places(seed, count):
    generator = np.random.default_rng(seed)
    directions = generator.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions * generator.uniform(RADIUS + 0.05, 5.0, (count, 1))


@pytest.mark.long
@given(seed=st.integers(0, 2**31))
def test_a_piece_is_clear_if_and_only_if_it_keeps_the_stand_off(seed):
    ways = ways_in(6.0, nodes=200)
    begins, ends = places(seed, 40), places(seed + 1, 40)
    clear = ways.clear(begins, ends)
    least = np.array([nearest_of_segment(a, b) for a, b in zip(begins, ends, strict=True)])
    assert not clear[least < RADIUS].any()
    assert clear[least > RADIUS + 0.01].all()


def test_paths_keep_the_stand_off_and_are_hardly_longer_than_the_shortest(ways):
    stops = places(5, 12)
    for a, b in pairwise(stops):
        path = ways.path(a, b)
        assert np.array_equal(path[[0, -1]], [a, b])
        assert all(nearest_of_segment(p, q) >= RADIUS - 1e-9 for p, q in pairwise(path))
        shortest = geodesic(a, b)
        assert shortest - 1e-9 <= way_length(path) <= 1.06 * shortest + 0.05


@pytest.mark.long
@pytest.mark.parametrize(("seed", "count", "longer", "on_average"), [(8, 14, 1.15, 1.05), (11, 70, 1.6, 1.08)])
def test_lengths_of_all_pairs_and_where_they_set_out(seed, count, longer, on_average, ways):
    """With 70 places, ways to those beyond the neighbours lead from neighbour to neighbour."""
    stops = places(seed, count)
    lengths, leave = ways.lengths(stops)
    assert np.allclose(lengths, lengths.T)
    shortest = np.array([[geodesic(a, b) if a is not b else 0.0 for b in stops] for a in stops])
    other = ~np.eye(count, dtype=bool)
    assert (lengths >= shortest - 1e-9).all()
    assert (lengths[other] <= longer * shortest[other] + 0.1).all()
    assert np.mean(lengths[other] / shortest[other]) <= on_average
    straight = ways.clear(np.repeat(stops, count, axis=0), np.tile(stops, (count, 1))).reshape(count, count) & other
    assert count > 20 or np.allclose(lengths[straight], shortest[straight])
    assert np.allclose(np.linalg.norm(leave[other], axis=-1), 1.0)
    # No way sets out into the ball.
    ahead = np.repeat(stops, count, axis=0).reshape(count, count, 3) + 0.02 * leave
    assert (np.linalg.norm(ahead[other], axis=1) >= RADIUS).all()
    assert np.allclose(ways.nearly(stops[0], stops[1:])[:13], lengths[0, 1:14], atol=0.2 * longer + 2.0 * ways.spacing)


def test_clusters_far_from_each_other_are_joined():
    middles = np.array([[-30.0, 0.0, 0.0], [30.0, 1.0, 0.0]])
    stops = np.concatenate([middle + places(4, 30) / 5.0 for middle in middles])
    lengths, _ = ways_in(40.0, 1.0).lengths(stops)
    apart = np.linalg.norm(stops[None] - stops[:, None], axis=2)
    assert (lengths >= apart - 1e-9).all()
    assert (lengths <= 1.2 * apart + 2.0).all()


def test_what_is_shut_in_is_not_reached():
    shell = trimesh.creation.box((6.0, 6.0, 6.0))
    ways = ways_in(6.0, 1.0, ExactDistance(shell.vertices, shell.faces), 20_000)
    inside, outside, beside = np.zeros(3), np.array([5.0, 0.0, 0.0]), np.array([0.5, 0.5, 0.0])
    assert ways.path(inside, outside) is None
    lengths, _ = ways.lengths(np.stack([inside, outside, beside]))
    assert np.isinf(lengths[[0, 2], 1]).all()
    assert lengths[0, 2] == pytest.approx(math.sqrt(0.5))
    assert ways.reached(outside, np.stack([inside, outside, -outside, beside])).tolist() == [False, True, True, False]


def test_from_a_place_that_is_too_near_a_way_leads_out(ways):
    path = ways.path(np.array([RADIUS - 0.2, 0.0, 0.0]), np.array([-4.0, 0.0, 0.0]))
    assert path is not None
    assert ways.clear(path[1:-1], path[2:]).all()
