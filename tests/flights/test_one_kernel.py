"""One kernel: the same numbers, to the bit, and a plain program where XLA cannot put an operation into one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from keepout.core.compiled.in_batches import where_needed
from keepout.flights.one_kernel import compiled

pytestmark = pytest.mark.as_used

X = np.random.default_rng(0).normal(size=12)
KEY = jax.random.key(3)
MATRIX = 3.0 * np.eye(4) + 0.1

IN_ONE = {
    "sum": lambda x: jnp.sum(x.reshape(3, 4), axis=1),
    "extremes": lambda x: jnp.max(x.reshape(3, 2, 2), axis=(0, 2)) - jnp.min(x),
    "sum and extreme of nothing": lambda x: x + jnp.sum(x[:0]) + jnp.max(x[:0], initial=2.0),
    "all and any": lambda x: (jnp.all(x.reshape(3, 4) > 0.0, axis=1), jnp.any(x > 0.0)),
    "product of matrices": lambda x: jnp.asarray(MATRIX) @ x.reshape(4, 3),
    "branch": lambda x: jax.lax.cond(x[0] > 0.0, jnp.sin, jnp.cos, x),
    "sums in a branch": lambda x: where_needed(lambda m, x: jnp.sum(m + x[:4], axis=1), x[0] > 0.0, x[:4], MATRIX, x),
    "constants": lambda x: (jnp.asarray(MATRIX) + x[:4]) * X[4:8] + jnp.asarray([1, 2])[jnp.asarray(x[0] > 0.0, int)],
    "loop": lambda x: jax.lax.while_loop(lambda y: jnp.sum(y * y) < 100.0, lambda y: 1.1 * y, x),
    "scan": lambda x: jax.lax.scan(lambda total, y: (total + y, total * y), 0.0, x),
    "slice": lambda x: jax.lax.dynamic_slice(x, (jnp.asarray(jnp.abs(x[0]), int),), (3,)),
    "random": lambda x: x[:4] + jax.random.normal(jax.random.key(3), (4,)),
    "random by a key given": lambda x: x[:4] + jax.random.normal(KEY, (4,)),
    "derivative": jax.grad(lambda x: jnp.sum(jax.nn.relu(x)) + jnp.max(x)),
}
NOT_IN_ONE = {
    "sort": jnp.sort,
    "solve": lambda x: jnp.linalg.solve(jnp.asarray(MATRIX), x[:4]),
}


@pytest.mark.parametrize("name", [*IN_ONE, *NOT_IN_ONE])
def test_the_numbers_are_those_of_the_plain_program(name):
    function = (IN_ONE | NOT_IN_ONE)[name]
    program, one = compiled(function, X)
    assert one == (name in IN_ONE)
    for given, plain in zip(jax.tree.leaves(program(X)), jax.tree.leaves(jax.jit(function)(X)), strict=True):
        assert np.array_equal(given, plain)
