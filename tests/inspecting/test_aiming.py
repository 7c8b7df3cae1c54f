"""Where to look: against the smallest cone found by brute force."""

import numpy as np
import pytest

from keepout.inspecting.aiming import aim, middle_of


def smallest_cone(directions):
    """Least greatest angle over a fine lattice of middles near the mean."""
    generator = np.random.default_rng(0)
    middles = directions.mean(axis=0) + 0.4 * generator.standard_normal((200_000, 3))
    middles /= np.linalg.norm(middles, axis=1, keepdims=True)
    return float(np.arccos(np.clip((middles @ directions.T).min(axis=1).max(), -1.0, 1.0)))


@pytest.mark.parametrize("seed", range(4))
def test_the_middle_is_nearly_that_of_the_smallest_cone(seed):
    generator = np.random.default_rng(seed)
    directions = np.array([0.0, 0.0, 1.0]) + 0.5 * generator.standard_normal((12, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    middle, spread = middle_of(directions)
    assert np.linalg.norm(middle) == pytest.approx(1.0)
    assert spread == pytest.approx(float(np.arccos((directions @ middle).min())))
    assert spread <= smallest_cone(directions) + np.radians(3.0)


def test_the_planned_direction_stays_while_it_shows_all_and_gives_way_where_another_does():
    place, planned = np.zeros(3), np.array([0.0, 0.0, 1.0])
    within = np.array([[0.5, 0.0, 2.0], [-0.5, 0.0, 2.0]])
    assert aim(place, within, planned, np.radians(30.0)) is planned
    aside = np.array([[2.0, 0.0, 2.0], [2.0, 0.5, 2.0]])
    turned = aim(place, aside, planned, np.radians(30.0))
    assert np.all(aside @ turned >= np.linalg.norm(aside, axis=1) * np.cos(np.radians(30.0)))
    around = np.array([[2.0, 0.0, 0.0], [-2.0, 0.0, 0.0], [0.0, 0.0, -2.0]])
    assert aim(place, around, planned, np.radians(30.0)) is planned
    assert aim(place, np.zeros((0, 3)), planned, 0.5) is planned
    assert aim(place, place[None], planned, 0.5) is planned
