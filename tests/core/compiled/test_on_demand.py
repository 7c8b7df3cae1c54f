"""An expensive function is evaluated where its answer is needed, and only there."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from keepout.core.compiled.in_batches import GROUP, where_needed

pytestmark = pytest.mark.as_used


def wave(shared, x, y):
    return {"sum": jnp.sin(shared * x) + y, "large": y > 1.0}


def asked(counted):
    """The function, noting for each call how many points it was given."""

    def function(shared, x, y):
        jax.debug.callback(lambda _: counted.append(1), x)
        return wave(shared, x, y)

    return function


DEFAULT = {"sum": jnp.asarray(-1.0), "large": jnp.asarray(False)}


@pytest.mark.parametrize("flights", [1, GROUP, 100, pytest.param(500, marks=pytest.mark.slow)])
def test_a_batch_gets_what_each_flight_gets_alone(flights):
    generator = np.random.default_rng(flights)
    x, y = generator.normal(size=(2, flights))
    counted = []
    batch = jax.jit(jax.vmap(lambda n, x, y: where_needed(asked(counted), n, DEFAULT, jnp.asarray(3.0), x, y)))
    for share in (0.0, 0.1, 1.0):
        counted.clear()
        needed = generator.uniform(size=flights) < share
        answer = batch(needed, x, y)
        jax.effects_barrier()
        np.testing.assert_allclose(answer["sum"], np.where(needed, np.sin(3.0 * x) + y, -1.0), rtol=1e-14)
        np.testing.assert_array_equal(answer["large"], needed & (y > 1.0))
        width = min(flights, max(GROUP, flights // 8))
        assert len(counted) == width * -(-needed.sum() // width)


@pytest.mark.long
def test_batches_of_batches_and_loops():
    x = jnp.linspace(0.0, 2.0, 12).reshape(3, 4)

    def loop(x):
        def step(carry, _):
            answer = where_needed(wave, carry > 0.5, DEFAULT, jnp.asarray(3.0), carry, carry)
            return 0.5 * carry + 0.1 * answer["sum"], answer["sum"]

        return jax.lax.scan(step, x, length=5)[1]

    expected = np.stack([[loop(b) for b in row] for row in x])
    np.testing.assert_allclose(jax.vmap(jax.vmap(loop))(x), expected, rtol=1e-12)
