"""Every field far from anything, to the end of float64, and at points that are none."""

import jax.numpy as jnp
import numpy as np
import pytest
from truths import small_box
from truths.box_unions import box_union
from truths.growing_maps import Cubes
from truths.networks import random_field

from keepout.core.fields.field import values, values_and_gradients, values_gradients_hessians
from keepout.core.fields.own import FunctionField, SphereField

DIRECTIONS = np.random.default_rng(0).normal(size=(40, 3))
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)
RADII = np.concatenate([10.0 ** np.arange(2.0, 308.0, 17.0), 10.0 ** np.array([150.0, 154.1, 155.0, 300.0, 308.2])])
NOWHERE = np.array([[np.nan, 0, 0], [0, np.inf, 0], [0, 0, -np.inf], [np.inf, -np.inf, np.nan]])
POINTS = np.concatenate([(RADII[:, None, None] * DIRECTIONS).reshape(-1, 3), NOWHERE])
BOXES = jnp.array([[-1.0, -1.0, -1.0], [1.0, -0.2, -0.2]]), jnp.array([[1.0, 1.0, 1.0], [3.0, 0.2, 0.2]])
FIELDS = {
    "grid": lambda: small_box.grid().field,
    "neural": lambda: random_field(0),
    "map": lambda: Cubes((0.1, -0.2, 0.3), 0.8).field(Cubes((0.1, -0.2, 0.3), 0.8).solid),
    "sphere": lambda: SphereField(jnp.array([0.5, 0.0, 0.0]), jnp.asarray(1.0)),
    "boxes": lambda: box_union(*BOXES, jnp.asarray(0.02)),
    "own": lambda: FunctionField(lambda p: jnp.sqrt(p @ p + 1.0) - 2.0, 1.0, "stated"),
}


@pytest.mark.long
@pytest.mark.parametrize("name", FIELDS)
def test_far_away_no_field_over_states_and_at_points_that_are_none_nothing_is_free(name):
    away, field = np.linalg.norm(POINTS[: -len(NOWHERE)].astype(np.longdouble), axis=1), FIELDS[name]()
    for answer in (
        values(field, POINTS),
        values_and_gradients(field, POINTS)[0],
        values_gradients_hessians(field, POINTS)[0],
    ):
        value, nowhere = np.split(answer, [len(away)])
        assert np.isfinite(value).all()
        # What is within 10 m of the origin is no further away than that; a random network adds what it likes.
        assert np.all(value <= away * (1 + 1e-15) + (100.0 if name == "neural" else 10.0))
        if name != "map":
            assert np.all(value >= 0.5 * np.minimum(away, 1e150) - 100.0)
        np.testing.assert_array_equal(nowhere, -np.inf)
