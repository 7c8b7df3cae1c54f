"""Pictures of an exploration against what the made-up one saw, in closed form."""

import math

import numpy as np
import pytest
from truths.made_up_exploration import CAMERA, HALF, PERIOD, REFUSED, circle, look_at, made_up

from keepout.apps.unknown.exploration_page import FirstSight
from keepout.core.geometry.target import Target

pytestmark = pytest.mark.long
VIEWS = 8


@pytest.fixture(scope="module")
def exploration():
    return made_up(views=VIEWS, expected=Target.load("box", parameters={"height": 1.0}))


def first_times(points):
    """When places on the box come into the image of a convex box: at the first view before their side and within it."""
    times = np.full(len(points), np.inf)
    outward = np.where(np.isclose(np.abs(points), HALF), np.sign(points), 0.0)
    slopes = 0.5 * np.array([CAMERA.width, CAMERA.height]) / CAMERA.focal
    for number in range(VIEWS):
        if number == REFUSED:
            continue
        position = circle(PERIOD * number, PERIOD * VIEWS)
        away = points - position
        seen = away @ look_at(position, np.zeros(3))
        length = np.linalg.norm(away, axis=1)
        facing = -np.einsum("ni,ni->n", away, outward) > math.cos(1.48) * length
        inside = (np.abs(seen[:, :2]) <= slopes * seen[:, 2:]).all(axis=1)
        times[facing & inside & np.isinf(times)] = PERIOD * number
    return times


def test_times_of_first_sight_are_those_of_a_convex_box(exploration):
    sight = FirstSight(exploration)
    inner = np.sort(HALF - np.abs(sight.points), axis=1)[:, 1] > 0.02  # away from edges, where a ray meets either side
    expected = first_times(sight.points)
    np.testing.assert_array_equal(sight.times[inner], expected[inner])
    assert 0.2 < np.isinf(expected[inner]).mean() < 0.8
    assert len(np.unique(expected[inner])) >= 3
