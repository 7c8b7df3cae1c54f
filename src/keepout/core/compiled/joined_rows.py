"""A function of rows keeps its rows together in a batch: the axis of flights joins the rows, and does not precede them.

Under `jax.vmap` a function of (n, 3) points sees (flights, n, 3), and whatever it does to bring its points to the last
axis, where a processor's wide registers want them, is undone by the axis of flights. A table look-up with a weighted
sum of what it finds then takes several times as long as it needs to.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jaxtyping import Array, PyTree


def joined_rows(function: Callable[[PyTree, PyTree], PyTree], shared: PyTree, rows: PyTree) -> PyTree:
    """Give `function(shared, rows)`, with all flights' rows in one call inside a batch.

    Args:
        function: of arrays that all rows share (a table), and of arrays with rows first. What it gives has the rows
            first as well, and none depends on another.
        shared: its first argument; where flights have one each, they are taken as `jax.vmap` takes them.
        rows: its second argument.

    """

    @custom_vmap
    def joined(shared: PyTree, rows: PyTree) -> PyTree:
        return function(shared, rows)

    @joined.def_vmap
    def batched(size: int, is_batched: Any, shared: PyTree, rows: PyTree) -> tuple[PyTree, PyTree]:
        of_shared, of_rows = is_batched
        if any(jax.tree.leaves(of_shared)):
            axes = jax.tree.map(lambda flag: 0 if flag else None, (of_shared, of_rows))
            answer = jax.vmap(function, in_axes=axes, axis_size=size)(shared, rows)
        else:

            def merge(array: Array, flag: bool) -> Array:
                whole = array if flag else jnp.broadcast_to(array, (size, *array.shape))
                return whole.reshape(size * whole.shape[1], *whole.shape[2:])

            answer = joined(shared, jax.tree.map(merge, rows, of_rows))
            answer = jax.tree.map(lambda y: y.reshape(size, y.shape[0] // size, *y.shape[1:]), answer)
        return answer, jax.tree.map(lambda _: True, answer)

    # Derivatives of any order and direction are those of the function as it is written.
    @jax.custom_jvp
    def differentiable(shared: PyTree, rows: PyTree) -> PyTree:
        return joined(shared, rows)

    @differentiable.defjvp
    def _(primals: tuple[PyTree, PyTree], tangents: tuple[PyTree, PyTree]) -> tuple[PyTree, PyTree]:
        return jax.jvp(function, primals, tangents)

    return differentiable(shared, rows)


def rows_last(found: Array) -> Array:
    """Give what was looked up for each row, rows first, with the rows last.

    A look-up is fast along the table, the arithmetic along the rows. The barriers keep XLA from looking it up once
    more for every use, number by number.
    """
    return jax.lax.optimization_barrier(jnp.moveaxis(jax.lax.optimization_barrier(found), 0, -1))
