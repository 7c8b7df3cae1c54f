"""Reachable room against a labelling and a shortest-path solver of SciPy, on maps of random free room."""

import numpy as np
import pytest
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from keepout.exploring.lattice import FAR, shortest, walk_back
from keepout.exploring.reachable import distance_at, reachable
from keepout.mapping import KnownFreeMap, SensorBounds

KEEP = 0.25


def begun(radius=1.5):
    return KnownFreeMap.begin(np.zeros(3), radius, bounds=SensorBounds(), name="test")


def riddled(seed, share=0.5):
    """Make a map whose ball holds smooth random caves, and in its middle a closed one."""
    known = begun()
    noise = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=known.free.shape), 2.5)
    caves = noise > np.quantile(noise, 1.0 - share)
    from_middle = np.linalg.norm(np.indices(known.free.shape) + 0.5 - 0.5 * len(known.free), axis=0) * known.spacing
    known.fill((known.free | caves | (from_middle < 0.5)) & ~((from_middle > 0.5) & (from_middle < 0.7)))
    return known


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("stride", [1, 2, 3])
def test_what_is_called_reachable_is_joined_to_the_chaser_through_nodes_that_keep_the_distance(seed, stride):
    known = riddled(seed)
    outside = np.array([0.0, 0.0, 2.2])
    reach = reachable(known, outside, KEEP, stride=stride)
    distance = known.distance_at_nodes()
    labels, count = ndimage.label(distance >= KEEP - 1e-9, np.ones((3, 3, 3)))
    ours = labels[tuple(np.round((outside - known.origin) / known.spacing).astype(int))]
    assert ours > 0
    joined = labels[::stride, ::stride, ::stride] == ours
    assert not np.any(reach.reached & ~joined)
    assert count > 1  # rooms that no way leads to: the test could fail
    if stride == 1:
        assert np.array_equal(reach.reached, joined)
    else:
        assert np.count_nonzero(reach.reached) > 0.5 * np.count_nonzero(joined)


def test_lengths_are_those_of_an_independent_solver():
    generator = np.random.default_rng(3)
    price = generator.choice([0, 1, 3, 40], size=(7, 8, 9), p=[0.2, 0.5, 0.2, 0.1]).astype(np.uint8)
    price[0, 0, 0] = 1
    length = shortest(price, np.array([[0, 0, 0]]), np.array([0]))
    index = np.arange(price.size).reshape(price.shape)
    rows, columns, costs = [], [], []
    for node in np.ndindex(price.shape):
        for step in np.ndindex(3, 3, 3):
            beside = tuple(a + s - 1 for a, s in zip(node, step, strict=True))
            changed = sum(s != 1 for s in step)
            inside = all(0 <= a < n for a, n in zip(beside, price.shape, strict=True))
            if changed and inside and price[node] and price[beside]:
                rows.append(index[node])
                columns.append(index[beside])
                costs.append([0, 10, 14, 17][changed] * int(price[beside]))
    truth = dijkstra(coo_matrix((costs, (rows, columns)), shape=(price.size,) * 2).tocsr(), indices=0)
    assert np.array_equal(np.where(length == FAR, np.inf, length).ravel(), truth)
    end = np.unravel_index(np.argmax(np.where(np.isfinite(truth), truth, -1.0)), price.shape)
    way = walk_back(length, price, np.array(end))
    assert tuple(way[0]) == (0, 0, 0)
    assert tuple(way[-1]) == tuple(end)
    steps = np.abs(np.diff(way, axis=0))
    cost = np.array([0, 10, 14, 17])[steps.sum(axis=1)] * price[tuple(way[1:].T)].astype(int)
    assert steps.max() == 1
    assert cost.sum() == length[tuple(end)]


def test_a_goal_in_unknown_room_is_not_reachable_and_one_outside_the_ball_is():
    known = begun()
    reach = reachable(known, np.array([3.0, 0.0, 0.0]), KEEP)
    assert reach.leads_to(known, np.array([-2.3, 0.0, 0.0]))
    assert reach.leads_to(known, np.array([-9.0, 4.0, 0.0]))
    assert not reach.leads_to(known, np.zeros(3))
    # Within a lattice cell of room that keeps the distance, but nearer than that itself.
    edge = np.array([-1.6, 0.0, 0.0])
    assert distance_at(known, edge) < KEEP
    assert not reach.leads_to(known, edge)
    assert reach.way_length(np.array([-2.3, 0.0, 0.0])) > np.pi * 1.5


def test_the_distance_between_nodes_is_interpolated():
    known = begun()
    nodes = known.distance_at_nodes()
    place = known.origin + known.spacing * np.array([4.0, 5.5, 6.25])
    expected = np.array([0.75, 0.25]) @ (0.5 * (nodes[4, 5, 6:8] + nodes[4, 6, 6:8]))
    assert distance_at(known, place) == pytest.approx(expected, abs=1e-12)
    assert distance_at(known, known.origin - 1.0) == known.cap
