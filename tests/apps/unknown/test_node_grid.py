"""The guidance's grid from a map's nodes against the field itself, and the ways that it opens and closes."""

import jax.numpy as jnp
import numpy as np
import pytest
from truths.growing_maps import Cubes

from keepout.apps.unknown.by_map import grid_of_nodes
from keepout.core.control.geodesic import geodesic_guidance
from keepout.core.errors import ControlError
from keepout.core.fields.field import values

CUBES = Cubes((0.5, 0.0, 0.0), 2.0)
OFFSET = 0.45


def grid(solid, **chosen):
    return grid_of_nodes(CUBES.squares(solid), CUBES.origin, CUBES.spacing, OFFSET, **chosen)


def scattered(share=3e-4):
    generator = np.random.default_rng(0)
    return CUBES.solid & (generator.uniform(size=CUBES.solid.shape) < share)


@pytest.mark.long
@pytest.mark.parametrize("every", [1, 2, 3, 5])
def test_values_are_the_fields_at_the_nodes(every):
    solid = scattered()
    made = grid(solid, every=every, room=0.7)
    nodes = np.stack(np.meshgrid(*(np.arange(n) for n in made.values.shape), indexing="ij"), axis=-1)
    points = made.origin + made.spacing * nodes.reshape(-1, 3)
    assert made.spacing == pytest.approx(every * CUBES.spacing)
    truth = values(CUBES.field(solid), points).reshape(made.values.shape) - OFFSET
    np.testing.assert_allclose(made.values, truth, atol=1e-9)
    # It covers the map's box and the room about it.
    assert np.all(points.min(axis=0) <= CUBES.origin - 0.7 + 1e-9)
    assert np.all(points.max(axis=0) >= CUBES.origin + CUBES.spacing * CUBES.count + 0.7 - 1e-9)


def test_a_wall_is_where_a_node_of_the_map_between_is_not_free():
    solid, every = scattered(2e-3), 6
    made = grid(solid, every=every)
    field = CUBES.field(solid)
    found = 0
    for axis in range(3):
        ahead = np.roll(made.values, -1, axis=axis)
        both = (made.values > 0.0) & (ahead > 0.0)
        np.moveaxis(both, axis, 0)[-1] = False
        index = np.argwhere(both)
        step = np.eye(3)[axis] * CUBES.spacing
        points = (made.origin + made.spacing * index)[:, None] + np.arange(1, every)[:, None] * step
        lowest = values(field, points.reshape(-1, 3)).reshape(len(index), -1).min(axis=1)
        clear = np.abs(lowest - OFFSET) > 1e-9
        np.testing.assert_array_equal(made.walls[axis][tuple(index.T)][clear], (lowest <= OFFSET)[clear])
        found += int(made.walls[axis].sum())
    assert found >= 5
    assert not np.any(made.walls & ~(made.values > 0.0))


@pytest.mark.long
def test_a_way_opens_with_the_map():
    wall = CUBES.solid & (np.abs(CUBES.centres[..., 0] - 0.5) < 0.3)
    wall |= np.abs(CUBES.centres[..., 0] - 0.5) < 0.1
    inner = (slice(15, -15),) * 3
    sealed = np.zeros_like(wall)
    sealed[inner] = wall[inner]
    start, beyond = np.array([-1.2, 0.4, 0.3]), np.array([2.2, 0.0, 0.0])

    def way(solid, goal=beyond, offset=OFFSET):
        field = CUBES.field(solid)
        return geodesic_guidance(
            grid(solid, every=2), field, offset, goal, speed=0.1, slowing_length=1.5, start=start
        ).direction(jnp.asarray(start))

    around = way(sealed)
    assert float(around[1]) + float(around[2]) > 0.3  # outwards, round the plate's edge
    hole = sealed & (np.linalg.norm(CUBES.centres[..., 1:], axis=-1) > 0.9)
    through = way(hole)
    assert float(through[1]) + float(through[2]) < -0.3  # inwards, to the hole
    assert float(through[0]) > 0.5
    middle = np.array([1.4, 0.0, 0.0])
    away = np.abs(CUBES.centres - middle).max(axis=-1)
    box = (away > 0.7) & (away < 0.95)
    with pytest.raises(ControlError, match="not connected"):
        way(box, middle)
