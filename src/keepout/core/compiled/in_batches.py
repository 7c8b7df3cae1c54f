"""How a function behaves inside a batch of flights, by batching rules written by hand.

`joined_rows`: under `jax.vmap` a function of (n, 3) points sees (flights, n, 3), and whatever it does to bring its
points to the last axis, where a processor's wide registers want them, is undone by the axis of flights: a table look-up
with a weighted sum of what it finds then takes several times as long as it needs to. Here the axis of flights joins the
rows, and does not precede them.

`in_chunks`: of many rows, those of a chunk stay in a processor's cache from one operation to the next.

`where_needed`: under `jax.vmap` a `lax.cond` becomes a `select`: both branches run for every flight. Here the flights
that need an expensive answer are gathered, evaluated a group at a time, and their answers put back. What a flight gets
does not depend on the flights beside it.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool, PyTree

GROUP = 16
"""Flights evaluated at once; a larger batch is taken in eight groups, so that an accelerator is not starved."""


def joined_rows(function: Callable[[PyTree, PyTree], PyTree], shared: PyTree, rows: PyTree) -> PyTree:
    """Give `function(shared, rows)`, with all flights' rows in one call inside a batch.

    Args:
        function: of arrays that all rows share (a table), and of arrays with rows first. What it gives has the rows
            first as well, and none depends on another.
        shared: its first argument; where flights have one each, they are taken as `jax.vmap` takes them.
        rows: its second argument.

    """
    joined = custom_vmap(function)

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

    return _derived_as_written(joined, function)(shared, rows)


def in_chunks(function: Callable[[PyTree], PyTree], rows: PyTree, chunk: int) -> PyTree:
    """Apply a function of arrays with rows first, `chunk` rows at a time; every answer keeps the rows first."""
    n = len(jax.tree.leaves(rows)[0])
    if n <= 2 * chunk:
        return function(rows)
    count = -(-n // chunk)

    def split(array: Array) -> Array:
        rest = jnp.broadcast_to(array[-1:], (count * chunk - n, *array.shape[1:]))
        return jnp.concatenate([array, rest]).reshape(count, chunk, *array.shape[1:])

    answers = jax.lax.map(function, jax.tree.map(split, rows))
    return jax.tree.map(lambda y: y.reshape(count * chunk, *y.shape[2:])[:n], answers)


def _derived_as_written(run: Callable[..., PyTree], written: Callable[..., PyTree]) -> Callable[..., PyTree]:
    """Give `run` with the derivatives, of any order and direction, of the function as it is written."""

    @jax.custom_jvp
    def differentiable(*arguments: PyTree) -> PyTree:
        return run(*arguments)

    @differentiable.defjvp
    def _(primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...]) -> tuple[PyTree, PyTree]:
        return jax.jvp(written, primals, tangents)

    return differentiable


def rows_last(found: Array) -> Array:
    """Give what was looked up for each row, rows first, with the rows last.

    A look-up is fast along the table, the arithmetic along the rows. The barriers keep XLA from looking it up once
    more for every use, number by number.
    """
    return jax.lax.optimization_barrier(jnp.moveaxis(jax.lax.optimization_barrier(found), 0, -1))


def where_needed(
    function: Callable[..., PyTree], needed: Bool[Array, ""], default: PyTree, shared: PyTree, *own: PyTree
) -> PyTree:
    """Give `function(shared, *own)` where `needed`, else `default`, which has the answer's structure and types.

    All arguments are arrays or pytrees of arrays. `shared` (a field's coefficients) is the same for all flights of a
    batch; if it is not, everything is evaluated everywhere.
    """

    def written(shared: PyTree, needed: Array, default: PyTree, own: PyTree) -> PyTree:
        return jax.lax.cond(needed, lambda: function(shared, *own), lambda: default)

    chosen = custom_vmap(written)

    @chosen.def_vmap
    def batched(
        size: int, is_batched: Any, shared: PyTree, needed: Array, default: PyTree, own: PyTree
    ) -> tuple[PyTree, PyTree]:
        varies, *rest = is_batched
        done = jax.tree.map(lambda _: True, default)
        if any(jax.tree.leaves(varies)):
            axes = jax.tree.map(lambda flag: 0 if flag else None, (varies, *rest))

            def one(shared: PyTree, needed: Array, default: PyTree, own: PyTree) -> PyTree:
                return jax.tree.map(lambda a, b: jnp.where(needed, a, b), function(shared, *own), default)

            return jax.vmap(one, in_axes=axes, axis_size=size)(shared, needed, default, own), done
        needed, default, own = jax.tree.map(
            lambda array, flag: array if flag else jnp.broadcast_to(array, (size, *jnp.shape(array))),
            (needed, default, own),
            tuple(rest),
        )
        return _in_groups(function, size, shared, needed, default, own), done

    # A batch of derivatives evaluates both sides.
    return _derived_as_written(chosen, written)(shared, needed, default, own)


def _in_groups(
    function: Callable[..., PyTree], size: int, shared: PyTree, needed: Array, default: PyTree, own: PyTree
) -> PyTree:
    """Evaluate the flights that need it, `width` at a time."""
    width = min(size, max(GROUP, size // 8))
    # The indices of those that need an answer; what fills up the last group points beyond the batch and is dropped.
    place = jnp.cumsum(needed)
    order = (
        jnp.full(size + width, size).at[jnp.where(needed, place - 1, size + width)].set(jnp.arange(size), mode="drop")
    )
    count = place[-1]

    def evaluate(carry: tuple[Array, PyTree]) -> tuple[Array, PyTree]:
        first, answers = carry
        group = jax.lax.dynamic_slice(order, (first,), (width,))
        theirs = jax.tree.map(lambda array: array.at[group].get(mode="clip"), own)
        found = jax.vmap(lambda own: function(shared, *own))(theirs)
        return first + width, jax.tree.map(lambda a, b: a.at[group].set(b, mode="drop"), answers, found)

    return jax.lax.while_loop(lambda carry: carry[0] < count, evaluate, (jnp.zeros((), count.dtype), default))[1]
