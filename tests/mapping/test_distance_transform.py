"""Distances of nodes to what is not free: SciPy's exact transform of the whole grid is the truth."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import distance_transform_edt

from keepout.mapping.distance_transform import renew, squares_of
from keepout.mapping.windows import BLOCK


def whole(free, cap):
    """Squared distance in cells of each node to the nearest corner of a cube that is not free, capped."""
    nodes = len(free) + 1
    corner = np.zeros((nodes, nodes, nodes), dtype=bool)
    for a in (0, 1):
        for b in (0, 1):
            for c in (0, 1):
                corner[a : nodes - 1 + a, b : nodes - 1 + b, c : nodes - 1 + c] |= ~free
    if not corner.any():
        return np.full(corner.shape, cap * cap)
    return np.minimum(np.rint(distance_transform_edt(~corner) ** 2), cap * cap)


@given(st.integers(0, 10**6), st.sampled_from([8, 24, 32, 40, 72]), st.integers(1, 40), st.floats(0.0, 4.0))
def test_squares_are_those_of_the_whole_grid(seed, cubes, cap, rarity):
    free = np.random.default_rng(seed).random((cubes, cubes, cubes)) >= 10.0**-rarity * 0.5
    np.testing.assert_array_equal(squares_of(free, cap), whole(free, cap))


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


def test_only_tiles_within_reach_are_made_anew():
    free = np.ones((160, 160, 160), dtype=bool)
    free[8:152, 8:152, 8:152] = False
    squares = squares_of(free, 4)
    free[80, 80, 80] = True
    changed = np.zeros((20, 20, 20), dtype=bool)
    changed[10, 10, 10] = True
    assert 1 <= renew(free, squares, 4, changed, BLOCK) <= 8


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("place", [20, 44])
def test_nodes_of_the_next_tile_follow_a_change_that_is_not_in_it(axis, place):
    """A plate some cells before (20) or behind (44) the tile of nodes 32 to 63, 0 to 31, is taken away."""
    free = np.ones((80, 80, 80), dtype=bool)
    np.moveaxis(free, axis, 0)[place, 36:44, 36:44] = False
    squares = squares_of(free, 16)
    np.moveaxis(free, axis, 0)[place] = True
    changed = np.zeros((10, 10, 10), dtype=bool)
    np.moveaxis(changed, axis, 0)[place // BLOCK, 4:6, 4:6] = True
    renew(free, squares, 16, changed, BLOCK)
    assert (squares == 16 * 16).all()
