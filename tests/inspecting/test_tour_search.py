"""Moves of an order against what `flown` says of the order before and after, and tours of many places."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from keepout.inspecting import tour_search
from keepout.inspecting.tour import Legs, best_tour, flown, nearest_first, turning_time, waits_never

SPEED, ACCELERATION = 0.1, 0.01


def legs_among(seed, count, dwell=0.0):
    """Give places at random, and boresights; the ways are straight."""
    generator = np.random.default_rng(seed)
    places, boresights = generator.uniform(-10.0, 10.0, (count, 3)), generator.normal(size=(count, 3))
    boresights /= np.linalg.norm(boresights, axis=1, keepdims=True)
    apart = places[None] - places[:, None]
    lengths = np.linalg.norm(apart, axis=2)
    turns = turning_time(boresights, boresights, np.radians(1.0), 0.002)
    leave = apart / np.maximum(lengths, 1e-12)[..., None]
    return Legs(lengths, leave, turns, SPEED, ACCELERATION, dwell, 0.0, waits_never(count))


def terms(legs):
    taken = np.maximum(np.maximum(legs.lengths / legs.speed, legs.turns), 1e-9)
    return taken, (legs.lengths / taken)[..., None] * legs.leave, 0.5 / legs.acceleration


@settings(max_examples=30, deadline=None)
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
        gain = tour_search._gain(order, first, last, to, turned, taken, velocities, change, stops)
        tour_search._put(order, np.zeros(count + 1, dtype=np.int64), first, last, to, turned, np.empty_like(order))
        after = order[2:-1]
        assert sorted(after) == list(range(1, count + 1))
        assert gain == pytest.approx(flown(legs, before).end - flown(legs, after).end, abs=1e-6)
        before = after


def test_orders_of_many_places_cost_far_less_than_going_to_the_nearest():
    legs = legs_among(3, 150)
    nearest = flown(legs, nearest_first(legs))
    tour = best_tour(legs)
    assert sorted(tour.order) == list(range(1, 150))
    assert tour.end < 0.93 * nearest.end


def test_an_order_to_begin_with_is_not_made_worse():
    legs = legs_among(5, 40)
    begin = best_tour(legs).order
    assert flown(legs, begin).end >= best_tour(legs, begin=begin).end - 1e-6
