"""The grid field against exact distances, and its derivatives against its values."""

import itertools

import numpy as np
import pytest
from truths import small_box

from keepout.core.fields.field import values, values_gradients_hessians
from keepout.core.fields.grid import BLOCK
from keepout.core.fields.grid_build import build_grid

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def model():
    return small_box.grid()


def test_within_one_spacing_of_the_distance_everywhere_in_the_band(model):
    solid, h = small_box.solid(), float(model.field.spacing)
    points = np.random.default_rng(0).uniform(-1.2, 1.2, (50_000, 3))
    near = (small_box.distance(points) < 0.3) & solid.is_exterior(points)
    error = values(model.field, points[near]) - solid.signed_distance(points[near])
    assert 0.05 * h < np.abs(error).max() <= h


def test_derivatives_are_those_of_the_value_and_keep_the_gradient_bound(model):
    """Within a cell and the target's ball the field is a cubic along each axis, for which differences are exact."""
    field, rng = model.field, np.random.default_rng(2)
    h, origin = float(field.spacing), np.asarray(field.origin)
    cells = np.floor((rng.uniform(-0.65, 0.65, (100, 3)) - origin) / h)
    points = origin + h * (cells + rng.uniform(0.3, 0.7, cells.shape))
    value, gradient, hessian = values_gradients_hessians(field, points)
    np.testing.assert_allclose(value, values(field, points), atol=1e-12)
    step, offsets = 0.1 * h, np.arange(-2.0, 3.0)
    first, second = np.array([1, -8, 0, 8, -1]) / (12 * step), np.array([-1, 16, -30, 16, -1]) / (12 * step**2)
    for a, b in itertools.combinations_with_replacement(range(3), 2):
        moves = step * (offsets[:, None, None] * np.eye(3)[a] + offsets[:, None] * np.eye(3)[b])
        f = values(field, (points[:, None, None] + moves).reshape(-1, 3)).reshape(-1, 5, 5)
        truth = f[:, :, 2] @ second if a == b else np.einsum("nij,i,j->n", f, first, first)
        np.testing.assert_allclose(gradient[:, a], f[:, :, 2] @ first, atol=1e-10)
        np.testing.assert_allclose(hessian[:, a, b], truth, atol=1e-9)
        np.testing.assert_array_equal(hessian[:, b, a], hessian[:, a, b])
    slope = np.linalg.norm(values_gradients_hessians(field, rng.uniform(-1.5, 1.5, (4096, 3)))[1], axis=1).max()
    assert slope <= model.certificate(0.0).gradient_bound <= np.sqrt(3.0) + 1e-6


@pytest.fixture(scope="module")
def nested():
    """Three levels, each block beside others of its level and of the next."""
    field = build_grid(small_box.target(), spacing=0.025, band=0.1, solid=small_box.solid()).field
    assert len(field.tables) == 3
    return field


def faces_of_blocks(field, level, *, coarser):
    """Points on the blocks' faces, one a face, and the faces' normals: those that part levels, or blocks of one."""
    table = np.asarray(field.tables[level])
    blocks = np.argwhere(table >= 0)
    side = BLOCK * float(field.spacing) * 2**level
    rng = np.random.default_rng(3)
    points, normals = [], []
    for normal in (*np.eye(3, dtype=int), *-np.eye(3, dtype=int)):
        beyond = blocks + normal
        inside = ((beyond >= 0) & (beyond < table.shape)).all(axis=1)
        own, beyond = blocks[inside], beyond[inside]
        parts = (table[tuple(beyond.T)] < 0) == coarser
        place = rng.uniform(size=(int(parts.sum()), 3))
        place[:, normal != 0] = float(normal.sum() > 0)
        points.append(np.asarray(field.origin) + side * (own[parts] + place))
        normals.append(np.broadcast_to(normal, place.shape))
    return np.concatenate(points), np.concatenate(normals)


@pytest.mark.parametrize("level", [0, 1])
@pytest.mark.parametrize("coarser", [False, True], ids=["blocks", "levels"])
def test_second_derivatives_join_across_blocks_and_levels(nested, level, coarser):
    points, normals = faces_of_blocks(nested, level, coarser=coarser)
    assert len(points) > 100
    here, there = (values_gradients_hessians(nested, points + step * normals)[2] for step in (-1e-9, 1e-9))
    # Only the coefficients' rounding to float32 is left: half a unit in the last place of each, on both sides, and the
    # weights of a second derivative add up to at most 4/h².
    largest, h = float(np.abs(nested.coefficients).max()), float(nested.spacing) * 2**level
    rounding = 4.0 / h**2 * np.spacing(np.float32(largest))
    assert np.abs(here - there).max() <= rounding
    assert np.abs(here).max() > 100.0 * rounding
