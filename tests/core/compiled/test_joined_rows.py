"""Rows of many flights go through one call, and get what each flight's rows get alone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from keepout.core.compiled.in_batches import joined_rows, rows_last

TABLE = jnp.asarray(np.random.default_rng(0).normal(size=(9, 4)))


def looked_up(seen):
    def function(table, rows):
        place, x = rows
        seen.append(x.shape)
        return {"sum": jnp.sum(rows_last(table[place]) * jnp.sin(x), axis=0)}

    return function


def drawn(*shape):
    generator = np.random.default_rng(1)
    return jnp.asarray(generator.integers(0, 9, shape)), jnp.asarray(generator.normal(size=shape))


@pytest.mark.long
def test_a_batch_is_one_call_and_each_flight_gets_its_own():
    place, x = drawn(5, 3)
    seen = []
    answer = jax.jit(jax.vmap(lambda p, x: joined_rows(looked_up(seen), TABLE, (p, x))))(place, x)
    expected = TABLE[place].sum(axis=-1) * jnp.sin(x)
    np.testing.assert_allclose(answer["sum"], expected, rtol=1e-14)
    assert seen[-1] == (15,)
    # Two axes of flights, and rows that do not differ between them.
    nested = jax.vmap(jax.vmap(lambda x: joined_rows(looked_up(seen), TABLE, (place[0], x))["sum"]))(x[None])
    np.testing.assert_allclose(nested[0], TABLE[place[0]].sum(axis=-1) * jnp.sin(x), rtol=1e-14)


@pytest.mark.long
def test_derivatives_of_both_directions_alone_and_in_a_batch():
    place, x = drawn(5, 3)

    def total(x, p):
        return joined_rows(looked_up([]), TABLE, (p, x))["sum"]

    expected = TABLE[place].sum(axis=-1) * jnp.cos(x)
    forwards = jax.vmap(jax.jacfwd(total))(x, place)
    np.testing.assert_allclose(jnp.diagonal(forwards, axis1=1, axis2=2), expected, rtol=1e-14)
    backwards = jax.vmap(jax.grad(lambda x, p: jnp.sum(total(x, p))))(x, place)
    np.testing.assert_allclose(backwards, expected, rtol=1e-14)
