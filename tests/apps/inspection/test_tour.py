"""Tours against every order there is, and what an order costs against sums by hand."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse.csgraph import minimum_spanning_tree

from keepout.apps.inspection import tour as tours
from keepout.apps.inspection.tour import Legs, best_tour, flown, nearest_first, turning_time


def legs_between(places, *, turns=None, dwell=0.0, speed=0.1, acceleration=0.01):
    apart = places[None] - places[:, None]
    lengths = np.linalg.norm(apart, axis=2)
    leave = apart / np.maximum(lengths, 1e-12)[..., None]
    turns = np.zeros_like(lengths) if turns is None else turns
    return Legs(lengths, leave, turns, speed, acceleration, dwell, 0.0)


SQUARE = np.array([[0.0, 0, 0], [10.0, 0, 0], [10.0, 10.0, 0]])


@pytest.mark.long
def test_a_corner_is_flown_through_by_hand():
    tour = flown(legs_between(SQUARE), np.array([1, 2]))
    # From rest to 0.1 m/s, round a right angle, to rest; half of each change over the acceleration is lost.
    delta_v = 0.1 + 0.1 * math.sqrt(2.0) + 0.1
    assert tour.delta_v == pytest.approx(delta_v)
    assert tour.end == pytest.approx(200.0 + 0.5 * delta_v / 0.01)
    staying = flown(legs_between(SQUARE, dwell=30.0), np.array([1, 2]))
    assert staying.delta_v == pytest.approx(0.4)
    assert staying.end == pytest.approx(200.0 + 60.0 + 0.5 * 0.4 / 0.01)


def test_a_turn_from_rest_to_rest():
    axis = np.eye(3)
    rate, acceleration = math.radians(1.0), 0.002
    long = turning_time(axis[:1], axis[1:2], rate, acceleration)[0, 0]
    assert long == pytest.approx(90.0 + rate / acceleration)
    angle = 0.5 * rate**2 / acceleration
    other = np.array([[math.cos(angle), math.sin(angle), 0.0]])
    # Half of the way at full acceleration, half at full deceleration.
    short = turning_time(axis[:1], other, rate, acceleration)[0, 0]
    assert short == pytest.approx(2.0 * math.sqrt(angle / acceleration))


def legs_among(seed, count, **numbers):
    """Give places at random, and boresights; the ways are straight."""
    generator = np.random.default_rng(seed)
    places, boresights = generator.uniform(-10.0, 10.0, (count, 3)), generator.normal(size=(count, 3))
    boresights /= np.linalg.norm(boresights, axis=1, keepdims=True)
    return legs_between(places, turns=turning_time(boresights, boresights, math.radians(1.0), 0.002), **numbers)


@pytest.mark.long
@pytest.mark.parametrize("places", [6, pytest.param(7, marks=pytest.mark.slow)])
@pytest.mark.parametrize("objective", ["time", "delta_v", "both"])
def test_of_all_orders_the_best_is_found(objective, places):
    value = {
        "time": lambda tour: tour.end + 0.1 * tour.delta_v,
        "delta_v": lambda tour: 0.001 * tour.end + 100.0 * tour.delta_v,
        "both": lambda tour: tour.end + 1000.0 * tour.delta_v,
    }[objective]

    for seed in range(2):
        legs = legs_among(seed, places)
        best = min(value(flown(legs, np.array(order))) for order in itertools.permutations(range(1, places)))
        assert value(best_tour(legs, objective)) == pytest.approx(best)


def terms(legs):
    taken = np.maximum(np.maximum(legs.lengths / legs.speed, legs.turns), 1e-9)
    return taken, (legs.lengths / taken)[..., None] * legs.leave, 0.5 / legs.acceleration


@given(seed=st.integers(0, 2**31), count=st.integers(2, 9), stops=st.booleans())
def test_a_move_gains_what_the_order_costs_less(seed, count, stops):
    legs = legs_among(seed, count + 1, dwell=20.0 if stops else 0.0)
    taken, velocities, change = terms(legs)
    generator = np.random.default_rng(seed)
    before = generator.permutation(np.arange(1, count + 1))
    for _ in range(20):
        first, last = np.sort(generator.integers(2, count + 2, 2))
        to = int(generator.choice([t for t in range(1, count + 2) if t < first or t > last]))
        turned = bool(generator.random() < 0.5)
        order = np.concatenate([[-1, 0], before, [-1]])
        move = (first, last, to, turned)
        gain = tours._gain(order, move, (taken, velocities, change, stops))
        tours._put(order, np.zeros(count + 1, dtype=np.int64), move, np.empty_like(order))
        after = order[2:-1]
        assert sorted(after) == list(range(1, count + 1))
        assert gain == pytest.approx(flown(legs, before).end - flown(legs, after).end, abs=1e-6)
        before = after


@pytest.mark.slow  # small tours are held against all orders
@pytest.mark.long
def test_a_tour_of_many_places_is_between_the_least_tree_and_the_nearest_first_and_not_made_worse():
    generator = np.random.default_rng(4)
    short = legs_between(generator.uniform(-10.0, 10.0, (30, 3)), acceleration=1e9)
    tour, nearest = best_tour(short), flown(short, nearest_first(short))
    assert sorted(tour.order) == list(range(1, 30))
    length, by_nearest = (short.lengths[[0, *one.order[:-1]], one.order].sum() for one in (tour, nearest))
    assert minimum_spanning_tree(short.lengths).sum() <= length < 0.97 * by_nearest
    legs = legs_among(3, 150)
    tour = best_tour(legs)
    assert sorted(tour.order) == list(range(1, 150))
    assert tour.end < 0.93 * flown(legs, nearest_first(legs)).end
    assert flown(legs, tour.order).end >= best_tour(legs, begin=tour.order).end - 1e-6
