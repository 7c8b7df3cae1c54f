"""An expensive function is evaluated where its answer is needed, and only there."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from keepout.compiled.on_demand import GROUP, where_needed


def wave(shared, x, y):
    return {"sum": jnp.sin(shared * x) + y, "large": y > 1.0}


def asked(counted):
    """The function, noting for each call how many points it was given."""

    def function(shared, x, y):
        jax.debug.callback(lambda _: counted.append(1), x)
        return wave(shared, x, y)

    return function


DEFAULT = {"sum": jnp.asarray(-1.0), "large": jnp.asarray(False)}


@pytest.mark.parametrize("flights", [1, 5, GROUP, 100, pytest.param(500, marks=pytest.mark.long)])
@pytest.mark.parametrize("share", [0.0, 0.1, 1.0])
def test_a_batch_gets_what_each_flight_gets_alone(flights, share):
    generator = np.random.default_rng(flights)
    needed = generator.uniform(size=flights) < share
    x, y = generator.normal(size=(2, flights))
    counted = []
    answer = jax.jit(jax.vmap(lambda n, x, y: where_needed(asked(counted), n, DEFAULT, jnp.asarray(3.0), x, y)))(
        needed, x, y
    )
    jax.effects_barrier()
    np.testing.assert_allclose(answer["sum"], np.where(needed, np.sin(3.0 * x) + y, -1.0), rtol=1e-14)
    np.testing.assert_array_equal(answer["large"], needed & (y > 1.0))
    width = min(flights, max(GROUP, flights // 8))
    assert len(counted) == width * -(-needed.sum() // width)


def test_alone_and_with_arguments_that_do_not_vary():
    for needed in (True, False):
        answer = where_needed(wave, jnp.asarray(needed), DEFAULT, jnp.asarray(3.0), jnp.asarray(0.5), jnp.asarray(2.0))
        assert float(answer["sum"]) == pytest.approx(np.sin(1.5) + 2.0 if needed else -1.0)
    x = jnp.arange(20.0)
    answer = jax.vmap(lambda x: where_needed(wave, jnp.asarray(True), DEFAULT, jnp.asarray(3.0), x, jnp.asarray(2.0)))(
        x
    )
    np.testing.assert_allclose(answer["sum"], np.sin(3.0 * x) + 2.0)


def test_shared_arguments_that_vary_after_all():
    shared, x = jnp.array([1.0, 2.0, 3.0]), jnp.array([0.3, 0.4, 0.5])
    needed = jnp.array([True, False, True])
    answer = jax.vmap(lambda n, s, x: where_needed(wave, n, DEFAULT, s, x, x))(needed, shared, x)
    np.testing.assert_allclose(answer["sum"], np.where(needed, np.sin(shared * x) + x, -1.0))


def test_batches_of_batches_and_loops():
    x = jnp.linspace(0.0, 2.0, 12).reshape(3, 4)

    def loop(x):
        def step(carry, _):
            answer = where_needed(wave, carry > 0.5, DEFAULT, jnp.asarray(3.0), carry, carry)
            return 0.5 * carry + 0.1 * answer["sum"], answer["sum"]

        return jax.lax.scan(step, x, length=5)[1]

    expected = np.stack([[loop(b) for b in row] for row in x])
    np.testing.assert_allclose(jax.vmap(jax.vmap(loop))(x), expected, rtol=1e-12)
