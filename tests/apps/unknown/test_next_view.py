"""Which view comes next: what views may open, which room can be reached, and ends that are said."""

import math

import explore_views
import numpy as np
import pytest
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from keepout.apps.led.camera import Pinhole, axes_towards
from keepout.apps.unknown.cells import (
    CLOSE,
    EXPLAINED,
    FREE,
    NEARBY,
    PATIENCE,
    SURFACE,
    UNKNOWN,
    Cells,
    Frontier,
    Tried,
)
from keepout.apps.unknown.depth_sensor import DepthCamera
from keepout.apps.unknown.known_free import KnownFreeMap
from keepout.apps.unknown.next_view import UP, Ended, NextView, Seeker, choose
from keepout.apps.unknown.view import SensorBounds, View
from keepout.apps.unknown.ways import FAR, distance_at, reachable, shorten, walk_back

CAMERA = Pinhole(80, 60, math.radians(60.0))


def begun(radius=1.5, **bounds):
    return KnownFreeMap.begin(np.zeros(3), radius, bounds=SensorBounds(**bounds), name="test")


BLIND = np.full(CAMERA.shape, np.nan)


def view_at(position, ranges):
    """A view of the middle from a place."""
    position = np.array(position, dtype=float)
    return View(CAMERA, position, axes_towards(-position, UP), ranges, 0.0)


def test_cells_and_frontier_are_what_brute_force_says():
    known = begun()
    generator = np.random.default_rng(0)
    known.fill(known.free | (generator.random(known.free.shape) < 0.5))
    position = np.array([0.0, 0.0, 2.6])
    ranges = np.full(CAMERA.shape, np.nan)
    ranges[30, 40] = 2.0  # one return, at z = 0.6
    known.see(View(CAMERA, position, axes_towards(-UP, np.array([1.0, 0.0, 0.0])), ranges, 0.0))
    cells = Cells.of(known)
    n = len(cells.kinds)
    closed = ~known.free.reshape(n, 2, n, 2, n, 2).all(axis=(1, 3, 5))
    assert np.array_equal(cells.kinds != FREE, closed)
    holding = np.floor((known.returns[0] - known.origin) / 0.2).astype(int)
    assert (cells.kinds == SURFACE).sum() == closed[tuple(holding)]
    if closed[tuple(holding)]:
        apart = np.linalg.norm(np.argwhere(np.ones_like(closed)) - holding, axis=1).reshape(closed.shape) * 0.2
        explained = closed & (apart <= 0.35) & (apart > 0.0)
        assert np.array_equal(cells.kinds == EXPLAINED, explained)
        assert (apart[cells.kinds == CLOSE] < 1.6 + 1.1).all()
        assert (apart[(cells.kinds == UNKNOWN) | (cells.kinds == NEARBY)] > 1.6 - 1.1).all()
    edge = Frontier.of(cells)
    beside = ndimage.binary_dilation(cells.kinds == FREE) & (cells.kinds > EXPLAINED)
    beside[[0, -1]] = beside[:, [0, -1]] = beside[:, :, [0, -1]] = False
    assert np.array_equal(edge.cells, np.argwhere(beside))
    assert edge.sizes.sum() == len(edge.cells)
    assert np.array_equal(np.bincount(edge.cluster), edge.sizes)


def test_a_cell_that_stays_closed_is_given_up_after_views_from_different_directions_only():
    known = begun()
    tried = Tried.nothing(known)

    def look(position):
        tried.note(known, CAMERA, view_at(position, BLIND))

    look([2.6, 0.0, 0.0])
    once = tried.failures.copy()
    assert once.max() == 1
    facing = np.argwhere(once == 1)
    assert (known.origin[0] + 0.2 * (facing[:, 0] + 0.5) > 0.5).all()  # the side that it looked at
    look([2.6, 0.0, 0.05])
    assert np.array_equal(tried.failures, once)
    look([2.55, 0.45, 0.0])
    look([2.55, 0.0, 0.45])
    assert tried.failures.max() == PATIENCE == tried.patience
    assert len(tried.positions) == 4


def test_the_memory_of_views_can_be_made_again_from_the_map():
    known = begun()
    tried = Tried.nothing(known)
    for position in ([2.6, 0.0, 0.0], [0.0, 2.6, 0.0], [0.0, 0.3, 2.6]):
        ranges = np.full(CAMERA.shape, np.inf)
        ranges[:, :30] = np.nan
        view = view_at(position, ranges)
        assert known.see(view).opened > 0
        tried.note(known, CAMERA, view)
    again = Tried.of_map(known, CAMERA)
    closed = Cells.of(known).kinds != FREE
    assert (again.failures[closed] >= tried.failures[closed]).all()
    assert np.array_equal(np.array(again.positions), np.array(tried.positions))


KEEP = 0.25


def riddled(seed, share=0.5):
    """Make a map whose ball holds smooth random caves, and in its middle a closed one."""
    known = begun()
    noise = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=known.free.shape), 2.5)
    caves = noise > np.quantile(noise, 1.0 - share)
    from_middle = np.linalg.norm(np.indices(known.free.shape) + 0.5 - 0.5 * len(known.free), axis=0) * known.spacing
    known.fill((known.free | caves | (from_middle < 0.5)) & ~((from_middle > 0.5) & (from_middle < 0.7)))
    return known


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("stride", [1, 2, 3])
def test_what_is_called_reachable_is_joined_to_the_chaser_through_nodes_that_keep_the_distance(seed, stride):
    known = riddled(seed)
    outside = np.array([0.0, 0.0, 2.2])
    reach = reachable(known, outside, KEEP, stride=stride)
    distance = known.spacing * np.sqrt(known.squares, dtype=np.float64)
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
    length = np.full(price.shape, FAR, dtype=np.int32)
    length[0, 0, 0] = 0
    shorten(length, price, np.zeros((1, 1, 1), dtype=np.uint16))
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


APART = 0.5
OUTSIDE = np.array([2.8, 0.0, 0.0])


def next_of(known, goal=None, tried=None, position=OUTSIDE, **options):
    return choose(known, Seeker(position, CAMERA, APART), goal, tried or Tried.nothing(known), **options)


def test_a_goal_in_known_free_room_is_flown_to_and_no_way_leads_from_too_near_to_unknown_room():
    answer = next_of(begun(), np.array([-2.6, 0.0, 0.0]))
    assert answer.is_goal
    assert np.array_equal(answer.position, [-2.6, 0.0, 0.0])
    answer = next_of(begun(), position=np.zeros(3))
    assert isinstance(answer, Ended)
    assert answer.outcome == "no way known"


@pytest.mark.long
def test_a_goal_too_near_to_the_seen_surface_ends_at_once_and_one_farther_does_not():
    run = explore_views.Jumping(explore_views.solid("ball"), "ball", DepthCamera(), APART, 0)
    run.look()
    seen = run.position / np.linalg.norm(run.position)
    answer = run.step(2.05 * seen)
    assert isinstance(answer, Ended)
    assert "seen surface" in answer.why
    assert len(answer.unknown) > 0
    assert isinstance(run.step(3.0 * seen), NextView)


@pytest.mark.long
@pytest.mark.parametrize("goal", [pytest.param(None, marks=pytest.mark.slow), np.zeros(3)])
def test_views_that_open_nothing_are_not_taken_again_and_come_to_an_end(goal):
    known = begun(0.5)
    tried = Tried.nothing(known)
    position, before = np.array([2.0, 0.0, 0.0]), []
    for count in range(60):
        answer = next_of(known, goal, tried, position, seed=count)
        if isinstance(answer, Ended):
            break
        for place, direction in before:
            turned = answer.direction @ direction < math.cos(math.radians(10))
            assert turned or np.linalg.norm(answer.position - place) >= 0.3
        position = answer.position
        before.append((position, answer.direction))
        view = View(CAMERA, position, axes_towards(answer.direction, UP), BLIND, 0.0)
        assert known.see(view).opened == 0
        tried.note(known, CAMERA, view)
    assert isinstance(answer, Ended)
    assert answer.outcome == ("everything reachable seen" if goal is None else "no way known")
    assert "stayed closed in 3 views" in answer.why
    assert len(answer.unknown) > 0


@pytest.mark.slow
def test_a_goal_at_the_bottom_of_a_pocket_is_reached_and_one_inside_its_wall_is_not():
    mesh = explore_views.solid("pocket")
    run = explore_views.Jumping(mesh, "pocket", DepthCamera(), APART, 2)
    for _ in range(30):
        run.look()
        answer = run.step(np.array([0.0, 0.0, -1.2]))
        if isinstance(answer, Ended) or answer.is_goal:
            break
    assert isinstance(answer, NextView)
    assert answer.is_goal
    for _ in range(30):
        answer = run.step(np.array([1.8, 0.0, 0.0]))
        if isinstance(answer, Ended):
            break
        run.look()
    assert isinstance(answer, Ended)
    assert answer.outcome == "no way known"
