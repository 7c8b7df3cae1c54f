"""Tours against every order there is, and what an order costs against sums by hand."""

import itertools
import math

import numpy as np
import pytest

from keepout.inspecting.tour import (
    Legs,
    best_tour,
    flown,
    least_length,
    nearest_first,
    turning_time,
    waits_never,
)


def legs_between(places, *, turns=None, windows=None, dwell=0.0, speed=0.1, acceleration=0.01):
    apart = places[None] - places[:, None]
    lengths = np.linalg.norm(apart, axis=2)
    leave = apart / np.maximum(lengths, 1e-12)[..., None]
    count = len(places)
    return Legs(
        lengths,
        leave,
        np.zeros((count, count)) if turns is None else turns,
        speed,
        acceleration,
        dwell,
        0.0,
        waits_never(count) if windows is None else windows,
    )


SQUARE = np.array([[0.0, 0, 0], [10.0, 0, 0], [10.0, 10.0, 0]])


def test_a_corner_is_flown_through_by_hand():
    tour = flown(legs_between(SQUARE), np.array([1, 2]))
    # From rest to 0.1 m/s, round a right angle, to rest; half of each change over the acceleration is lost.
    delta_v = 0.1 + 0.1 * math.sqrt(2.0) + 0.1
    assert tour.delta_v == pytest.approx(delta_v)
    assert tour.length == pytest.approx(20.0)
    assert tour.end == pytest.approx(200.0 + 0.5 * delta_v / 0.01)


def test_staying_costs_a_stop():
    tour = flown(legs_between(SQUARE, dwell=30.0), np.array([1, 2]))
    assert tour.delta_v == pytest.approx(0.4)
    assert tour.end == pytest.approx(200.0 + 60.0 + 0.5 * 0.4 / 0.01)


def test_a_long_turn_slows_the_leg():
    turns = np.zeros((3, 3))
    turns[0, 1] = 400.0
    tour = flown(legs_between(SQUARE, turns=turns), np.array([1, 2]))
    assert tour.times[0] == pytest.approx(400.0 + 0.5 * 0.025 / 0.01)
    assert tour.delta_v == pytest.approx(0.025 + math.hypot(0.025, 0.1) + 0.1)


def test_light_is_waited_for_and_what_comes_too_late_is_never():
    windows = np.full((3, 2, 2), np.nan)
    windows[0, 0] = (-math.inf, math.inf)
    windows[1] = [(0.0, 50.0), (300.0, 320.0)]
    windows[2, 0] = (0.0, 10.0)
    tour = flown(legs_between(SQUARE, windows=windows), np.array([1, 2]))
    assert tour.times[0] == 300.0
    assert tour.times[1] == math.inf


def test_a_turn_from_rest_to_rest():
    axis = np.eye(3)
    rate, acceleration = math.radians(1.0), 0.002
    long = turning_time(axis[:1], axis[1:2], rate, acceleration)[0, 0]
    assert long == pytest.approx(90.0 + rate / acceleration)
    angle = 0.5 * rate**2 / acceleration
    other = np.array([[math.cos(angle), math.sin(angle), 0.0]])
    # Half of the way at full acceleration, half at full deceleration.
    assert turning_time(axis[:1], other, rate, acceleration)[0, 0] == pytest.approx(
        2.0 * math.sqrt(angle / acceleration)
    )


@pytest.mark.parametrize("objective", ["time", "delta_v", "both"])
@pytest.mark.parametrize("lit", [False, True])
def test_of_all_orders_the_best_is_found(objective, lit):
    value = {
        "time": lambda tour: tour.end + 0.1 * tour.delta_v,
        "delta_v": lambda tour: 0.001 * tour.end + 100.0 * tour.delta_v,
        "both": lambda tour: tour.end + 1000.0 * tour.delta_v,
    }[objective]

    def cost(tour):
        return value(tour) + 1e7 * np.isinf(tour.times).sum()

    for seed in range(3):
        generator = np.random.default_rng(seed)
        places = generator.uniform(-10.0, 10.0, (7, 3))
        boresights = generator.normal(size=(7, 3))
        boresights /= np.linalg.norm(boresights, axis=1, keepdims=True)
        begins = generator.uniform(0.0, 800.0, (7, 1, 1))
        legs = legs_between(
            places,
            turns=turning_time(boresights, boresights, math.radians(1.0), 0.002),
            windows=np.concatenate([begins, begins + 500.0], axis=2) if lit else None,
        )
        best = min(cost(flown(legs, np.array(order))) for order in itertools.permutations(range(1, 7)))
        assert cost(best_tour(legs, objective)) == pytest.approx(best)


def test_a_tour_is_between_the_least_tree_and_the_nearest_first():
    generator = np.random.default_rng(4)
    legs = legs_between(generator.uniform(-10.0, 10.0, (30, 3)), acceleration=1e9)
    tour, nearest = best_tour(legs), flown(legs, nearest_first(legs))
    assert sorted(tour.order) == list(range(1, 30))
    assert least_length(legs.lengths) <= tour.length <= nearest.length
    assert tour.length < 0.97 * nearest.length
