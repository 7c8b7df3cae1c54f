"""Distances of nodes to what is not free: SciPy's exact transform of the whole grid is the truth."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from truths.growing_maps import squared_distances

from keepout.apps.unknown.distance_transform import renew, squares_of
from keepout.apps.unknown.rule import BLOCK


def whole(free, cap):
    return squared_distances(~free, cap)


@pytest.mark.long
@given(st.integers(0, 10**6), st.sampled_from([8, 24, 32, 40, 72]), st.integers(1, 40), st.floats(0.0, 4.0))
def test_squares_are_those_of_the_whole_grid(seed, cubes, cap, rarity):
    free = np.random.default_rng(seed).random((cubes, cubes, cubes)) >= 10.0**-rarity * 0.5
    np.testing.assert_array_equal(squares_of(free, cap), whole(free, cap))


@pytest.mark.long
@pytest.mark.parametrize("cap", [1, 12, 33])
def test_local_renewal_gives_the_whole_transform(cap):
    """A solid is carved from all sides, so that far nodes in other tiles change; after each step all is as anew."""
    generator = np.random.default_rng(cap)
    cubes = 80
    free = generator.random((cubes, cubes, cubes)) < 0.99999
    free[24:64, 20:60, 28:62] = False
    squares = squares_of(free, cap)
    for _ in range(12):
        before = squares.copy()
        middle, half = generator.integers(20, 64, 3), generator.integers(1, 14, 3)
        opened = np.zeros_like(free)
        low, high = np.maximum(middle - half, 0), np.minimum(middle + half, cubes)
        opened[low[0] : high[0], low[1] : high[1], low[2] : high[2]] = True
        opened &= ~free
        free |= opened
        blocks = cubes // BLOCK
        changed = opened.reshape(blocks, BLOCK, blocks, BLOCK, blocks, BLOCK).any(axis=(1, 3, 5))
        renew(free, squares, cap, changed, BLOCK)
        np.testing.assert_array_equal(squares, whole(free, cap))
        assert (squares >= before).all()
